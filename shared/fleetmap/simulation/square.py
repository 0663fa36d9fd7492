"""A wide place: a circuit across a car park, fronts of houses far around it."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from fleetmap.simulation import furniture, textures
from fleetmap.simulation.blocks import MARKERS_LEFT_M, Street, build_row, lay_circuit
from fleetmap.simulation.furniture import TreePaint
from fleetmap.simulation.ground import STREET_HALF_M, ground_corners
from fleetmap.simulation.palette import Palette
from fleetmap.simulation.plot import GridLine, Kerb, Plot, marker_places
from fleetmap.simulation.roads import RoadPath
from fleetmap.simulation.surfaces import SurfaceBuilder

Array = NDArray[np.float64]
Rng = np.random.Generator

_MARGIN_M = 46.0  # from the path to the houses
_FLAG_M = 12.0
_LAMPS_M, _BAYS_M, _CLEAR_M = 31.0, 23.0, 8.0


def lay_open(rng: Rng, builder: SurfaceBuilder, palette: Palette, length_m: float) -> Plot:
    """A circuit on a wide place with little on it."""
    path, _ = lay_circuit(rng, length_m, steepest=0.03)
    low, high = path.samples_uv.min(axis=0) - _MARGIN_M, path.samples_uv.max(axis=0) + _MARGIN_M
    _pave(rng, builder, palette, path, low, high)
    _surround(rng, builder, palette, path, low, high)
    _light(rng, builder, palette, path, low, high)
    return Plot(path, _bays(path, low, high), marker_places(path, 40.0, MARKERS_LEFT_M))


def _pave(rng: Rng, builder: SurfaceBuilder, palette: Palette, path: RoadPath, low: Array, high: Array) -> None:
    cuts = [np.linspace(low[i], high[i], int(np.ceil((high[i] - low[i]) / _FLAG_M)) + 1) for i in range(2)]
    for u in itertools.pairwise(cuts[0].tolist()):
        for v in itertools.pairwise(cuts[1].tolist()):
            paint = palette.pick(rng, "place", 14, lambda own: textures.paint_bays(own, _FLAG_M))
            corners = np.roll(ground_corners(path.terrain, u, v), int(rng.integers(4)), axis=0)
            builder.add_quad(corners, paint, shade=float(rng.uniform(0.93, 1.07)))


def _surround(
    rng: Rng, builder: SurfaceBuilder, palette: Palette, path: RoadPath, low: Array, high: Array
) -> None:
    """Rows of houses and trees along the four edges, with gaps."""
    trees = TreePaint(palette.crowns(), palette.bark())
    for along_v in (False, True):
        length = float((high - low)[int(along_v)])
        for far_end in (False, True):
            start = np.array([high[0], low[1]] if along_v else [low[0], high[1]]) if far_end else low
            line = GridLine(path.terrain, (float(start[0]), float(start[1])), along_v)
            side = 1.0 if far_end != along_v else -1.0
            street = Street(line, length, 12.5, corners_free=along_v)
            build_row(rng, builder, palette, street, side)
            furniture.plant_trees(
                rng, builder, trees, line, side * (STREET_HALF_M - 3.0), np.array([8.0, length - 8.0])
            )


def _light(rng: Rng, builder: SurfaceBuilder, palette: Palette, path: RoadPath, low: Array, high: Array) -> None:
    """Lamp posts in a wide grid, none in the way."""
    u, v = np.meshgrid(*(np.arange(low[i] + 9.0, high[i], _LAMPS_M) for i in range(2)))
    places = np.stack([u.ravel(), v.ravel()], axis=1) + rng.uniform(-3.0, 3.0, (u.size, 2))
    for place in places[path.distance_m(places) > _CLEAR_M]:
        foot = path.terrain.at(*place)
        furniture.put_up_lamp(builder, palette.metal(), foot, path.terrain.heading_rad, 7.5)


def _bays(path: RoadPath, low: Array, high: Array) -> list[Kerb]:
    """Rows along u where cars may stand, cut where the path's lanes need room."""
    kerbs = []
    for v in np.arange(low[1] + 12.0, high[1] - 8.0, _BAYS_M):
        u = np.arange(low[0] + 8.0, high[0] - 8.0, 1.0)
        clear = path.distance_m(np.stack([u, np.full_like(u, v)], axis=1)) > _CLEAR_M
        edges = np.flatnonzero(np.diff(np.concatenate([[False], clear, [False]]).astype(int)))
        for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            if last - first > 14:
                line = GridLine(path.terrain, (float(u[first]), float(v)), along_v=False)
                kerbs.append(Kerb(line, 0.0, (0.0, float(last - first - 1))))
    return kerbs
