"""Roads on a grid: straights and right-angled bends, as open lines or closed circuits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline

from fleetmap.simulation.path import trapezoid
from fleetmap.simulation.relief import Terrain

Array = NDArray[np.float64]

LANE_M = 3.5
RIGHT_RADIUS_M, LEFT_RADIUS_M = 8.0, 10.5  # least radius of a bend, in the lane's centre
_STEP_M = 0.25
_FINE_STEPS = 4000


@dataclass(frozen=True)
class RoadPath:
    """The centre of the right-hand lane over a terrain; offsets are to the left.

    A closed path takes any s: one lap after the other. An open one goes straight on beyond its ends.
    """

    terrain: Terrain
    length_m: float
    is_closed: bool
    places_uv: CubicSpline  # s -> (..., 2)
    turned_rad: CubicSpline  # s -> heading on the grid, less its even growth on a circuit
    turns: int  # whole turns of a lap, counter-clockwise

    def at(self, s_m: Array | float, left_m: Array | float = 0.0, above_m: Array | float = 0.0) -> Array:
        """Map points (..., 3) beside the path, above the ground there."""
        u, v = self.grid_at(s_m, left_m)
        return self.terrain.at(u, v, above_m)

    def grid_at(self, s_m: Array | float, left_m: Array | float = 0.0) -> tuple[Array, Array]:
        """Places u, v (...) of the terrain's grid beside the path."""
        s = np.asarray(s_m, dtype=np.float64)
        on = s % self.length_m if self.is_closed else np.clip(s, 0.0, self.length_m)
        beyond = 0.0 if self.is_closed else s - on
        heading = self.heading_rad(s) - self.terrain.heading_rad
        place, left = self.places_uv(on), np.asarray(left_m, dtype=np.float64)
        cos, sin = np.cos(heading), np.sin(heading)
        return place[..., 0] + cos * beyond - sin * left, place[..., 1] + sin * beyond + cos * left

    def heading_rad(self, s_m: Array | float) -> Array:
        """Direction of travel, counter-clockwise from grid east; it goes on growing from lap to lap."""
        s = np.asarray(s_m, dtype=np.float64)
        on = s % self.length_m if self.is_closed else np.clip(s, 0.0, self.length_m)
        growth = 2.0 * np.pi * self.turns * s / self.length_m
        return np.asarray(self.terrain.heading_rad + self.turned_rad(on) + growth)

    def up(self, s_m: Array | float, left_m: Array | float = 0.0) -> Array:
        """Unit normals (..., 3) of the road: it climbs, and lies askew on a hillside."""
        u, v = self.grid_at(s_m, left_m)
        return self.terrain.up(u, v)

    @cached_property
    def samples_uv(self) -> Array:
        """Places (N, 2) of the grid along the path, about a metre apart."""
        count = int(np.ceil(self.length_m)) + 1
        return np.stack(self.grid_at(np.linspace(0.0, self.length_m, count)), axis=-1)

    def distance_m(self, places_uv: Array) -> Array:
        """Horizontal distance (N,) of places (N, 2) of the grid from the path, to a decimetre or two."""
        nearest = np.full(len(places_uv), np.inf)
        for samples in np.array_split(self.samples_uv, int(np.ceil(len(self.samples_uv) / 256))):
            difference = places_uv[:, None] - samples
            nearest = np.minimum(nearest, np.hypot(difference[..., 0], difference[..., 1]).min(axis=1))
        return nearest


def open_path(terrain: Terrain, length_m: float) -> RoadPath:
    """A straight road along the u axis, from u = 0; the middle of the street is its left lane's right edge."""
    ends = np.array([[0.0, -LANE_M / 2.0], [length_m, -LANE_M / 2.0]])
    s = np.array([0.0, length_m])
    return RoadPath(terrain, length_m, False, CubicSpline(s, ends), CubicSpline(s, np.zeros(2)), 0)


