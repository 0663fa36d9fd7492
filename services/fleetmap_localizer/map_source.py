"""Where the localizer's maps come from: a folder, or a map server."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from fleetmap.catalogue import MapEntry, distances_m
from fleetmap.errors import ServerRefusedError
from fleetmap.map_package import open_package
from fleetmap.transport import MapClient
from fleetmap.transport.announcements import Announcements
from fleetmap_localizer.map_view import LocalizableMap


@dataclass(frozen=True)
class Circle:
    """A place on the globe and what lies around it."""

    lat_deg: float
    lon_deg: float
    radius_m: float

    def holds(self, entry: MapEntry) -> bool:
        """Whether a map's trajectory meets it."""
        return entry.distance_m(self.lat_deg, self.lon_deg) <= self.radius_m

    def widened(self, by_m: float) -> Circle:
        """A larger one around the same place."""
        return replace(self, radius_m=self.radius_m + by_m)

    def encloses(self, other: Circle) -> bool:
        """Whether another circle lies within."""
        centre = np.array([[other.lon_deg, other.lat_deg]])
        away_m = float(distances_m([centre], self.lat_deg, self.lon_deg)[0])
        return away_m + other.radius_m <= self.radius_m


class MapSource(Protocol):
    """Gives the latest versions of maps, and what they consist of.

    Every method raises ServerError where a server is away; ServerRefusedError or MapPackageError where it is
    there, but what was asked for is not to be had.
    """

    def maps(self, around: Circle | None, max_count: int) -> list[MapEntry]:
        """The latest version of each map within a circle, or of all, newest first."""

    def manifest(self, map_id: str, version: str) -> bytes:
        """The manifest of a version."""

    def parts(self, map_id: str, version: str, sizes_bytes: Mapping[str, int]) -> Iterator[bytes]:
        """Parts of a version by their SHA-256, verified, in turn."""

    def is_served(self, map_id: str, version: str) -> bool:
        """Whether the version is still to be had."""

    def announcements(self) -> Announcements | None:
        """New versions as they come; None where none will."""

    def close(self) -> None:
        """End it; whoever waits gets an error."""


@dataclass(frozen=True)
class MapServer:
    """A map server, and how to connect to it."""

    endpoint: str
    connect: Callable[..., MapClient]  # takes MapClient's ``patience_s``
    map_id: str | None = None  # the only map wanted from there
    patience_s: float = 5.0  # without an answer for longer, it counts as away; it is asked again later

    def __str__(self) -> str:
        return f"map server {self.endpoint}"

    def open(self) -> ServerMaps:
        """Connect; raises as MapClient does."""
        return ServerMaps(self.connect(patience_s=self.patience_s), self.map_id)


@dataclass(frozen=True)
class MapFolder:
    """A map package on disk."""

    folder: Path

    def __str__(self) -> str:
        return str(self.folder)

    def open(self) -> FolderMap:
        """Read the manifest. Raises MapPackageError."""
        return FolderMap(self.folder)


class ServerMaps:
    """The maps of a server."""

    def __init__(self, client: MapClient, map_id: str | None) -> None:
        self._client, self._map_id = client, map_id

    def maps(self, around: Circle | None, max_count: int) -> list[MapEntry]:
        """As the server lists them; of a single map its latest version, wherever it is."""
        if self._map_id is not None:
            return self._client.versions(self._map_id)[:1]
        if around is None:
            return self._client.list_maps(max_count=max_count)
        place = around.lat_deg, around.lon_deg
        return self._client.list_maps(place, around.radius_m, max_count=max_count)

    def manifest(self, map_id: str, version: str) -> bytes:
        """Fetched, and verified by its hash."""
        return self._client.manifest(map_id, version)

    def parts(self, map_id: str, version: str, sizes_bytes: Mapping[str, int]) -> Iterator[bytes]:
        """All asked for at once."""
        return self._client.parts(map_id, version, sizes_bytes)

    def is_served(self, map_id: str, version: str) -> bool:
        """Retired versions are not."""
        try:
            self._client.manifest(map_id, version)
        except ServerRefusedError:
            return False
        return True

    def announcements(self) -> Announcements:
        """Of all the server's maps; those of now are asked for where they are needed."""
        return self._client.announcements(news_only=True)

    def close(self) -> None:
        """Hang up."""
        self._client.close()


class FolderMap:
    """The one map of a package; its parts are read when they are asked for."""

    def __init__(self, folder: Path) -> None:
        self._package = open_package(folder)

    def maps(self, around: Circle | None, max_count: int) -> list[MapEntry]:
        """The map, if it is there."""
        package = self._package
        entry = MapEntry.from_manifest(package.manifest, package.version, len(package.manifest_bytes), 0)
        return [entry] if around is None or around.holds(entry) else []

    def manifest(self, map_id: str, version: str) -> bytes:
        """The manifest's bytes."""
        return self._package.manifest_bytes

    def parts(self, map_id: str, version: str, sizes_bytes: Mapping[str, int]) -> Iterator[bytes]:
        """Read from the disk, each verified."""
        return map(self._package.part_bytes, sizes_bytes)

    def is_served(self, map_id: str, version: str) -> bool:
        """It was opened."""
        return True

    def announcements(self) -> None:
        """A folder is not watched."""

    def close(self) -> None:
        """Nothing is open."""


def read_map(folder: Path) -> LocalizableMap:
    """The whole map of a package on disk.

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
