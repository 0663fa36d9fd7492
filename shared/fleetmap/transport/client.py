"""A client of the map server: list, fetch and publish maps, every byte verified."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Self

from fleetmap.catalogue import NEAR_RADIUS_M, MapEntry, MapPage
from fleetmap.errors import InputError, MapPackageError, TransferError
from fleetmap.manifest import MAX_MANIFEST_BYTES, manifest_version, parse_manifest
from fleetmap.transport import protocol
from fleetmap.transport.link import Parameters, PendingRequest, ServerLink
from fleetmap.transport.protocol import (
    CHUNK_BYTES,
    DEFAULT_ENDPOINT,
    UPLOAD_CHUNK_BYTES,
    WINDOW_CHUNKS,
    BlobTicket,
    MissingBlob,
    Received,
    UploadStatus,
)
from fleetmap.transport.session import NoAnswerError

_MAX_FRUITLESS_CHUNKS = 3  # sent in a row without the server having more of the blob

Progress = Callable[[int, int], None]  # bytes done, bytes in total


class MapClient:
    """A connection to one map server; close it, or use it in a ``with`` statement.

    Requests are asked again when the connection breaks or the server restarts, until no answer has come
    for ``patience_s``.

    Args:
        endpoint: ``tcp/HOST:PORT`` of the server.
        timeout_s: how long one request may take on a connection that stands.
        patience_s: how long the server may be away in the middle of something.

    Raises:
        InputError: the endpoint is malformed.
        ServerUnreachableError: no map server answered within about 3 s.
    """

    def __init__(
        self, endpoint: str = DEFAULT_ENDPOINT, timeout_s: float = 30.0, patience_s: float = 15.0
    ) -> None:
        self._link = ServerLink(endpoint, timeout_s, patience_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the connection."""
        self._link.close()

    @property
    def endpoint(self) -> str:
        """Where the server is."""
        return self._link.endpoint

    def list_maps(
        self, near: tuple[float, float] | None = None, radius_m: float = NEAR_RADIUS_M
    ) -> list[MapEntry]:
        """The latest version of every map, newest first.

        With ``near`` (latitude, longitude in degrees) only the maps whose trajectory passes within
        ``radius_m`` of it, nearest first.

        Raises:
            InputError: there is no such place on the globe.
            ServerError: the server refused, or answers no more.
        """
        where: Parameters = {}
        if near is not None:
            if not (abs(near[0]) <= 90.0 and abs(near[1]) <= 180.0):
                raise InputError(f"latitude {near[0]}, longitude {near[1]} is no place on the globe")
            where = {"lat_deg": near[0], "lon_deg": near[1], "radius_m": radius_m}
        maps: list[MapEntry] = []
        offset: int | None = 0
        while offset is not None:
            page = self._link.request(MapPage, protocol.MAPS, {**where, "offset": offset})
            maps.extend(page.maps)
            offset = page.next_offset
        return maps

    def manifest(self, map_id: str, version: str | None = None) -> bytes:
        """The manifest of a map, byte for byte; without ``version`` that of the latest.

        Raises:
            ServerRefusedError: the server has no such map.
            TransferError: it did not arrive whole, or is that of another map.
        """
        named = {"map_id": map_id} if version is None else {"map_id": map_id, "version": version}
        ticket = self._link.request(BlobTicket, protocol.MANIFEST, named)
        if ticket.size_bytes > MAX_MANIFEST_BYTES or version not in (None, ticket.version):
            raise TransferError(f"map server at {self.endpoint} offers no manifest of map '{map_id}'")
        data = self.part(map_id, ticket.version, ticket.version, ticket.size_bytes)
        if parse_manifest(data, f"map '{map_id}'").map_id != map_id:
            raise TransferError(f"map server at {self.endpoint} sent the manifest of another map than '{map_id}'")
        return data

    def part(self, map_id: str, version: str, sha256: str, size_bytes: int) -> bytes:
        """One part of a map, its length and hash verified.

        Raises:
            ServerRefusedError: the server has no such part.
            TransferError: it did not arrive whole.
        """
        data = bytearray()
        try:
            for chunk in self._chunks(version, sha256, size_bytes):
                data += chunk
        except NoAnswerError as error:
            raise TransferError(
                f"download of map '{map_id}' ended in part {sha256[:12]} at {_mb(len(data))} of "
                f"{_mb(size_bytes)} MB: map server at {self.endpoint} answers no more; try again when it runs"
            ) from error
        if len(data) != size_bytes or hashlib.sha256(data).hexdigest() != sha256:
            raise TransferError(f"part {sha256[:12]} of map '{map_id}' arrived damaged from {self.endpoint}")
        return bytes(data)

    def publish(self, manifest: bytes, part: Callable[[str], bytes], progress: Progress | None = None) -> MapEntry:
        """Send a map; what the server already has is not sent again.

        Args:
            manifest: the manifest's bytes.
            part: gives the bytes of the part with this SHA-256.
            progress: called with the bytes that the server has, and the bytes of the whole map.

        Raises:
            MapPackageError: the manifest does not hold, or a part is not what the manifest says.
            ServerRefusedError: the server does not accept the map.
            StorageError: the server's disk is full.
            TransferError: the connection was lost; publishing again goes on from there.
        """
        upload = _Upload(self._link, manifest, part, progress or (lambda done_bytes, total_bytes: None))
        try:
            return upload.run()
        except NoAnswerError as error:
            raise TransferError(
                f"upload of map '{upload.map_id}' ended at {_mb(upload.done_bytes)} of "
                f"{_mb(upload.total_bytes)} MB: map server at {self.endpoint} answers no more; "
                "publish again to go on from there"
            ) from error

    def _chunks(self, version: str, sha256: str, size_bytes: int) -> Iterator[bytes]:
        """A blob's chunks in order; the next few are always on their way."""
        blob = {"version": version, "sha256": sha256}
        window: deque[PendingRequest] = deque()
        for offset in range(0, size_bytes, CHUNK_BYTES):
            if len(window) == WINDOW_CHUNKS:
                yield window.popleft().finish()
            window.append(self._link.start(protocol.CHUNK, {**blob, "offset": offset}))
        while window:
            yield window.popleft().finish()