def closed_path(terrain: Terrain, corners_uv: Array) -> RoadPath:
    """A circuit around corners (N, 2) with edges along the axes; s starts in the middle of the first edge."""
    s, places, headings = _pieces(corners_uv)
    length = s[-1]
    count = int(np.ceil(length / _STEP_M))
    at = np.linspace(0.0, length, count + 1)
    uv = np.stack([np.interp(at, s, places[:, i]) for i in range(2)], axis=1)
    turns = round((headings[-1] - headings[0]) / (2.0 * np.pi))
    turned = np.interp(at, s, headings) - 2.0 * np.pi * turns * at / length
    uv[-1], turned[-1] = uv[0], turned[0]
    return RoadPath(
        terrain,
        float(length),
        True,
        CubicSpline(at, uv, bc_type="periodic"),
        CubicSpline(at, turned, bc_type="periodic"),
        turns,
    )


def circuit_length_m(corners_uv: Array) -> float:
    """Length of the circuit around corners (N, 2)."""
    edges = np.roll(corners_uv, -1, axis=0) - corners_uv
    turn = [_turn(radius) for radius in _radii(corners_uv)]
    saved = sum(2.0 * places[-1, 0] - s[-1] for s, places, _ in turn)
    return float(np.abs(edges).sum() - saved)


def _radii(corners_uv: Array) -> list[float]:
    """Signed radius of the bend at each corner: positive to the left."""
    edges = np.roll(corners_uv, -1, axis=0) - corners_uv
    before = np.roll(edges, 1, axis=0)
    sides = before[:, 0] * edges[:, 1] - before[:, 1] * edges[:, 0]
    return [LEFT_RADIUS_M if side > 0.0 else -RIGHT_RADIUS_M for side in sides]


def _turn(radius_m: float) -> tuple[Array, Array, Array]:
    """A quarter turn from the origin along x: s (K,), places (K, 2), headings (K,).

    Curvature grows and shrinks smoothly, so that the car's yaw rate and sideways pull do.
    """
    x = np.linspace(0.0, 1.0, _FINE_STEPS + 1)
    heading = cumulative_trapezoid(trapezoid(x), x, initial=0)
    share = heading[-1]  # of the bend's length at full curvature
    length = np.pi / 2.0 * abs(radius_m) / share
    heading *= np.pi / 2.0 / share
    places = [cumulative_trapezoid(f(heading), x * length, initial=0) for f in (np.cos, np.sin)]
    side = np.sign(radius_m)
    return x * length, np.stack([places[0], side * places[1]], axis=1), side * heading


def _pieces(corners_uv: Array) -> tuple[Array, Array, Array]:
    """s, places and headings at the ends of all straights and densely in the bends, around one lap."""
    edges = np.roll(corners_uv, -1, axis=0) - corners_uv
    start = (corners_uv[0] + corners_uv[1]) / 2.0
    heading = float(np.arctan2(edges[0, 1], edges[0, 0]))
    radii = _radii(corners_uv)
    s, places, headings = [np.zeros(1)], [start[None]], [np.array([heading])]
    for index in [*range(1, len(corners_uv)), 0]:
        turn_s, turn_places, turn_headings = _turn(radii[index])
        cos, sin = np.cos(heading), np.sin(heading)
        rotation = np.array([[cos, -sin], [sin, cos]])
        entry = corners_uv[index] - turn_places[-1, 0] * rotation[:, 0]
        straight = float(np.linalg.norm(entry - places[-1][-1]))
        s.append(s[-1][-1] + straight + turn_s)
        places.append(entry + turn_places @ rotation.T)
        headings.append(heading + turn_headings)
        heading = float(headings[-1][-1])
    last = float(np.linalg.norm(start - places[-1][-1]))
    s.append(s[-1][-1:] + last)
    places.append(start[None])
    headings.append(np.array([heading]))
    return np.concatenate(s), np.concatenate(places), np.concatenate(headings)
