"""The line a street follows: straights and bends, level in the bends, gently up and down between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_STEP_M = 0.25
_BEND_RADIUS_M = 27.0
_RAMP = 0.25  # share of a bend in which its curvature grows, and again shrinks
_BLEND_M = 3.0  # level stretch kept before and after each bend


class Line(Protocol):
    """A line along the ground that things stand beside."""

    def at(self, s_m: Array | float, left_m: Array | float = 0.0, above_m: Array | float = 0.0) -> Array:
        """Map points (..., 3) beside the line, above the ground."""

    def heading_rad(self, s_m: Array | float) -> Array:
        """Its direction, counter-clockwise from grid east."""


@dataclass(frozen=True)
class StreetPath:
    """The centre of the right-hand lane; ``s_m`` runs along it, offsets are to the left."""

    s_m: Array  # (N,) float64, evenly spaced
    positions_m: Array  # (N, 3) float64, map frame
    headings_rad: Array  # (N,) float64, counter-clockwise from grid east

    def at(self, s_m: Array | float, left_m: Array | float = 0.0, above_m: Array | float = 0.0) -> Array:
        """Map points (..., 3) beside the path; heights are the path's. Straight on beyond its ends."""
        s = np.asarray(s_m, dtype=np.float64)
        points = np.stack([np.interp(s, self.s_m, self.positions_m[:, i]) for i in range(3)], axis=-1)
        heading = self.heading_rad(s)
        cos, sin, beyond = np.cos(heading), np.sin(heading), s - np.clip(s, self.s_m[0], self.s_m[-1])
        left, above = np.asarray(left_m, dtype=np.float64), np.asarray(above_m, dtype=np.float64)
        offset = np.broadcast_arrays(cos * beyond - sin * left, sin * beyond + cos * left, above)
        return np.asarray(points + np.stack(offset, axis=-1))

    def heading_rad(self, s_m: Array | float) -> Array:
        """Direction of travel, counter-clockwise from grid east."""
        return np.asarray(np.interp(s_m, self.s_m, self.headings_rad))

    def up(self, s_m: Array | float) -> Array:
        """Unit normals (..., 3) of the road, which lies level across."""
        s, heading = np.asarray(s_m, dtype=np.float64), self.heading_rad(s_m)
        slope = (self.at(s + _STEP_M)[..., 2] - self.at(s - _STEP_M)[..., 2]) / (2.0 * _STEP_M)
        normal = np.stack([-slope * np.cos(heading), -slope * np.sin(heading), np.ones_like(heading)], axis=-1)
        return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))

    def knots(self, start_m: float, end_m: float, fine_m: float = 3.0, coarse_m: float = 12.0) -> Array:
        """Where to cut the street into flat pieces: finely where it bends or climbs, coarsely elsewhere."""
        knots = [start_m]
        while knots[-1] < end_m - 1e-9:
            s = knots[-1]
            ahead = np.linspace(s, s + coarse_m, 25)
            straight = np.ptp(self.heading_rad(ahead)) < 1e-9 and np.ptp(self.at(ahead)[:, 2]) < 1e-9
            knots.append(s + (coarse_m if straight else fine_m))
        return np.array(knots)


def build_path(rng: np.random.Generator, length_m: float, before_m: float, after_m: float) -> StreetPath:
    """A path with a sharp bend to one side and, if long enough, a gentler one to the other."""
    s = np.arange(-before_m, length_m + after_m + _STEP_M, _STEP_M)
    side = float(rng.choice([-1.0, 1.0]))
    bends = [(0.22 * length_m, min(50.0, 0.45 * length_m), side)]
    if length_m >= 100.0:
        bends.append((0.22 * length_m + 50.0 + 25.0, 30.0, -side))
    curvature = np.zeros_like(s)
    for start, length, turn in bends:
        curvature += turn / _BEND_RADIUS_M * trapezoid((s - start) / length)
    heading = float(rng.uniform(-np.pi, np.pi)) + np.cumsum(curvature) * _STEP_M
    steps = np.stack([np.cos(heading), np.sin(heading)], axis=1) * _STEP_M
    east_north = np.cumsum(steps, axis=0) - steps[0]
    east_north -= east_north[np.argmin(np.abs(s))]
    heights = _heights(rng, s, bends, length_m + after_m)
    return StreetPath(s, np.column_stack([east_north, heights]), heading)


def trapezoid(x: Array) -> Array:
    """Curvature over a bend, from 0 to 1 of its length: grows smoothly, stays, shrinks smoothly."""
    ramp = np.clip(np.minimum(x, 1.0 - x) / _RAMP, 0.0, 1.0)
    return np.asarray(ramp * ramp * (3.0 - 2.0 * ramp))


def _heights(rng: np.random.Generator, s: Array, bends: list[tuple[float, float, float]], end_m: float) -> Array:
    """Climbs of at most 4 % on the straights, smooth at both ends, nothing where the path bends."""
    starts = [s[0], *(start + length + _BLEND_M for start, length, _ in bends)]
    ends = [*(start - _BLEND_M for start, _, _ in bends), end_m]
    heights = np.zeros_like(s)
    for start, end in zip(starts, ends, strict=True):
        rise = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.4, 1.0)) * 0.026 * min(end - start, 60.0)
        x = np.clip((s - start) / (end - start), 0.0, 1.0)
        heights += rise * x * x * (3.0 - 2.0 * x)
    return heights
