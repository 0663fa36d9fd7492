"""What every kind of world lays out before cars, markers and the horizon come to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.simulation.path import Line
from fleetmap.simulation.relief import Terrain
from fleetmap.simulation.roads import RoadPath

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GridLine:
    """A straight line over a terrain, along one of its axes."""

    terrain: Terrain
    start_uv: tuple[float, float]
    along_v: bool

    def at(self, s_m: Array | float, left_m: Array | float = 0.0, above_m: Array | float = 0.0) -> Array:
        """Map points (..., 3) beside the line, above the ground."""
        s, left = np.asarray(s_m, dtype=np.float64), np.asarray(left_m, dtype=np.float64)
        along, across = (-left, s) if self.along_v else (s, left)
        return self.terrain.at(self.start_uv[0] + along, self.start_uv[1] + across, above_m)

    def heading_rad(self, s_m: Array | float) -> Array:
        """Its direction, counter-clockwise from grid east."""
        heading = self.terrain.heading_rad + (np.pi / 2.0 if self.along_v else 0.0)
        return np.full(np.shape(s_m), heading)


@dataclass(frozen=True)
class Kerb:
    """Where cars park: beside a line, between two places along it."""

    line: Line
    left_m: float
    span_m: tuple[float, float]


@dataclass(frozen=True)
class Plot:
    """A path through a laid-out world, and where things may stand beside it."""

    path: RoadPath
    kerbs: list[Kerb]
    marker_places: list[tuple[float, float]]  # (s, left) along the path
    tunnels_m: tuple[tuple[float, float], ...] = ()  # stretches along the path


def marker_places(
    path: RoadPath,
    every_m: float,
    lefts_m: tuple[float, float],
    is_free: Callable[[Array], NDArray[np.bool_]] | None = None,
) -> list[tuple[float, float]]:
    """Places (s, left) on alternate sides where the path is straight and the grid's places (N, 2) are free."""
    s = np.arange(5.0, path.length_m, 1.0)
    good = np.abs(path.heading_rad(s + 8.0) - path.heading_rad(s - 4.0)) < 1e-3
    free = [
        good if is_free is None else good & is_free(np.stack(path.grid_at(s, left), axis=-1)) for left in lefts_m
    ]
    places: list[tuple[float, float]] = []
    for index, at in enumerate(s.tolist()):
        side = len(places) % 2
        if free[side][index] and (not places or at - places[-1][0] >= every_m):
            places.append((at, lefts_m[side]))
    return places


def under_roof(s_m: Array | float, tunnels_m: tuple[tuple[float, float], ...]) -> Array:
    """Share (...) of the daylight along a path: 1 outside, fading within metres of a tunnel's portals."""
    s = np.asarray(s_m, dtype=np.float64)
    light = np.ones_like(s)
    for start, end in tunnels_m:
        depth = np.minimum(s - start, end - s)
        light = np.where(depth > 0.0, 0.3 + 0.55 * np.exp(-np.maximum(depth, 0.0) / 7.0), light)
    return light
