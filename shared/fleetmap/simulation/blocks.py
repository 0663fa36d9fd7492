"""City blocks: a grid of streets, a circuit around some of its blocks, and what lines the streets."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.simulation import furniture, houses
from fleetmap.simulation.furniture import FurniturePaint, TreePaint
from fleetmap.simulation.ground import (
    KERB_HEIGHT_M,
    ROAD_HALF_M,
    STREET_HALF_M,
    StreetGrid,
    lay_ground,
)
from fleetmap.simulation.palette import Palette
from fleetmap.simulation.plot import GridLine, Kerb, Plot, marker_places
from fleetmap.simulation.relief import Terrain, shape_profile
from fleetmap.simulation.roads import LANE_M, RoadPath, circuit_length_m, closed_path
from fleetmap.simulation.surfaces import SurfaceBuilder

Array = NDArray[np.float64]
Rng = np.random.Generator

SHORTEST_CIRCUIT_M = 140.0
MARKERS_LEFT_M = (-4.55, 8.05)  # just behind either kerb, in the path's offsets
_BLOCK_M = 100.0  # about, from street to street
_BEYOND_M = 95.0  # streets reach so far beyond the outermost crossings
_LINED_M = 72.0  # houses, trees and cars stand so far from the path
_DEEPEST_M = 12.5  # houses with their front gardens
_BAND_HALF_M = 8.8  # a street and its crossings lie on one slope across
_CORNER_M = 15.0  # kept free at the ends of the streets along v: the others' corner houses are there


@dataclass(frozen=True)
class Street:
    """A stretch of street from crossing to crossing; its line is the middle of the carriageway."""

    line: GridLine
    length_m: float
    deepest_m: float  # room for houses on either side
    corners_free: bool


def lay_city(rng: Rng, builder: SurfaceBuilder, palette: Palette, length_m: float, *, alike: bool = False) -> Plot:
    """A circuit of a given length around some blocks of a city."""
    path, grid = lay_circuit(rng, length_m, steepest=0.08)
    kerbs = build_blocks(rng, builder, palette, path, grid, alike=alike)
    return Plot(path, kerbs, marker_places(path, 40.0, MARKERS_LEFT_M, grid.is_kerbside))


def lay_facades(rng: Rng, builder: SurfaceBuilder, palette: Palette, length_m: float) -> Plot:
    """The same where all houses look alike."""
    return lay_city(rng, builder, palette, length_m, alike=True)


def lay_circuit(rng: Rng, length_m: float, steepest: float) -> tuple[RoadPath, StreetGrid]:
    """A circuit over hills that begins at the map's origin, and the streets around it."""
    grid, corners = plan_circuit(rng, length_m)
    band = np.array([-_BAND_HALF_M, _BAND_HALF_M])
    along, across = (
        shape_profile(rng, axes[:, None] + band, 0.5 * steepest, steepest, 60.0)
        for axes in (grid.columns_m, grid.rows_m)
    )
    heading = float(rng.uniform(-np.pi, np.pi))
    start = closed_path(Terrain(heading, np.zeros(3), along, across), corners).at(0.0)
    return closed_path(Terrain(heading, -start, along, across), corners), grid


def plan_circuit(rng: Rng, length_m: float) -> tuple[StreetGrid, Array]:
    """A grid of streets, and the corners (N, 2) of a circuit of a given length in its right-hand lane.

    Up to some 350 m it leads around one block, beyond around several, with bends to either side.
    """
    blocks = max(round(length_m / 2.0 / _BLOCK_M), 2)
    columns, rows = (blocks + 1) // 2, blocks // 2
    widths, heights = rng.uniform(0.8, 1.2, columns), rng.uniform(0.8, 1.2, rows)
    numbers = _outline(rng, columns, rows)

    def laid_out(scale: float) -> tuple[Array, Array, Array]:
        u, v = (np.concatenate([[0.0], np.cumsum(sizes * scale)]) for sizes in (widths, heights))
        return u, v, _in_right_lane(np.stack([u[numbers[:, 0]], v[numbers[:, 1]]], axis=1))

    short, long = circuit_length_m(laid_out(60.0)[2]), circuit_length_m(laid_out(120.0)[2])
    u, v, corners = laid_out(60.0 + 60.0 * (length_m - short) / (long - short))
    start, end = (u[0] - _BEYOND_M, v[0] - _BEYOND_M), (u[-1] + _BEYOND_M, v[-1] + _BEYOND_M)
    return StreetGrid(u, v, (float(start[0]), float(start[1])), (float(end[0]), float(end[1]))), corners


