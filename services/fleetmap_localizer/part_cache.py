"""Map parts kept on the vehicle's disk, named by their content."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import platformdirs

from fleetmap.errors import StorageError
from fleetmap.files import write_bytes_atomically

_log = logging.getLogger(__name__)


class PartCache:
    """A folder of parts, ``<sha256>.bin``. What it hands out has been hashed; what is damaged is fetched again."""

    def __init__(self, folder: Path | None = None) -> None:
        """Use ``folder``, or the user's cache folder."""
        self._folder = folder or Path(platformdirs.user_cache_dir("fleetmap")) / "parts"

    def parts(
        self, sizes_bytes: Mapping[str, int], download: Callable[[Mapping[str, int]], Iterator[bytes]]
    ) -> list[bytes]:
        """Parts by their SHA-256, in order: from the disk where they are whole, else downloaded and kept.

        A cache that cannot be written costs a warning, not the pose.

        Args:
            sizes_bytes: SHA-256 -> length of the part.
            download: gives the parts that are missing, in their order.
        """
        found = {sha256: _read_whole(self._path(sha256), sha256, size) for sha256, size in sizes_bytes.items()}
        missing = {sha256: sizes_bytes[sha256] for sha256, data in found.items() if data is None}
        if missing:
            for sha256, data in zip(missing, download(missing), strict=True):
                self._keep(sha256, data)
                found[sha256] = data
        return [data for data in found.values() if data is not None]

    def _keep(self, sha256: str, data: bytes) -> None:
        try:
            write_bytes_atomically(self._path(sha256), data)
        except StorageError as error:
            _log.warning("the map is not kept for the next time: %s", error)

    def _path(self, sha256: str) -> Path:
        return self._folder / f"{sha256}.bin"


def _read_whole(path: Path, sha256: str, size_bytes: int) -> bytes | None:
    try:
        with path.open("rb") as file:
            data = file.read(size_bytes + 1)
    except OSError:
        return None
    return data if hashlib.sha256(data).hexdigest() == sha256 else None
