"""The ground of a grid of streets: carriageways, junctions, kerbs, pavements and yards, on hills without a gap."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.simulation import textures
from fleetmap.simulation.palette import Palette
from fleetmap.simulation.relief import PIECE_M, Profile, Terrain
from fleetmap.simulation.roads import RoadPath
from fleetmap.simulation.surfaces import SurfaceBuilder, raised

Array = NDArray[np.float64]
Rng = np.random.Generator

ROAD_HALF_M, PAVEMENT_M, KERB_HEIGHT_M = 6.05, 2.4, 0.12
STREET_HALF_M = ROAD_HALF_M + PAVEMENT_M
STREET_REACH_M, _YARD_REACH_M = 85.0, 34.0  # built so far from the path
_FAR_PIECE_M, _FAR_BELOW_M = 40.0, 0.25
_ROAD, _PAVEMENT, _YARD = "road", "pavement", "yard"
_MARKINGS_M = (2.55, 6.05, 9.55)  # lane lines, from the carriageway's left edge


@dataclass(frozen=True)
class StreetGrid:
    """Where streets run: axes of those along v (``columns_m``) and along u (``rows_m``), in rising order."""

    columns_m: Array
    rows_m: Array
    start_uv: tuple[float, float]
    end_uv: tuple[float, float]  # streets reach from start to end

    def is_kerbside(self, places_uv: Array) -> NDArray[np.bool_]:
        """Which of places (N, 2) are in one street only, not where another crosses it."""
        inside = [
            (np.abs(places_uv[:, i, None] - axes) < STREET_HALF_M).any(axis=1)
            for i, axes in enumerate((self.columns_m, self.rows_m))
        ]
        return np.asarray(inside[0] != inside[1])


@dataclass(frozen=True)
class _Interval:
    low: float
    high: float
    kind: str
    towards_road: int = 0  # of a pavement: 1 when the road begins at its high end, -1 at its low end


def lay_ground(
    rng: Rng,
    builder: SurfaceBuilder,
    palette: Palette,
    path: RoadPath,
    grid: StreetGrid,
    *,
    paved_u: Sequence[tuple[float, float]] | None = None,
    light: Callable[[float], float] = lambda u: 1.0,
) -> None:
    """Lay what is near a path of a grid of streets.

    Args:
        rng, builder, palette: what lays and paints.
        path: along one or some of the streets.
        grid: the streets.
        paved_u: the only stretches along u that have pavements instead of verges; by default all have.
        light: share of the daylight at u; 1 outside of tunnels.
    """
    terrain = path.terrain
    across = _intervals(grid.columns_m, grid.start_uv[0], grid.end_uv[0])
    down = _intervals(grid.rows_m, grid.start_uv[1], grid.end_uv[1])
    cells = [(u, v) for u in across for v in down]
    centres = np.array([[(u.low + u.high) / 2.0, (v.low + v.high) / 2.0] for u, v in cells])
    distance = path.distance_m(centres)
    for (u, v), far_m in zip(cells, distance.tolist(), strict=True):
        if far_m < (_YARD_REACH_M if u.kind == v.kind == _YARD else STREET_REACH_M):
            middle = (u.low + u.high) / 2.0
            paved = paved_u is None or any(low <= middle < high for low, high in paved_u)
            _lay_cell(rng, builder, palette, terrain, u, v, paved, light(middle))


def _intervals(axes_m: Array, start_m: float, end_m: float) -> list[_Interval]:
    intervals, x = [], start_m
    for axis in [*axes_m.tolist(), None]:
        stop = end_m if axis is None else axis - STREET_HALF_M
        if stop > x:
            cuts = np.linspace(x, stop, int(np.ceil((stop - x) / PIECE_M)) + 1)
            intervals += [_Interval(low, high, _YARD) for low, high in itertools.pairwise(cuts.tolist())]
        if axis is not None:
            edges = axis + np.array([-STREET_HALF_M, -ROAD_HALF_M, ROAD_HALF_M, STREET_HALF_M])
            kinds = ((_PAVEMENT, 1), (_ROAD, 0), (_PAVEMENT, -1))
            intervals += [
                _Interval(*pair, *kind)
                for pair, kind in zip(itertools.pairwise(edges.tolist()), kinds, strict=True)
            ]
            x = axis + STREET_HALF_M
    return intervals


def _lay_cell(
    rng: Rng,
    builder: SurfaceBuilder,
    palette: Palette,
    terrain: Terrain,
    u: _Interval,
    v: _Interval,
    paved: bool,
    light: float,
) -> None:
    """One piece of ground; a road's pieces have their textures' rows across it."""
    kinds, shade = {u.kind, v.kind}, float(rng.uniform(0.95, 1.05))
    along_u = v.kind == _ROAD or (v.kind == _PAVEMENT and u.kind == _YARD)
    corners = ground_corners(terrain, (u.low, u.high), (v.low, v.high), 0.0 if _ROAD in kinds else KERB_HEIGHT_M)
    if along_u:
        corners = np.roll(corners, -1, axis=0)
    if rng.random() < 0.5:
        corners = np.roll(corners, 2, axis=0)
    if _ROAD in kinds:
        paint = _road_paint(rng, palette, kinds, in_tunnel=light < 1.0)
    elif light < 1.0:
        paint = palette.pick(
            rng, "walkway", 4, lambda own: textures.paint_plain(own, PIECE_M, PAVEMENT_M, 140.0, 14.0)
        )
    elif _PAVEMENT in kinds and paved:
        paint = palette.pick(rng, "pavement", 16, lambda own: textures.paint_pavement(own, PIECE_M, PAVEMENT_M))
    else:
        paint = palette.pick(rng, "lawn", 10, lambda own: textures.paint_grass(own, PIECE_M, PIECE_M, 20.0))
    builder.add_quad(corners, paint, shade=shade * light, lit=light == 1.0)
    if kinds == {_PAVEMENT, _YARD} or kinds == {_PAVEMENT}:
        _lay_kerbs(builder, palette, terrain, u, v, light)


def _road_paint(rng: Rng, palette: Palette, kinds: set[str], *, in_tunnel: bool) -> int:
    width = 2.0 * ROAD_HALF_M
    if kinds == {_ROAD}:
        return palette.pick(rng, "junction", 6, lambda own: textures.paint_road(own, width, width, []))
    if _PAVEMENT in kinds:
        return palette.pick(rng, "crossing", 8, lambda own: textures.paint_crossing(own, PAVEMENT_M, width))
    lines = list(_MARKINGS_M)
    if in_tunnel:
        return palette.pick(
            rng, "tunnel road", 12, lambda own: textures.paint_road(own, PIECE_M, width, lines, shadows=False)
        )
    return palette.pick(rng, "road", 36, lambda own: textures.paint_road(own, PIECE_M, width, lines))


def _lay_kerbs(
    builder: SurfaceBuilder, palette: Palette, terrain: Terrain, u: _Interval, v: _Interval, light: float
) -> None:
    """The step down to the road."""
    stone = palette.numbered("kerb", 0, lambda own: textures.paint_plain(own, PIECE_M, KERB_HEIGHT_M, 170.0, 14.0))
    low = ground_corners(terrain, (u.low, u.high), (v.low, v.high), 0.0)
    high = raised(low, KERB_HEIGHT_M)
    for side, is_step in enumerate(
        (v.towards_road > 0, u.towards_road > 0, v.towards_road < 0, u.towards_road < 0)
    ):
        if is_step:
            i, j = side, (side + 1) % 4
            builder.add_quad(np.stack([high[j], high[i], low[i], low[j]]), stone, shade=light, lit=light == 1.0)


def ground_corners(
    terrain: Terrain, u: tuple[float, float], v: tuple[float, float], above_m: float = 0.0
) -> Array:
    """Corners (4, 3) of a piece of ground, clockwise from above, from (u low, v high)."""
    return terrain.at(np.array([u[0], u[1], u[1], u[0]]), np.array([v[1], v[1], v[0], v[0]]), above_m)


def lay_far_ground(rng: Rng, builder: SurfaceBuilder, path: RoadPath, radius_m: float) -> float:
    """Coarse fields to the horizon, everywhere a little below the ground that lies on them; their least height."""
    terrain = path.terrain
    middle = (path.samples_uv.min(axis=0) + path.samples_uv.max(axis=0)) / 2.0
    count = int(np.ceil(2.0 * radius_m / _FAR_PIECE_M))
    axes = [middle[i] - radius_m + _FAR_PIECE_M * np.arange(count + 1) for i in range(2)]
    below = _FAR_BELOW_M + sum(
        _highest_chord(p, axis) for p, axis in zip((terrain.along, terrain.across), axes, strict=True)
    )
    paints = [builder.add_texture(textures.paint_grass(rng, _FAR_PIECE_M, _FAR_PIECE_M, 8.0)) for _ in range(3)]
    lowest = np.inf
    for u in itertools.pairwise(axes[0].tolist()):
        for v in itertools.pairwise(axes[1].tolist()):
            if np.hypot(*(np.mean([u, v], axis=1) - middle)) < radius_m + _FAR_PIECE_M:
                corners = ground_corners(terrain, u, v, -below)
                lowest = min(lowest, float(corners[:, 2].min()))
                builder.add_quad(np.roll(corners, int(rng.integers(4)), axis=0), int(rng.choice(paints)))
    return lowest


def _highest_chord(profile: Profile, cuts: Array) -> float:
    """How far the straight pieces between cuts rise above a profile at most."""
    x = np.linspace(cuts[0], cuts[-1], 8 * len(cuts))
    return float((np.interp(x, cuts, profile.height_m(cuts)) - profile.height_m(x)).max())
