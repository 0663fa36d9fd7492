"""Map parts and manifests kept on the vehicle's disk, named by their content."""

from __future__ import annotations

import hashlib
import logging
import os
import time
from contextlib import suppress
from pathlib import Path

from fleetmap.errors import StorageError
from fleetmap.files import atomic_path

_log = logging.getLogger(__name__)

_FILLED = 0.9  # of the limit that is left once the cache has been cleared up
_ABANDONED_S = 3600.0  # a draft so old belongs to nobody any more


class PartCache:
    """A folder of ``<sha256>.bin``; several processes may share it.

    What it hands out has been hashed; what is damaged counts as missing. The parts that were not used for longest
    make room for others.
    """

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self._folder, self._max_bytes = folder, max_bytes
        self._until_full_bytes = -1  # not counted yet
        self._is_writable = True

    def get(self, sha256: str, max_bytes: int) -> bytes | None:
        """A part of at most ``max_bytes``; None if it is not here, or not whole."""
        path = self._path(sha256)
        try:
            with path.open("rb") as file:
                data = file.read(max_bytes + 1)
            os.utime(path)  # used just now
        except OSError:
            return None
        return data if hashlib.sha256(data).hexdigest() == sha256 else None

    def keep(self, sha256: str, data: bytes) -> None:
        """Write a part to the disk; where that cannot be done it costs a warning, not the pose."""
        try:
            with atomic_path(self._path(sha256)) as draft:
                draft.write_bytes(data)  # not flushed: what a power cut spoils is told by its hash
        except StorageError as error:
            if self._is_writable:
                _log.warning("maps are not kept for the next time: %s", error)
            self._is_writable = False
            return
        self._until_full_bytes -= len(data)
        if self._until_full_bytes < 0:
            self._clear_up()

    def _clear_up(self) -> None:
        """Let go of what was not used for longest, and count what is left."""
        files, now_s = list[tuple[float, int, Path]](), time.time()
        for path in self._folder.glob("*"):
            with suppress(OSError):  # another process may have been here first
                facts = path.stat()
                if path.suffix == ".part" and now_s - facts.st_mtime > _ABANDONED_S:
                    path.unlink()
                elif path.suffix == ".bin":
                    files.append((facts.st_mtime, facts.st_size, path))
        used_bytes = sum(size for _, size, _ in files)
        if used_bytes > self._max_bytes:
            for _, size, path in sorted(files):
                if used_bytes <= _FILLED * self._max_bytes:
                    break
                with suppress(OSError):
                    path.unlink()
                    used_bytes -= size
        self._until_full_bytes = self._max_bytes - used_bytes

    def _path(self, sha256: str) -> Path:
        return self._folder / f"{sha256}.bin"