def _outline(rng: Rng, columns: int, rows: int) -> NDArray[np.int64]:
    """Crossings (N, 2) where a circuit turns: around all blocks but, if there are enough, those of one corner."""
    if columns >= 2 and rows >= 2:
        i, j = int(rng.integers(1, columns)), int(rng.integers(1, rows))
        outline = np.array([[0, 0], [columns, 0], [columns, j], [i, j], [i, rows], [0, rows]])
    else:
        outline = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]])
    for axis, size in enumerate((columns, rows)):
        if rng.random() < 0.5:
            outline[:, axis] = size - outline[:, axis]
    if rng.random() < 0.5:
        outline = outline[::-1]
    return np.roll(outline, int(rng.integers(len(outline))), axis=0)


def _in_right_lane(corners_uv: Array) -> Array:
    """Corners of a line half a lane to the right of the edges through corners (N, 2)."""
    edges = np.roll(corners_uv, -1, axis=0) - corners_uv
    forward = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    right = np.stack([forward[:, 1], -forward[:, 0]], axis=1) * LANE_M / 2.0
    return np.asarray(corners_uv + right + np.roll(right, 1, axis=0))


def build_blocks(
    rng: Rng, builder: SurfaceBuilder, palette: Palette, path: RoadPath, grid: StreetGrid, *, alike: bool = False
) -> list[Kerb]:
    """Lay and line the streets near a path, and say where cars may park.

    ``alike``: all houses have one size and nearly the same front.
    """
    ground_rng, house_rng, tree_rng = rng.spawn(3)
    lay_ground(ground_rng, builder, palette, path, grid)
    kerbs: list[Kerb] = []
    for street in streets_near(path, grid):
        kerbs += line_street(house_rng, tree_rng, builder, palette, street, alike=alike)
    return kerbs


def line_street(
    house_rng: Rng,
    tree_rng: Rng,
    builder: SurfaceBuilder,
    palette: Palette,
    street: Street,
    *,
    alike: bool = False,
) -> list[Kerb]:
    """Build houses, trees, lamps and signs along a street, and say where cars may park."""
    trees = TreePaint(palette.crowns(), palette.bark())
    things = FurniturePaint(palette.metal(), palette.signs(), palette.boxes())
    length, kerbs = street.length_m, []
    for side in (-1.0, 1.0):
        row = build_terrace if alike else build_row
        row(house_rng, builder, palette, street, side)
        span = np.array([4.0, length - 4.0])
        furniture.plant_trees(tree_rng, builder, trees, street.line, side * (ROAD_HALF_M + 1.2), span)
        furniture.place_furniture(tree_rng, builder, things, street.line, side * (ROAD_HALF_M + 0.45), span)
        if length > 20.0:
            kerbs.append(Kerb(street.line, side * (ROAD_HALF_M - 1.05), (6.0, length - 6.0)))
    return kerbs