class _Upload:
    """One map on its way to the server."""

    def __init__(
        self, link: ServerLink, manifest: bytes, part: Callable[[str], bytes], progress: Progress
    ) -> None:
        parsed = parse_manifest(manifest, "the map to publish")
        self._link, self._manifest, self._part, self._progress = link, manifest, part, progress
        self._version = manifest_version(manifest)
        self._parts = {record.sha256: record.size_bytes for record in parsed.parts}
        self.map_id = parsed.map_id
        self.total_bytes = len(manifest) + sum(self._parts.values())
        self.done_bytes = 0

    def run(self) -> MapEntry:
        """Ask what is missing and send it, until nothing is; then commit."""
        named: Parameters = {"version": self._version, "size_bytes": len(self._manifest)}
        sent: set[str] = set()
        while (status := self._link.request(UploadStatus, protocol.UPLOAD_BEGIN, named)).missing:
            self._count(status)
            for blob in status.missing:
                if blob.sha256 in sent:
                    raise TransferError(f"map server at {self._link.endpoint} lost part {blob.sha256[:12]} again")
                self._send(blob, self._contents(blob))
                sent.add(blob.sha256)
        entry = self._link.request(MapEntry, protocol.UPLOAD_COMMIT, {"version": self._version})
        self._report(self.total_bytes)
        return entry

    def _count(self, status: UploadStatus) -> None:
        """What the server has already; it knows the parts only once it has the manifest."""
        first = status.missing[0]
        knows_parts = first.sha256 != self._version
        self._report(self.total_bytes - status.missing_bytes if knows_parts else first.received_bytes)

    def _contents(self, blob: MissingBlob) -> bytes:
        """The blob's bytes, checked before they travel."""
        if blob.sha256 == self._version:
            return self._manifest
        if blob.sha256 not in self._parts:
            raise TransferError(
                f"map server at {self._link.endpoint} asks for part {blob.sha256[:12]}, not of this map"
            )
        data = self._part(blob.sha256)
        if len(data) != self._parts[blob.sha256] or hashlib.sha256(data).hexdigest() != blob.sha256:
            raise MapPackageError(f"part {blob.sha256[:12]} of map '{self.map_id}' is not what its manifest names")
        return data

    def _send(self, blob: MissingBlob, data: bytes) -> None:
        """Send a blob from where the server has it; its answers say where to go on."""
        named: Parameters = {"version": self._version, "sha256": blob.sha256, "size_bytes": len(data)}
        offset, fruitless, before_bytes = blob.received_bytes, 0, self.done_bytes - blob.received_bytes
        while offset < len(data) and fruitless < _MAX_FRUITLESS_CHUNKS:
            place: Parameters = {**named, "offset": offset}
            answer = self._link.start(
                protocol.UPLOAD_CHUNK, place, data[offset : offset + UPLOAD_CHUNK_BYTES]
            ).finish()
            received_bytes = self._link.read(Received, answer).received_bytes
            fruitless = 0 if received_bytes > offset else fruitless + 1
            offset = received_bytes
            self._report(before_bytes + offset)
        if offset != len(data):
            raise TransferError(f"map server at {self._link.endpoint} does not take part {blob.sha256[:12]}")

    def _report(self, done_bytes: int) -> None:
        self.done_bytes = done_bytes
        self._progress(done_bytes, self.total_bytes)


def _mb(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:.1f}"
