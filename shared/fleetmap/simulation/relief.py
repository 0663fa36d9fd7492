"""The lie of the land: hills that are made of flat pieces without a gap.

Heights are the sum of one profile along and one across a grid, h(u, v) = f(u) + g(v). Between two cuts of each
profile such a hill is a plane, as no twist is left: four-cornered pieces of ground, road and junction fit each
other exactly, on slopes, in bends and where roads lie askew.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rng = np.random.Generator

PIECE_M = 6.0  # longest piece of a profile that is laid flat
_SHARPEST_PER_M = 0.003  # largest change of slope: pieces stay within 14 mm of the profile


@dataclass(frozen=True)
class Profile:
    """Heights along one axis, from slopes that change evenly between stations; level beyond them."""

    stations_m: Array  # (K,) float64, rising
    slopes: Array  # (K,) float64, the first and the last are 0

    def height_m(self, x_m: Array | float) -> Array:
        """Height (...), 0 at the first station."""
        x = np.asarray(x_m, dtype=np.float64)
        inside = np.clip(x, self.stations_m[0], self.stations_m[-1])
        steps = np.diff(self.stations_m)
        means = (self.slopes[1:] + self.slopes[:-1]) / 2.0
        heights = np.concatenate([[0.0], np.cumsum(means * steps)])
        k = np.clip(np.searchsorted(self.stations_m, inside, side="right") - 1, 0, len(steps) - 1)
        along = inside - self.stations_m[k]
        bend = (self.slopes[k + 1] - self.slopes[k]) / steps[k]
        return np.asarray(heights[k] + (self.slopes[k] + 0.5 * bend * along) * along)

    def slope(self, x_m: Array | float) -> Array:
        """Rise per metre (...)."""
        return np.asarray(np.interp(x_m, self.stations_m, self.slopes, left=0.0, right=0.0))


def shape_profile(rng: Rng, bands_m: Array, steepest_band: float, steepest: float, level_m: float) -> Profile:
    """A profile with an even slope in each band (B, 2), rising between them, and about as high at either end.

    Args:
        rng: where the slopes come from.
        bands_m: start and end of each band, in rising order, such as a street with its pavements.
        steepest_band: largest slope inside a band.
        steepest: largest slope between bands.
        level_m: the land is level so far before the first and after the last band.
    """
    stations, slopes = [float(bands_m[0, 0]) - level_m], [0.0]
    height = 0.0  # roughly: what the slope between the next bands has to bring back
    for index, (start, end) in enumerate(bands_m.tolist()):
        slope = float(rng.uniform(-steepest_band, steepest_band))
        if index:
            slope = _between(rng, stations, slopes, (start, slope), steepest, height)
            height += (start - stations[-2]) * 0.75 * slopes[-1]
        else:
            slope = float(np.clip(slope, -level_m * _SHARPEST_PER_M, level_m * _SHARPEST_PER_M))
        stations += [start, end]
        slopes += [slope, slope]
        height += slope * (end - start)
    return Profile(np.array([*stations, stations[-1] + level_m]), np.array([*slopes, 0.0]))


def _between(
    rng: Rng,
    stations: list[float],
    slopes: list[float],
    following: tuple[float, float],
    steepest: float,
    height: float,
) -> float:
    """Add the hill between two bands, and give the next band's slope, near enough for the hill to be gentle."""
    start, wanted = following
    gap = start - stations[-1]
    reach = gap / 2.0 * _SHARPEST_PER_M
    slope = float(np.clip(wanted, slopes[-1] - reach, slopes[-1] + reach))
    low, high = (f(slopes[-1], slope) + d * reach for f, d in ((max, -1.0), (min, 1.0)))
    side = -np.sign(height) if height and rng.random() < 0.8 else rng.choice([-1.0, 1.0])
    stations.append(start - gap / 2.0)
    slopes.append(float(np.clip(side * rng.uniform(0.4, 1.0) * steepest, low, high)))
    return slope


@dataclass(frozen=True)
class Terrain:
    """Ground over a grid (u, v) that is turned and shifted in the map frame."""

    heading_rad: float  # of the u axis, counter-clockwise from grid east
    origin_in_map: Array  # (3,) float64
    along: Profile  # f(u)
    across: Profile  # g(v)

    def at(self, u_m: Array | float, v_m: Array | float, above_m: Array | float = 0.0) -> Array:
        """Map points (..., 3) above places of the grid."""
        u, v = np.asarray(u_m, dtype=np.float64), np.asarray(v_m, dtype=np.float64)
        cos, sin = np.cos(self.heading_rad), np.sin(self.heading_rad)
        height = self.along.height_m(u) + self.across.height_m(v) + above_m
        east, north, up = np.broadcast_arrays(cos * u - sin * v, sin * u + cos * v, height)
        return np.asarray(np.stack([east, north, up], axis=-1) + self.origin_in_map)

    def up(self, u_m: Array | float, v_m: Array | float) -> Array:
        """Unit normals (..., 3) of the ground in the map frame."""
        f, g = self.along.slope(u_m), self.across.slope(v_m)
        cos, sin = np.cos(self.heading_rad), np.sin(self.heading_rad)
        east, north, up = np.broadcast_arrays(-(cos * f - sin * g), -(sin * f + cos * g), 1.0)
        normal = np.stack([east, north, up], axis=-1)
        return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))
