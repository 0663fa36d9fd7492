"""How drives come in, and what workers make of them."""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy.engine import Connection

from fleetmap.jobs import DriveEntry, DriveSummary, JobEntry
from fleetmap.transport import protocol
from fleetmap_server import uploads
from fleetmap_server.drives import Drives
from fleetmap_server.jobs import Jobs
from fleetmap_server.keyed_lock import KeyedLock
from fleetmap_server.mcap_structure import McapStructure, check_mcap
from fleetmap_server.problems import IncompleteUploadError, NotFoundError
from fleetmap_server.storage import Clock, Storage
from fleetmap_server.uploading import Upload, Uploading


class Reception:
    """Recordings on their way into the list of drives, and from there to the workers."""

    def __init__(self, storage: Storage, drives: Drives, jobs: Jobs, clock: Clock) -> None:
        self._storage = storage
        self._drives = drives
        self._jobs = jobs
        self._uploading = Uploading(storage, clock)
        self._frames: dict[str, McapStructure] = {}  # of recordings that arrived and are not listed yet
        self._looking = KeyedLock()

    def begin(self, request: protocol.DriveBeginRequest) -> protocol.DriveStatus:
        """How much of a recording is here. Raises StorageError if there is no room for the rest."""
        sha256, size_bytes = request.sha256, request.size_bytes
        drive = self._drives.find(sha256)
        if drive is not None:
            return protocol.DriveStatus(received_bytes=drive.size_bytes, drive=drive)
        upload = Upload(sha256, "drive", request.name, size_bytes)
        missing = self._uploading.missing(upload, {sha256: size_bytes})
        received_bytes = missing[0].received_bytes if missing else size_bytes
        if missing:
            self._uploading.check_room(2 * size_bytes - received_bytes)  # its pieces, and then the whole
        return protocol.DriveStatus(received_bytes=received_bytes)

    def receive(self, sha256: str, size_bytes: int, offset: int, data: bytes) -> int:
        """Take bytes of a recording; returns how many of them are here.

        Raises:
            NotFoundError: nobody began to send it.
            DriveError: it is no whole MCAP file.
            MapPackageError: it has other bytes than its name says.
            StorageError: the disk is full or refuses.
        """
        if offset == 0:
            self._need_upload(sha256, size_bytes)
        self._uploading.keep(sha256)

        def check(pieces: Iterable[bytes]) -> None:
            self._frames[sha256] = check_mcap(pieces)

        return self._storage.blobs.append(sha256, size_bytes, offset, data, accept=check)

    def commit(
        self, request: protocol.DriveCommitRequest, summary: DriveSummary | None = None
    ) -> protocol.DriveCommitted:
        """List a recording that is here, and queue its mapping if a map id is given; once more changes nothing.

        Raises:
            IncompleteUploadError: it has not arrived whole.
            DriveError: it is no whole MCAP file.
        """
        sha256 = request.sha256
        if self._drives.find(sha256) is None:
            self._look_at(sha256)
        with self._storage.database.writing() as connection:
            drive = self._drives.find(sha256, connection) or self._list(connection, sha256)
            if summary is not None:
                drive = self._drives.summarise(connection, sha256, summary, checked=False)
            job = self._jobs.queue(connection, sha256, request.map_id) if request.map_id is not None else None
        self._frames.pop(sha256, None)
        return protocol.DriveCommitted(drive=drive, job=job)

    def report(self, request: protocol.ReportRequest, summary: DriveSummary | None = None) -> JobEntry:
        """How far a worker is, and what it found where it has looked at the recording; see Jobs.report."""
        job = self._jobs.report(request.job_id, request.fence, request.stage, request.percent)
        if summary is not None:
            with self._storage.database.writing() as connection:
                self._drives.summarise(connection, job.drive, summary, checked=True)
        return job

    def retire(self, sha256: str) -> None:
        """Take a drive out of service with its jobs. Raises NotFoundError."""
        with self._storage.database.writing() as connection:
            self._drives.retire(connection, sha256)
            self._jobs.cancel_all_of(connection, sha256)

    def _look_at(self, sha256: str) -> None:
        """Know the frame of a recording, also if it came in at another server, or as something else."""
        with self._looking.held(sha256):
            if sha256 not in self._frames and self._storage.blobs.size(sha256) is not None:
                self._frames[sha256] = check_mcap(self._storage.blobs.stream(sha256))

    def _need_upload(self, sha256: str, size_bytes: int) -> None:
        with self._storage.database.reading() as connection:
            upload = uploads.find(connection, sha256)
        if upload is None or upload.kind != "drive" or upload.size_bytes != size_bytes:
            raise NotFoundError(f"nobody began to send a drive {sha256[:12]} of {size_bytes} bytes")

    def _list(self, connection: Connection, sha256: str) -> DriveEntry:
        upload = uploads.find(connection, sha256)
        if upload is None or self._storage.blobs.missing(connection, {sha256: upload.size_bytes}):
            raise IncompleteUploadError(f"drive {sha256[:12]} has not arrived whole; upload it again")
        frame = self._frames.get(sha256)
        start_ns, end_ns = (frame.start_ns, frame.end_ns) if frame else (None, None)
        drive = self._drives.add(connection, sha256, upload.name, upload.size_bytes, start_ns, end_ns)
        uploads.end(connection, sha256)
        return drive
