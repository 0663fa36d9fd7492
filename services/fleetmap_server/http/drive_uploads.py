"""Survey drives over HTTP: uploads that go on where they stopped, by tus 1.0.0 with its extensions creation,
checksum, termination and expiration.

An upload is named by the SHA-256 of its recording, and so is the drive that it becomes. What it is to be called as
a map stands in its address. So no server remembers anything that the catalogue does not know, and any server of a
fleet goes on with what another one received.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import ValidationError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from fleetmap.errors import DriveError, MapPackageError
from fleetmap.jobs import MAX_DRIVE_BYTES
from fleetmap.manifest import MapId, Sha256
from fleetmap.transport.protocol import DriveBeginRequest, DriveCommitRequest, DriveCommitted
from fleetmap_server import uploads
from fleetmap_server.collection import ABANDONED_AFTER_S
from fleetmap_server.http import tus
from fleetmap_server.http.addresses import base_address
from fleetmap_server.http.answers import problems
from fleetmap_server.http.request_log import COMPLETED_DRIVE
from fleetmap_server.library import MapLibrary
from fleetmap_server.problems import BadRequestError, NotFoundError, problem_of

PIECE_BYTES = 4 * 1024 * 1024  # of a body, each kept before the next is read
_MAX_CHECKED_BYTES = 16 * 1024 * 1024  # of a body with a checksum, which is held until it is compared

_Named = Annotated[Sha256, Path(description="SHA-256 of the recording")]
_WantedMap = Annotated[MapId | None, Query(description="What to map the drive as; without it, it is not mapped")]
_Offset = Annotated[int, Header(ge=0, le=MAX_DRIVE_BYTES)]
_Length = Annotated[int, Header(gt=0, le=MAX_DRIVE_BYTES)]


def drive_upload_router(library: MapLibrary) -> APIRouter:
    """The routes under ``/drives/uploads``."""
    router = APIRouter(tags=["drives"], prefix="/drives/uploads", route_class=tus.TusRoute)
    spoken = [Depends(tus.check_version)]
    desk = _Desk(library)

    @router.options("", status_code=204, response_class=Response)
    def abilities() -> Response:
        """What of the protocol is spoken here."""
        return Response(status_code=204, headers=tus.ABILITIES)

    @router.options("/{sha256}", status_code=204, response_class=Response)
    def abilities_of(sha256: str) -> Response:
        """What of the protocol is spoken here."""
        return abilities()

    @router.post(
        "", status_code=201, response_class=Response, responses=problems(409, 412, 422), dependencies=spoken
    )
    def begin(request: Request, upload_length: _Length, upload_metadata: Annotated[str, Header()]) -> Response:
        """Begin an upload, or go on with it; Upload-Metadata needs ``sha256``, see ``filename`` and ``map_id``."""
        wanted = tus.parse_metadata(upload_metadata)
        upload = desk.begin(wanted, upload_length)
        query = f"?map_id={wanted.map_id}" if wanted.map_id else ""
        location = f"{base_address(request)}/drives/uploads/{upload.sha256}{query}"
        return Response(status_code=201, headers={"Location": location, **_state(upload)})

    @router.head("/{sha256}", response_class=Response, responses=problems(404, 412), dependencies=spoken)
    def state(sha256: _Named, map_id: _WantedMap = None) -> Response:
        """How much has arrived."""
        upload = desk.finish_if_whole(desk.open(sha256), map_id)
        return Response(headers={"Upload-Length": str(upload.size_bytes), **_state(upload)})

    @router.patch(
        "/{sha256}",
        status_code=204,
        response_class=Response,
        responses=problems(404, 409, 412, 413, 415, 422, 460),
        openapi_extra=_BODY,
        dependencies=spoken,
    )
    async def take(
        request: Request,
        sha256: _Named,
        upload_offset: _Offset,
        upload_checksum: Annotated[str | None, Header()] = None,
        map_id: _WantedMap = None,
    ) -> Response:
        """Send bytes from an offset on; what arrived of them stays, also if the connection breaks."""
        if request.headers.get("content-type", "").partition(";")[0].strip().lower() != tus.OFFSET_STREAM:
            raise HTTPException(415, f"send the bytes as {tus.OFFSET_STREAM}")
        upload = await run_in_threadpool(desk.go_on, sha256, upload_offset)
        pieces = _pieces(request) if upload_checksum is None else _checked(request, upload_checksum)
        async for piece in pieces:
            upload = await run_in_threadpool(desk.take, upload, piece)
        upload = await run_in_threadpool(desk.finish_if_whole, upload, map_id)
        setattr(request.state, COMPLETED_DRIVE, upload.result is not None)
        return Response(status_code=204, headers=_state(upload) | _links(request, upload))

    @router.delete(
        "/{sha256}",
        status_code=204,
        response_class=Response,
        responses=problems(404, 409, 412),
        dependencies=spoken,
    )
    def give_up(sha256: _Named) -> Response:
        """Throw an upload away that is not complete."""
        desk.give_up(desk.open(sha256))
        return Response(status_code=204)

    return router


_BODY: dict[str, Any] = {
    "requestBody": {"content": {tus.OFFSET_STREAM: {"schema": {"type": "string", "format": "binary"}}}}
}


@dataclass(frozen=True)
class _Upload:
    """How far an upload is."""

    sha256: str
    size_bytes: int
    received_bytes: int
    touched_ns: int | None  # None: it is a drive now
    result: DriveCommitted | None = None  # of the request that completed it


class _Desk:
    """Uploads in steps; everything here may wait for disks."""

    def __init__(self, library: MapLibrary) -> None:
        self._reception = library.reception
        self._drives = library.drives
        self._blobs = library.blobs
        self._database = library.storage.database
        self._clock = library.clock

    def begin(self, wanted: tus.UploadMetadata, size_bytes: int) -> _Upload:
        """An upload that begins or goes on.

        Raises:
            BadRequestError: the metadata do not hold.
            DriveError: the recording with this hash has another size.
            StorageError: there is no room for it.
        """
        try:
            request = DriveBeginRequest(sha256=wanted.sha256, name=wanted.filename, size_bytes=size_bytes)
        except ValidationError as error:
            raise BadRequestError(f"Upload-Metadata: {problem_of(error).detail}") from error
        known = self._find(request.sha256)
        if known is not None and known.size_bytes != size_bytes:
            raise DriveError(f"recording {request.sha256[:12]} has {known.size_bytes} bytes, not {size_bytes}")
        self._reception.begin(request)
        upload = self.open(request.sha256)
        if upload.touched_ns is None and wanted.map_id is not None:
            return self._finish(upload, wanted.map_id)  # it is here; its job may not be
        return self.finish_if_whole(upload, wanted.map_id)

    def open(self, sha256: str) -> _Upload:
        """An upload, or the drive that it became. Raises NotFoundError."""
        upload = self._find(sha256)
        if upload is None:
            raise NotFoundError(f"nobody is sending a recording {sha256[:12]}; begin with POST /drives/uploads")
        return upload

    def go_on(self, sha256: str, offset: int) -> _Upload:
        """An upload that is to grow. Raises NotFoundError; status 409 if the offset is another."""
        upload = self.open(sha256)
        if offset != upload.received_bytes:
            raise _wrong_offset(upload.received_bytes)
        if upload.touched_ns is not None:
            with self._database.writing() as connection:
                uploads.touch(connection, sha256, self._clock())
        return upload

    def take(self, upload: _Upload, piece: bytes) -> _Upload:
        """Keep the next bytes; a recording that turns out to be none is thrown away with its upload.

        Raises:
            DriveError, MapPackageError: it is no whole MCAP file, or has another hash.
            StorageError: the disk is full or refuses.
            HTTPException: status 413 for more bytes than announced, 409 if somebody else sends them too.
        """
        sha256, end = upload.sha256, upload.received_bytes + len(piece)
        if end > upload.size_bytes:
            raise HTTPException(413, f"the recording ends at {upload.size_bytes} bytes; more were sent")
        try:
            received = self._reception.receive(sha256, upload.size_bytes, upload.received_bytes, piece)
        except (DriveError, MapPackageError):
            self._end(sha256)
            raise
        if received != end:
            raise _wrong_offset(received)
        return _Upload(sha256, upload.size_bytes, received, self._clock())

    def finish_if_whole(self, upload: _Upload, map_id: str | None) -> _Upload:
        """List a recording that has arrived as a drive, and queue its mapping."""
        if upload.touched_ns is None or upload.received_bytes < upload.size_bytes:
            return upload
        return self._finish(upload, map_id)

    def give_up(self, upload: _Upload) -> None:
        """End an upload; what arrived of it is collected. Status 409 if it is complete."""
        if upload.touched_ns is None:
            raise HTTPException(409, f"recording {upload.sha256[:12]} is a drive by now; retire that instead")
        self._end(upload.sha256)

    def _finish(self, upload: _Upload, map_id: str | None) -> _Upload:
        try:
            done = self._reception.commit(DriveCommitRequest(sha256=upload.sha256, map_id=map_id))
        except DriveError:
            self._end(upload.sha256)
            raise
        return _Upload(upload.sha256, upload.size_bytes, upload.size_bytes, None, done)

    def _find(self, sha256: str) -> _Upload | None:
        with self._database.reading() as connection:
            drive = self._drives.find(sha256, connection)
            if drive is not None:
                return _Upload(sha256, drive.size_bytes, drive.size_bytes, None)
            found = uploads.find(connection, sha256)
        if found is None or found.kind != "drive":
            return None
        received = self._blobs.received({sha256: found.size_bytes})[sha256]
        return _Upload(sha256, found.size_bytes, received, found.touched_ns)

    def _end(self, sha256: str) -> None:
        with self._database.writing() as connection:
            uploads.end(connection, sha256)


async def _pieces(request: Request) -> AsyncIterator[bytes]:
    """A body in pieces as it comes in; if it is cut, what came of it."""
    piece = bytearray()
    try:
        async for data in request.stream():
            for begin in range(0, len(data), PIECE_BYTES):
                piece += data[begin : begin + PIECE_BYTES]
                if len(piece) >= PIECE_BYTES:
                    yield bytes(piece[:PIECE_BYTES])
                    del piece[:PIECE_BYTES]
    except ClientDisconnect:
        pass
    if piece:
        yield bytes(piece)


async def _checked(request: Request, checksum: str) -> AsyncIterator[bytes]:
    """A body in pieces, once all of it is here and has its checksum."""
    body = bytearray()
    async for data in request.stream():
        body += data
        if len(body) > _MAX_CHECKED_BYTES:
            raise HTTPException(413, f"with a checksum, send at most {_MAX_CHECKED_BYTES} bytes at once")
    tus.check_checksum(checksum, bytes(body))
    for begin in range(0, len(body), PIECE_BYTES):
        yield bytes(body[begin : begin + PIECE_BYTES])


def _state(upload: _Upload) -> dict[str, str]:
    headers = {"Upload-Offset": str(upload.received_bytes), "Cache-Control": "no-store"}
    expires = tus.expiry(upload.touched_ns, ABANDONED_AFTER_S) if upload.touched_ns is not None else {}
    return headers | expires


def _links(request: Request, upload: _Upload) -> dict[str, str]:
    """Where the drive and the job of a completed upload can be looked at (RFC 8288)."""
    if upload.result is None:
        return {}
    base, job = base_address(request), upload.result.job
    links = [f'<{base}/collections/drives/items/{upload.sha256}>; rel="describedby"']
    if job is not None:
        links.append(f'<{base}/jobs/{job.job_id}>; rel="monitor"')
    return {"Link": ", ".join(links)}


def _wrong_offset(received_bytes: int) -> HTTPException:
    told = f"{received_bytes} bytes of the recording are here; go on from there"
    return HTTPException(409, told, {"Upload-Offset": str(received_bytes)})
