"""What a vehicle keeps of its map servers, so that it finds its way also where none can be reached."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterable
from pathlib import Path

import platformdirs
from pydantic import BaseModel, ConfigDict, ValidationError

from fleetmap.catalogue import MapEntry
from fleetmap.errors import StorageError
from fleetmap.files import atomic_path
from fleetmap_localizer.part_cache import PartCache

_log = logging.getLogger(__name__)

_MAX_CATALOGUE_BYTES = 256 * 1024 * 1024


class _Catalogue(BaseModel):
    """The file of one server."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    endpoint: str
    maps: tuple[MapEntry, ...]


class MapCache:
    """A folder with parts and manifests, which are the same whoever serves them, and each server's catalogue."""

    def __init__(self, folder: Path | None, max_bytes: int) -> None:
        """Use ``folder``, or the user's cache folder; parts may fill ``max_bytes``."""
        self._folder = folder or Path(platformdirs.user_cache_dir("fleetmap"))
        self.parts = PartCache(self._folder / "parts", max_bytes)

    def catalogue(self, endpoint: str) -> list[MapEntry]:
        """The latest versions as that server told them when it was there last; empty if it never was."""
        try:
            with self._catalogue_path(endpoint).open("rb") as file:
                kept = _Catalogue.model_validate_json(file.read(_MAX_CATALOGUE_BYTES))
        except (OSError, ValidationError):
            return []
        return list(kept.maps) if kept.endpoint == endpoint else []

    def keep_catalogue(self, endpoint: str, maps: Iterable[MapEntry]) -> None:
        """Remember what a server told."""
        data = _Catalogue(endpoint=endpoint, maps=tuple(maps)).model_dump_json().encode()
        try:
            with atomic_path(self._catalogue_path(endpoint)) as draft:
                draft.write_bytes(data)
        except StorageError as error:
            _log.debug("the catalogue is not kept: %s", error)  # the parts have warned already

    def _catalogue_path(self, endpoint: str) -> Path:
        return self._folder / "catalogues" / f"{hashlib.sha256(endpoint.encode()).hexdigest()[:32]}.json"
