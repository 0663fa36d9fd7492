"""Map parts kept on the vehicle's disk, named by their content."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
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

    def part(self, sha256: str, size_bytes: int, download: Callable[[], bytes]) -> bytes:
        """The part with this hash: from the disk where it is whole, else downloaded and kept.

        A cache that cannot be written costs a warning, not the pose.
        """
        path = self._folder / f"{sha256}.bin"
        kept = _read_whole(path, sha256, size_bytes)
        if kept is not None:
            return kept
        data = download()
        try:
            write_bytes_atomically(path, data)
        except StorageError as error:
            _log.warning("the map is not kept for the next time: %s", error)
        return data


def _read_whole(path: Path, sha256: str, size_bytes: int) -> bytes | None:
    try:
        with path.open("rb") as file:
            data = file.read(size_bytes + 1)
    except OSError:
        return None
    return data if hashlib.sha256(data).hexdigest() == sha256 else None
