"""A straight road: villages and fields by turns, and a tunnel if wanted."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from fleetmap.simulation import furniture, houses
from fleetmap.simulation.blocks import MARKERS_LEFT_M, Street, line_street
from fleetmap.simulation.furniture import TreePaint
from fleetmap.simulation.ground import STREET_HALF_M, StreetGrid, lay_ground
from fleetmap.simulation.palette import Palette
from fleetmap.simulation.plot import GridLine, Kerb, Plot, marker_places, under_roof
from fleetmap.simulation.relief import Profile, Terrain, shape_profile
from fleetmap.simulation.roads import RoadPath, open_path
from fleetmap.simulation.surfaces import SurfaceBuilder
from fleetmap.simulation.tunnel import dig_tunnel

Array = NDArray[np.float64]
Rng = np.random.Generator

_BEFORE_M, _AFTER_M = 40.0, 130.0
_VERGE_SLOPE = 0.09
_TUNNEL_SHARE, _TUNNEL_M = 0.35, (60.0, 150.0)


def lay_straight(rng: Rng, builder: SurfaceBuilder, palette: Palette, length_m: float) -> Plot:
    """A straight road over hills, by turns through villages and fields."""
    return _lay_road(rng, builder, palette, open_path(_hills(rng, length_m), length_m), ())


def lay_tunnel(rng: Rng, builder: SurfaceBuilder, palette: Palette, length_m: float) -> Plot:
    """The same road, through a hill in its middle."""
    path = open_path(_hills(rng, length_m), length_m)
    half = float(np.clip(_TUNNEL_SHARE * length_m, *_TUNNEL_M)) / 2.0
    tunnel = (length_m / 2.0 - half, length_m / 2.0 + half)
    dig_tunnel(rng, builder, palette, path.terrain, tunnel)
    return _lay_road(rng, builder, palette, path, (tunnel,))


def _hills(rng: Rng, length_m: float) -> Terrain:
    """Up and down along the road; beside it the land falls and rises."""
    knolls = np.arange(-_BEFORE_M, length_m + _AFTER_M, 70.0)
    along = shape_profile(rng, np.stack([knolls, knolls + 8.0], axis=1), 0.05, 0.08, 60.0)
    banked = float(rng.uniform(-0.03, 0.03))
    beside = rng.uniform(-_VERGE_SLOPE, _VERGE_SLOPE, 4)
    across = Profile(
        np.array([-80.0, -38.0, -20.0, -9.0, 9.0, 20.0, 38.0, 80.0]),
        np.array([0.0, beside[0], beside[1], banked, banked, beside[2], beside[3], 0.0]),
    )
    origin = np.array([0.0, 0.0, -float(along.height_m(0.0) + across.height_m(0.0))])
    return Terrain(float(rng.uniform(-np.pi, np.pi)), origin, along, across)


def _lay_road(
    rng: Rng,
    builder: SurfaceBuilder,
    palette: Palette,
    path: RoadPath,
    tunnels_m: tuple[tuple[float, float], ...],
) -> Plot:
    ground_rng, village_rng, field_rng = rng.spawn(3)
    start, end = -_BEFORE_M, path.length_m + _AFTER_M
    grid = StreetGrid(np.empty(0), np.zeros(1), (start, -50.0), (end, 50.0))
    villages, fields = _villages_and_fields(rng, start, end, tunnels_m)
    lay_ground(
        ground_rng,
        builder,
        palette,
        path,
        grid,
        paved_u=(*villages, *tunnels_m),
        light=lambda u: float(under_roof(u, tunnels_m)),
    )
    kerbs: list[Kerb] = []
    for low, high in villages:
        street = Street(GridLine(path.terrain, (low, 0.0), along_v=False), high - low, 12.5, corners_free=False)
        kerbs += line_street(village_rng, field_rng, builder, palette, street)
    for low, high in fields:
        _till(field_rng, builder, palette, GridLine(path.terrain, (low, 0.0), along_v=False), high - low)
    return Plot(path, kerbs, marker_places(path, 40.0, MARKERS_LEFT_M), tunnels_m)


def _villages_and_fields(
    rng: Rng, start: float, end: float, tunnels_m: tuple[tuple[float, float], ...]
) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Stretches of either kind by turns, none at a tunnel's hill."""
    stretches: tuple[list[tuple[float, float]], list[tuple[float, float]]] = ([], [])
    hills = [(low - 14.0, high + 14.0) for low, high in tunnels_m]
    edges = [start, *itertools.chain(*hills), end]
    kind = int(rng.integers(2))
    for low, high in zip(edges[::2], edges[1::2], strict=True):
        at = low
        while high - at > 20.0:
            stop = min(at + float(rng.uniform(60.0, 120.0)), high)
            stretches[kind].append((at, stop))
            at, kind = stop, 1 - kind
    return stretches


def _till(rng: Rng, builder: SurfaceBuilder, palette: Palette, line: GridLine, length_m: float) -> None:
    """Hedges, trees, poles and a barn now and then."""
    trees = TreePaint(palette.crowns(), palette.bark())
    hidden = palette.side(rng, 8.0, 6.0)
    for side in (-1.0, 1.0):
        for s in np.arange(6.0, length_m - 4.0, 26.0):
            pole = line.at(s, side * (STREET_HALF_M + 0.6), -0.1)
            builder.add_box(pole, float(line.heading_rad(s)), (0.22, 0.22, 7.6), palette.bark())
        for _ in range(int(length_m / 7.0)):
            foot = line.at(rng.uniform(0.0, length_m), side * rng.uniform(STREET_HALF_M + 1.5, 34.0), -0.1)
            furniture.plant_tree(rng, builder, trees, foot)
        if rng.random() < 0.7:
            begin = float(rng.uniform(0.0, 0.3)) * length_m
            _hedge(rng, builder, palette, line, side * float(rng.uniform(9.5, 12.0)), begin, 0.9 * length_m)
        if rng.random() < 0.6 and length_m > 40.0:
            s = float(rng.uniform(5.0, length_m - 25.0))
            near, far = line.at(np.array([s, s + rng.uniform(10.0, 18.0)]), side * rng.uniform(18.0, 28.0))
            houses.build_house(rng, builder, palette, near, far, side, 9.0, hidden)


def _hedge(
    rng: Rng, builder: SurfaceBuilder, palette: Palette, line: GridLine, left_m: float, start: float, end: float
) -> None:
    """In pieces short enough to follow the hills."""
    cuts = np.arange(start, end, 11.0)
    for low, high in itertools.pairwise(cuts.tolist()):
        if rng.random() < 0.8:
            houses.fence(rng, builder, palette, line, left_m, low, high)
