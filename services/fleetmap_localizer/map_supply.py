"""Where a localizer's maps come from while its vehicle moves."""

from __future__ import annotations

from typing import Protocol

from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate


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
