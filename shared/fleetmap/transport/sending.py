"""Maps and recordings on their way to a map server: what it has already is not sent again."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable
from pathlib import Path

from fleetmap.catalogue import MapEntry
from fleetmap.errors import InputError, MapPackageError, TransferError
from fleetmap.jobs import DriveSummary, JobEntry
from fleetmap.manifest import manifest_version, parse_manifest
from fleetmap.transport import protocol
from fleetmap.transport.download import Progress
from fleetmap.transport.link import Parameters, PendingRequest, ServerLink
from fleetmap.transport.protocol import MissingBlob, Received, UploadStatus
from fleetmap.transport.session import NoAnswerError

_WINDOW_CHUNKS = 2  # while the server stores one the next is on its way
_MAX_FRUITLESS_CHUNKS = 3  # sent in a row without the server having more of the blob

Bytes = Callable[[int, int], bytes]  # offset, length -> bytes of a blob


def send_map(
    link: ServerLink, manifest: bytes, part: Callable[[str], bytes], progress: Progress, job: JobEntry | None
) -> MapEntry:
    """Publish a map; see MapClient.publish."""
    upload = _MapUpload(link, manifest, part, progress, job)
    try:
        return upload.run()
    except NoAnswerError as error:
        raise TransferError(
            f"upload of map '{upload.map_id}' ended at {_mb(upload.done_bytes)} of "
            f"{_mb(upload.total_bytes)} MB: map server at {link.endpoint} answers no more; "
            "publish again to go on from there"
        ) from error


def send_drive(
    link: ServerLink,
    recording: Path,
    request: protocol.DriveBeginRequest,
    map_id: str | None,
    summary: DriveSummary | None,
    progress: Progress,
) -> protocol.DriveCommitted:
    """Send a recording; see MapClient.upload_drive."""
    sha256, size_bytes = request.sha256, request.size_bytes
    begun = link.request(protocol.DriveStatus, protocol.DRIVES_BEGIN, request.model_dump())
    done_bytes = begun.received_bytes
    progress(done_bytes, size_bytes)

    def report(received_bytes: int) -> None:
        nonlocal done_bytes
        done_bytes = received_bytes
        progress(done_bytes, size_bytes)

    try:
        with recording.open("rb") as file:

            def read(offset: int, length: int) -> bytes:
                file.seek(offset)
                return file.read(length)

            named: Parameters = {"sha256": sha256, "size_bytes": size_bytes}
            send_blob(link, named, read, size_bytes, done_bytes, report)
        committed: Parameters = {"sha256": sha256} | ({} if map_id is None else {"map_id": map_id})
        payload = None if summary is None else summary.model_dump_json().encode()
        answer = link.start(protocol.DRIVES_COMMIT, committed, payload).finish()
    except NoAnswerError as error:
        raise TransferError(
            f"upload of {recording.name} ended at {_mb(done_bytes)} of {_mb(size_bytes)} MB: map server at "
            f"{link.endpoint} answers no more; upload again to go on from there"
        ) from error
    except OSError as error:
        raise InputError(f"cannot read {recording}: {error.strerror or error}") from error
    return link.read(protocol.DriveCommitted, answer)


class _MapUpload:
    """One map on its way to the server."""

    def __init__(
        self,
        link: ServerLink,
        manifest: bytes,
        part: Callable[[str], bytes],
        progress: Progress,
        job: JobEntry | None,
    ) -> None:
        parsed = parse_manifest(manifest, "the map to publish")
        self._link, self._manifest, self._part, self._progress = link, manifest, part, progress
        self._job = job
        self._version = manifest_version(manifest)
        self._parts = {record.sha256: record.size_bytes for record in parsed.parts}
        self.map_id = parsed.map_id
        self.total_bytes = len(manifest) + sum(self._parts.values())
        self.done_bytes = 0

    def run(self) -> MapEntry:
        """Ask what is missing and send it, until nothing is; then commit as successor of what was the latest."""
        sent: set[str] = set()
        first = status = self._begin()
        while status.missing:
            self._count(status)
            for blob in status.missing:
                if blob.sha256 in sent:
                    raise TransferError(f"map server at {self._link.endpoint} lost part {blob.sha256[:12]} again")
                self._send(blob, self._contents(blob))
                sent.add(blob.sha256)
            status = self._begin()
        entry = self._commit(first.latest)
        self._report(self.total_bytes)
        return entry

    def _begin(self) -> UploadStatus:
        named: Parameters = {
            "map_id": self.map_id,
            "version": self._version,
            "size_bytes": len(self._manifest),
        }
        return self._link.request(UploadStatus, protocol.UPLOAD_BEGIN, named)

    def _commit(self, predecessor: str | None) -> MapEntry:
        named: dict[str, str | int | float] = {"version": self._version}
        if predecessor is not None:
            named["predecessor"] = predecessor
        if self._job is not None:
            named |= {"job_id": self._job.job_id, "fence": self._job.fence}
        return self._link.request(MapEntry, protocol.UPLOAD_COMMIT, named)

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
        before_bytes = self.done_bytes - blob.received_bytes
        named: Parameters = {"version": self._version, "sha256": blob.sha256, "size_bytes": len(data)}
        send_blob(
            self._link,
            named,
            lambda offset, length: data[offset : offset + length],
            len(data),
            blob.received_bytes,
            lambda received_bytes: self._report(before_bytes + received_bytes),
        )

    def _report(self, done_bytes: int) -> None:
        self.done_bytes = done_bytes
        self._progress(done_bytes, self.total_bytes)


def send_blob(
    link: ServerLink,
    named: Parameters,
    read: Bytes,
    size_bytes: int,
    offset: int,
    report: Callable[[int], None],
) -> None:
    """Send a blob, two chunks at a time; the server's answers say where to go on.

    Args:
        link: to the server.
        named: the blob's ``sha256`` and ``size_bytes``, and the ``version`` that it belongs to, if any.
        read: gives its bytes.
        size_bytes: its length.
        offset: how much of it the server has.
        report: told how much the server has, after each answer.

    Raises:
        NoAnswerError: the server was away for longer than the link's patience.
        TransferError: it answers, and does not take the blob.
        ServerRefusedError, StorageError: it said why not.
    """
    window: deque[tuple[int, PendingRequest]] = deque()  # where each chunk under way ends
    begun, fruitless = offset, 0
    while offset < size_bytes and fruitless < _MAX_FRUITLESS_CHUNKS:
        while begun < size_bytes and len(window) < _WINDOW_CHUNKS:
            place: Parameters = {**named, "offset": begun}
            data = read(begun, link.pace[protocol.UPLOAD_CHUNK].upload_chunk_bytes)
            window.append((begun := begun + len(data), link.start(protocol.UPLOAD_CHUNK, place, data)))
        end, request = window.popleft()
        received_bytes = link.read(Received, request.finish()).received_bytes
        if received_bytes != end:  # it has lost, or had, something; what is under way is in the wrong place
            for _, request in window:
                received_bytes = link.read(Received, request.finish()).received_bytes
            window.clear()
            begun = received_bytes
        fruitless = 0 if received_bytes > offset else fruitless + 1
        offset = received_bytes
        report(offset)
    if offset != size_bytes:
        raise TransferError(f"map server at {link.endpoint} does not take blob {str(named['sha256'])[:12]}")


def _mb(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:.1f}"
