"""Rows of houses along a street, and more houses behind them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap.simulation.palette import STOREY_M, FreshPaint, TerracePaint, WallPaint
from fleetmap.simulation.path import Line, StreetPath
from fleetmap.simulation.surfaces import SurfaceBuilder, raised

Array = NDArray[np.float64]
Rng = np.random.Generator


def build_row(
    rng: Rng, builder: SurfaceBuilder, path: StreetPath, side: float, front_m: float, span: Array
) -> None:
    """Houses of different width, height and setback along one side; now and then a gap or a side street.

    ``side`` is 1 for left and -1 for right, ``front_m`` the least distance of a front from the path.
    """
    paint = FreshPaint(builder)
    hidden = paint.side(rng, 8.0, 6.0)
    s = float(span[0])
    while s < span[1]:
        width = float(rng.uniform(9.0, 17.0))
        front = front_m + float(rng.choice([0.3, 1.5, 3.0, 5.0]))
        near, far = path.at(np.array([s, s + width]), side * front)
        if _clearance(path, _footprint(near, far, side, 9.0)) > front - 1.2:
            build_house(rng, builder, paint, near, far, side, float(rng.uniform(8.0, 11.0)), hidden)
            if front > front_m + 1.0:
                fence(rng, builder, paint, path, side * (front_m + 0.25), s, s + width)
        s += width + float(rng.choice([0.0, 1.5, 4.0, 8.0]))


def build_behind(rng: Rng, builder: SurfaceBuilder, path: StreetPath, span: Array) -> None:
    """Taller houses further off, which fill the gaps of the rows."""
    paint = FreshPaint(builder)
    fronts = [paint.facade(rng, 16.0, 12.0) for _ in range(6)]
    roof = paint.roof(rng, 16.0, 8.0)
    for s in np.arange(span[0] - 10.0, span[1] + 60.0, 17.0):
        for side in (-1.0, 1.0):
            left = side * float(rng.uniform(32.0, 70.0))
            near, far = path.at(np.array([s, s + 16.0]), left)
            footprint = _footprint(near, far, side, 12.0)
            if _clearance(path, footprint) < 26.0:
                continue
            footprint[:, 2] = footprint[:, 2].min() - 2.0
            walls = tuple(int(rng.choice(fronts)) for _ in range(4))
            top = raised(footprint, float(rng.uniform(9.0, 19.0)))
            builder.add_prism(footprint, top, (walls[0], walls[1], walls[2], walls[3]), roof, shade=0.9)


def _clearance(path: StreetPath, footprint: Array) -> float:
    """Least horizontal distance of a footprint's corners and edges' middles from the path."""
    points = np.concatenate([footprint, (footprint + np.roll(footprint, 1, axis=0)) / 2.0])[:, :2]
    return float(np.linalg.norm(points[:, None] - path.positions_m[None, ::4, :2], axis=2).min())


def _footprint(near: Array, far: Array, side: float, depth_m: float) -> Array:
    """Corners (4, 3), clockwise from above, starting so that walls 0 and 2 are the far and the near side."""
    along = (far - near)[:2] / np.linalg.norm((far - near)[:2])
    outward = side * np.array([-along[1], along[0]])
    back = np.append(outward * depth_m, 0.0)
    if side > 0.0:
        return np.stack([far + back, far, near, near + back])
    return np.stack([far, far + back, near + back, near])


def build_house(
    rng: Rng,
    builder: SurfaceBuilder,
    paint: WallPaint,
    near: Array,
    far: Array,
    side: float,
    depth: float,
    hidden: int,
    *,
    shade: float = 1.0,
) -> None:
    """A house with its front from ``near`` to ``far``, on side 1 (left) or -1 of that direction.

    ``hidden`` paints what is hardly seen.
    """
    width = float(np.linalg.norm((far - near)[:2]))
    height = STOREY_M * float(rng.integers(1, 5)) + float(rng.uniform(0.7, 1.3))
    ground = _footprint(near, far, side, depth)
    lowest, highest = float(ground[:, 2].min()) - 0.3, float(ground[:, 2].max())
    ground[:, 2] = lowest
    wall_height = highest + height - lowest
    eaves = raised(ground, wall_height)
    front = paint.facade(rng, width, wall_height)
    ends = [paint.side(rng, depth, wall_height) for _ in range(2)]
    sides = (ends[0], front, ends[1], hidden) if side > 0.0 else (ends[0], hidden, ends[1], front)
    builder.add_prism(ground, eaves, sides, hidden, shade=shade)
    if rng.random() < 0.7:
        _add_roof(rng, builder, paint, eaves, width, depth)
    if rng.random() < 0.5:
        _add_balconies(rng, builder, paint, near, far, side, lowest, wall_height)


def build_terraced(
    rng: Rng,
    builder: SurfaceBuilder,
    paint: TerracePaint,
    near: Array,
    far: Array,
    side: float,
    depth: float,
) -> None:
    """One of many houses that look alike: two storeys under one kind of roof."""
    width = float(np.linalg.norm((far - near)[:2]))
    ground = _footprint(near, far, side, depth)
    lowest, highest = float(ground[:, 2].min()) - 0.3, float(ground[:, 2].max())
    ground[:, 2] = lowest
    eaves = raised(ground, highest - lowest + 2.0 * STOREY_M + 0.5)
    front, plain = paint.alike(rng), paint.plain(rng, 6.0, 6.0, 150.0, 8.0)
    sides = (plain, front, plain, plain) if side > 0.0 else (plain, plain, plain, front)
    builder.add_prism(ground, eaves, sides, plain)
    _add_roof(np.random.default_rng(0), builder, paint, eaves, width, depth)


def _add_roof(
    rng: Rng, builder: SurfaceBuilder, paint: WallPaint, eaves: Array, width: float, depth: float
) -> None:
    """A hipped roof with eaves that stand out, and a chimney."""
    rise = float(rng.uniform(2.2, 4.0))
    centre = eaves.mean(axis=0)
    across = (
        eaves[1] - eaves[0] if abs(np.linalg.norm(eaves[1] - eaves[0]) - depth) < 1e-6 else eaves[2] - eaves[1]
    )
    across = across / np.linalg.norm(across)
    offsets = eaves - centre
    sideways = (offsets @ across)[:, None] * across
    lengthways = offsets - sideways
    low = centre + sideways * (1.0 + 0.8 / depth) + lengthways * (1.0 + 0.8 / width)
    ridge = centre + sideways * 0.06 + lengthways * float(rng.choice([1.0, 0.7])) + [0.0, 0.0, rise]
    slope = paint.roof(rng, width, float(np.hypot(rise, depth / 2.0)))
    hip = paint.roof(rng, depth, rise)
    builder.add_prism(low, ridge, (hip, slope, hip, slope), hip)
    builder.add_quad(low[::-1], hip)  # the eaves from below
    brick = paint.plain(rng, 0.8, 1.2, 95.0, 14.0)
    foot = centre + 0.3 * lengthways[0] + 0.5 * sideways[0] + [0.0, 0.0, 0.2 * rise]
    builder.add_box(foot, _heading_rad(across), (0.8, 0.8, rise + 0.6), brick)


def _add_balconies(
    rng: Rng,
    builder: SurfaceBuilder,
    paint: WallPaint,
    near: Array,
    far: Array,
    side: float,
    lowest: float,
    wall_height: float,
) -> None:
    along = np.append((far - near)[:2], 0.0)
    width = float(np.linalg.norm(along))
    along /= width
    to_street = -side * np.array([-along[1], along[0], 0.0])
    rail = paint.plain(rng, 2.4, 1.0, float(rng.uniform(90.0, 220.0)), 16.0)
    column = float(rng.uniform(0.25, 0.75)) * width
    for storey in range(1, int((wall_height - 1.0) // STOREY_M)):
        centre = near + along * column + to_street * 0.5
        centre[2] = lowest + STOREY_M * storey
        builder.add_box(centre, _heading_rad(along), (2.4, 1.0, 1.0), rail)


def fence(
    rng: Rng, builder: SurfaceBuilder, paint: WallPaint, line: Line, left_m: float, start_m: float, end_m: float
) -> None:
    """A hedge or a low wall along a front garden, with a gate left open."""
    height, hedge = float(rng.uniform(0.5, 1.4)), rng.random() < 0.6
    texture = paint.foliage(rng, 5.0, height) if hedge else paint.plain(rng, 5.0, height, 150.0, 14.0)
    middle = (start_m + end_m) / 2.0
    for s0, s1 in ((start_m + 0.3, middle - 0.8), (middle + 0.8, end_m - 0.3)):
        near, far = line.at(np.array([s0, s1]), left_m)
        foot, along = (near + far) / 2.0, np.append((far - near)[:2], 0.0)
        foot[2] = min(near[2], far[2])
        length = float(np.linalg.norm(along))
        builder.add_box(
            foot, _heading_rad(along), (length, 0.5 if hedge else 0.2, height + abs(near[2] - far[2])), texture
        )


def _heading_rad(direction: Array) -> float:
    return float(np.arctan2(direction[1], direction[0]))
