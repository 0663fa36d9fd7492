"""Where a localizer's maps come from while its vehicle moves."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from fleetmap.camera import Camera
from fleetmap_localizer.map_view import LocalizableMap, MapView
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate
from fleetmap_localizer.settings import LocalizerSettings


class MapSupply(Protocol):
    """Keeps what lies around a vehicle at hand."""

    def views(self) -> tuple[MapView, ...]:
        """What there is to look into now: the same tuple while nothing changes. Waits only while there is nothing.

        Raises:
            NoPoseError: there is no map here, and none will come.
            ServerError: the server failed before anything was there.
        """

    def moved(self, pose: PoseEstimate | NoPose) -> None:
        """Say where the vehicle is: tiles ahead are fetched, those behind are let go. Never blocks."""

    def close(self) -> None:
        """End what goes on in the background."""


class WholeMaps:
    """Maps that are at hand as a whole, wherever the vehicle is."""

    def __init__(self, maps: Iterable[LocalizableMap], camera: Camera, settings: LocalizerSettings) -> None:
        self._views = tuple(MapView(each, camera, settings) for each in maps)

    def views(self) -> tuple[MapView, ...]:
        """All of them."""
        return self._views

    def moved(self, pose: PoseEstimate | NoPose) -> None:
        """Nothing comes or goes."""

    def close(self) -> None:
        """Nothing goes on."""
