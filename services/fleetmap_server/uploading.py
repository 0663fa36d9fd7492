"""What maps and drives have in common on their way in: an upload that claims its blobs, and room for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fleetmap.errors import StorageError
from fleetmap.transport.protocol import MissingBlob
from fleetmap_server import uploads
from fleetmap_server.storage import Clock, Storage

_TOUCH_EVERY_NS = 3600 * 10**9
_REMEMBERED = 10_000
_RESERVE_BYTES = 32 * 1024 * 1024  # left on the disk for the catalogue


@dataclass(frozen=True)
class Upload:
    """A transfer by the hash that it is for: a map's manifest, or a drive's recording."""

    sha256: str
    kind: uploads.UploadKind
    name: str
    size_bytes: int


class Uploading:
    """Begins uploads and tells what they still miss."""

    def __init__(self, storage: Storage, clock: Clock) -> None:
        self._storage = storage
        self._clock = clock
        self._touched_ns: dict[str, int] = {}

    def keep(self, upload: str) -> None:
        """Tell now and then that an upload is still under way, however long it takes."""
        now_ns = self._clock()
        if now_ns - self._touched_ns.get(upload, 0) < _TOUCH_EVERY_NS:
            return
        if len(self._touched_ns) >= _REMEMBERED:
            self._touched_ns.clear()
        self._touched_ns[upload] = now_ns
        with self._storage.database.writing() as connection:
            uploads.touch(connection, upload, now_ns)

    def missing(self, upload: Upload, blobs_bytes: Mapping[str, int]) -> list[MissingBlob]:
        """Begin an upload, or go on with it, and tell those of its blobs that are not whole yet.

        They are claimed first, so that what is here stays here until the upload ends.
        """
        with self._storage.database.writing() as connection:
            now_ns = self._clock()
            uploads.begin(connection, upload.sha256, upload.kind, upload.name, upload.size_bytes, now_ns)
            uploads.claim(connection, upload.sha256, blobs_bytes)
            self._storage.blobs.expect(connection, blobs_bytes)
        received = self._storage.blobs.received(blobs_bytes)
        return [
            MissingBlob(sha256=sha256, size_bytes=size, received_bytes=received[sha256])
            for sha256, size in blobs_bytes.items()
            if received[sha256] < size
        ]

    def check_room(self, needed_bytes: int) -> None:
        """Raise StorageError if the disk has no room for so much, where that can be known."""
        free_bytes = self._storage.objects.free_bytes()
        if free_bytes is not None and needed_bytes > (room := free_bytes - _RESERVE_BYTES):
            raise StorageError(
                f"the disk under the server's store has room for {max(room, 0) / 1e6:.0f} MB, "
                f"{needed_bytes / 1e6:.0f} MB more are needed"
            )
