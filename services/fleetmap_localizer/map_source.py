"""Where the localizer's maps come from: a folder, or a map server with a cache in front."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from fleetmap.errors import MapPackageError, NoPoseError
from fleetmap.manifest import manifest_version, parse_manifest
from fleetmap.map_package import decode_cells, open_package
from fleetmap.transport import MapClient
from fleetmap_localizer.map_view import LocalizableMap
from fleetmap_localizer.part_cache import PartCache

_log = logging.getLogger(__name__)


def read_map(folder: Path) -> LocalizableMap:
    """The map of a package on disk.

    Raises:
        MapPackageError: there is none, or it is damaged.
    """
    package = open_package(folder)
    return LocalizableMap(
        package.manifest.map_id,
        package.version,
        package.manifest.camera.to_camera(),
        package.localization_map(),
    )


def fetch_map(client: MapClient, map_id: str, version: str | None, cache: PartCache) -> LocalizableMap:
    """One map of a server: its manifest, and all cells that the cache does not have.

    Raises:
        ServerError: no such map, or the server or the transfer failed.
        MapPackageError: what arrived is no map, or of a newer format.
    """
    data = client.manifest(map_id, version)
    manifest, version = parse_manifest(data, f"map '{map_id}'"), manifest_version(data)
    sizes_bytes = {record.sha256: record.size_bytes for record in manifest.parts if record.kind == "cell"}
    parts = cache.parts(sizes_bytes, partial(client.parts, map_id, version))
    return LocalizableMap(map_id, version, manifest.camera.to_camera(), decode_cells(manifest, parts))


def fetch_candidates(
    client: MapClient, near_lat_lon_deg: tuple[float, float] | None, cache: PartCache
) -> Iterator[LocalizableMap]:
    """The server's maps, one after the other as they are asked for: nearest first, or newest first.

    A map that this version cannot read is left out with a warning.

    Raises:
        NoPoseError: the server has no map, or none near.
        ServerError: the server or the transfer failed.
    """
    entries = client.list_maps(near=near_lat_lon_deg)
    if not entries:
        where = "" if near_lat_lon_deg is None else " near {:.6f},{:.6f}".format(*near_lat_lon_deg)
        raise NoPoseError(
            f"map server {client.endpoint} has no map{where}; 'fleetmap maps list --server {client.endpoint}' "
            "shows what it has"
        )
    for entry in entries:
        try:
            yield fetch_map(client, entry.map_id, entry.version, cache)
        except MapPackageError as error:
            _log.warning("map '%s' is left out: %s", entry.map_id, error)