def streets_near(path: RoadPath, grid: StreetGrid) -> Iterator[Street]:
    """The stretches between crossings that pass near a path, cut off where they leave it."""
    for along_v in (False, True):
        own, crossed = (grid.columns_m, grid.rows_m) if along_v else (grid.rows_m, grid.columns_m)
        first, last = (corner[int(along_v)] for corner in (grid.start_uv, grid.end_uv))
        for axis in own.tolist():
            beside = np.abs(own[own != axis] - axis).min(initial=200.0)
            for low, high in itertools.pairwise([None, *crossed.tolist(), None]):
                start = first if low is None else low + STREET_HALF_M
                end = last if high is None else high - STREET_HALF_M
                near = _near_part(path, axis, start, end, along_v)
                if near is not None:
                    start_uv = (axis, near[0]) if along_v else (near[0], axis)
                    deepest = min(_DEEPEST_M, beside / 2.0 - STREET_HALF_M)
                    free = along_v and len(crossed) > 0
                    yield Street(GridLine(path.terrain, start_uv, along_v), near[1] - near[0], deepest, free)


def _near_part(path: RoadPath, axis: float, start: float, end: float, along_v: bool) -> tuple[float, float] | None:
    along = np.arange(start, end, 2.0)
    places = np.stack(
        [np.full_like(along, axis), along] if along_v else [along, np.full_like(along, axis)], axis=1
    )
    near = along[path.distance_m(places) < _LINED_M]
    if not near.size or near[-1] - near[0] < 8.0:
        return None
    return float(near[0]), float(min(near[-1] + 2.0, end))


def build_row(rng: Rng, builder: SurfaceBuilder, palette: Palette, street: Street, side: float) -> None:
    """Houses of different width, height and setback along one side; now and then a gap or a small park."""
    s, end = _row_span(street)
    hidden = palette.side(rng, 8.0, 6.0)
    while end - s > 7.0:
        width = min(float(rng.uniform(9.0, 17.0)), end - s)
        setback = float(rng.choice([0.2, 0.2, 1.2, 2.5]))
        depth = min(float(rng.uniform(8.0, 10.0)), street.deepest_m - setback)
        if rng.random() < 0.08:
            _plant_park(rng, builder, palette, street, side, s, s + width)
        elif depth > 4.0:
            near, far = street.line.at(np.array([s, s + width]), side * (STREET_HALF_M + setback), KERB_HEIGHT_M)
            shade = float(rng.uniform(0.85, 1.12))
            houses.build_house(rng, builder, palette, near, far, side, depth, hidden, shade=shade)
            if setback > 1.0:
                houses.fence(
                    rng, builder, palette, street.line, side * (STREET_HALF_M + 0.25), s + 0.1, s + width - 0.1
                )
        s += width + float(rng.choice([0.0, 0.0, 1.5, 4.0, 8.0]))


def build_terrace(rng: Rng, builder: SurfaceBuilder, palette: Palette, street: Street, side: float) -> None:
    """Houses of one size side by side, whose fronts differ in details only."""
    start, end = _row_span(street)
    count = int((end - start) // _ALIKE_WIDTH_M)
    for s in start + _ALIKE_WIDTH_M * np.arange(count):
        near, far = street.line.at(np.array([s, s + _ALIKE_WIDTH_M - 0.05]), side * (STREET_HALF_M + 0.6))
        houses.build_terraced(rng, builder, palette, near, far, side, min(9.0, street.deepest_m - 1.0))


_ALIKE_WIDTH_M = 9.0


def _row_span(street: Street) -> tuple[float, float]:
    keep = _CORNER_M if street.corners_free else 0.0
    return keep, street.length_m - keep


def _plant_park(
    rng: Rng, builder: SurfaceBuilder, palette: Palette, street: Street, side: float, start: float, end: float
) -> None:
    houses.fence(rng, builder, palette, street.line, side * (STREET_HALF_M + 0.25), start + 0.1, end - 0.1)
    trees = TreePaint(palette.crowns(), palette.bark())
    for s in np.arange(start + 2.0, end - 1.5, 4.5):
        left = side * (STREET_HALF_M + float(rng.uniform(2.0, max(street.deepest_m - 2.0, 2.5))))
        furniture.plant_tree(rng, builder, trees, street.line.at(s, left, KERB_HEIGHT_M))
