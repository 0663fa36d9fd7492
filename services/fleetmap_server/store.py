"""Blobs on disk, named by their SHA-256, and the partial uploads they grow from.

``STORE/blobs/ab/abcdef...`` appears whole, by a rename, after its hash was verified. ``STORE/uploads/abcdef...``
holds the bytes received so far, from the first on; its length is all there is to know, so an upload
goes on after a restart of the server.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from threading import Lock

from fleetmap.errors import MapPackageError, StorageError
from fleetmap_server.problems import DamagedBlobError, NotFoundError

_FileState = tuple[int, int, int]  # inode, size, time of the last change
_LOCKS = 64


class BlobStore:
    """Content-addressed files under one folder; safe to use from several threads of one process.

    Raises:
        StorageError: the folder cannot be made or written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._locks = [Lock() for _ in range(_LOCKS)]
        self._verified: dict[str, _FileState | None] = {}  # SHA-256 -> the file as it was when its hash held
        try:
            (folder / "blobs").mkdir(parents=True, exist_ok=True)
            (folder / "uploads").mkdir(exist_ok=True)
        except OSError as error:
            raise storage_error(folder, error) from error

    def free_bytes(self) -> int:
        """Room left on the disk."""
        return shutil.disk_usage(self._folder).free

    def path(self, sha256: str) -> Path:
        """The file of a blob, its hash verified (once for each state of the file).

        Raises:
            NotFoundError: there is no such blob.
            DamagedBlobError: its bytes are not what its name says.
        """
        path = self._blob_path(sha256)
        state = _file_state(path)
        if state is None:
            raise NotFoundError(f"the server has no data named {sha256}")
        if self._verified.get(sha256) != state:
            if _sha256_of_file(path) != sha256:
                raise DamagedBlobError(f"stored part {sha256[:12]} is damaged; publish its map again to repair it")
            self._verified[sha256] = state
        return path

    def read(self, sha256: str, offset: int, length: int) -> bytes:
        """Bytes of a blob from ``offset`` on, at most ``length``; raises as ``path`` does."""
        with self.path(sha256).open("rb") as file:
            file.seek(offset)
            return file.read(length)

    def received_bytes(self, sha256: str, size_bytes: int) -> int:
        """How much of a blob is here, from its start; ``size_bytes`` if it is whole.

        A damaged blob is removed, so that sending it again repairs it.
        """
        with self._lock(sha256):
            return self._received(sha256, size_bytes)

    def append(
        self,
        sha256: str,
        size_bytes: int,
        offset: int,
        data: bytes,
        accept: Callable[[bytes], object] | None = None,
    ) -> int:
        """Add bytes to a partial upload if they are the next ones; returns how many are here now.

        With the last bytes the upload becomes a blob, if its hash holds and ``accept`` does not raise;
        otherwise it is thrown away.

        Raises:
            MapPackageError: too many bytes, or the wrong ones.
            StorageError: the disk is full or refuses.
        """
        if offset + len(data) > size_bytes:
            raise MapPackageError(f"part {sha256[:12]} ends at {size_bytes} bytes; more were sent")
        with self._lock(sha256):
            received = self._received(sha256, size_bytes)
            if received == size_bytes or offset != received:
                return received
            upload = self._upload_path(sha256)
            try:
                with upload.open("ab") as file:
                    file.write(data)
                if received + len(data) == size_bytes:
                    self._settle(sha256, accept)
            except OSError as error:
                raise storage_error(self._folder, error) from error
            return received + len(data)

    def _received(self, sha256: str, size_bytes: int) -> int:
        """As ``received_bytes``, under the blob's lock."""
        try:
            if self.path(sha256).stat().st_size == size_bytes:
                return size_bytes
        except DamagedBlobError:
            self._blob_path(sha256).unlink(missing_ok=True)
        except NotFoundError:
            pass
        upload = self._upload_path(sha256)
        received = upload.stat().st_size if upload.exists() else 0
        if received >= size_bytes:  # cut between its last byte and its check: the last bytes are asked for again
            os.truncate(upload, size_bytes - 1)
            return size_bytes - 1
        return received

    def _settle(self, sha256: str, accept: Callable[[bytes], object] | None) -> None:
        """Make a whole upload a blob, or throw it away."""
        upload, blob = self._upload_path(sha256), self._blob_path(sha256)
        try:
            if _sha256_of_file(upload) != sha256:
                raise MapPackageError(f"part {sha256[:12]} arrived with other bytes than its name says")
            if accept is not None:
                accept(upload.read_bytes())
        except MapPackageError:
            upload.unlink()
            raise
        _flush(upload)
        blob.parent.mkdir(exist_ok=True)
        upload.replace(blob)
        _flush(blob.parent)
        self._verified[sha256] = _file_state(blob)

    def _blob_path(self, sha256: str) -> Path:
        return self._folder / "blobs" / sha256[:2] / sha256

    def _upload_path(self, sha256: str) -> Path:
        return self._folder / "uploads" / sha256

    def _lock(self, sha256: str) -> Lock:
        return self._locks[int(sha256[:8], 16) % _LOCKS]


def storage_error(path: Path, error: OSError) -> StorageError:
    """The disk's own words, and where."""
    return StorageError(
        f"cannot write {path}: {error.strerror or error}; free some space or check its permissions"
    )


def _file_state(path: Path) -> _FileState | None:
    """Changes whenever the file does; None if there is none."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return (status.st_ino, status.st_size, status.st_mtime_ns)


def _sha256_of_file(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _flush(path: Path) -> None:
    """Have the disk keep what was written to a file or folder."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
