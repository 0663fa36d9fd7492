"""What stands in a street: parked cars, trees, lamps, signs, bins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.simulation import textures
from fleetmap.simulation.path import Line
from fleetmap.simulation.surfaces import SurfaceBuilder, raised
from fleetmap.simulation.vehicles import CarPaint, paint_car, park_car

Array = NDArray[np.float64]
Rng = np.random.Generator


def park_cars(rng: Rng, builder: SurfaceBuilder, line: Line, left_m: float, span: Array) -> None:
    """Cars along one kerb, some places free."""
    paints = [paint_car(rng, builder) for _ in range(5)]
    for slot in np.arange(span[0], span[1], 5.9):
        if rng.random() < 0.45:
            continue
        park_beside(rng, builder, paints, line, slot + float(rng.uniform(-0.3, 0.3)), left_m)


def park_beside(
    rng: Rng, builder: SurfaceBuilder, paints: Sequence[CarPaint], line: Line, s_m: float, left_m: float
) -> None:
    """One of the cars beside a line, facing either way."""
    near, far = line.at(np.array([s_m - 1.5, s_m + 1.5]), left_m + float(rng.normal(0.0, 0.06)))
    forward = (far - near) / np.linalg.norm(far - near) * float(rng.choice([-1.0, 1.0]))
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left)
    axes = np.column_stack([forward, left, np.cross(forward, left)])
    paint = paints[int(rng.integers(len(paints)))]
    park_car(builder, paint, axes, (near + far) / 2.0, float(rng.uniform(0.92, 1.08)))


@dataclass(frozen=True)
class TreePaint:
    """Texture numbers of trees."""

    leaves: list[int]
    bark: int


@dataclass(frozen=True)
class FurniturePaint:
    """Texture numbers of lamps, signs and boxes."""

    metal: int
    signs: list[int]
    boxes: list[int]


def paint_trees(rng: Rng, builder: SurfaceBuilder) -> TreePaint:
    """Paint a street's trees."""
    leaves = []
    for _ in range(6):
        grey = textures.paint_foliage(rng, 4.8, 4.8)
        leaves.append(builder.add_texture(grey, textures.cut_crown(rng, grey)))
    return TreePaint(leaves, builder.add_texture(textures.paint_plain(rng, 0.4, 2.6, 70.0, 16.0)))


def paint_furniture(rng: Rng, builder: SurfaceBuilder) -> FurniturePaint:
    """Paint a street's furniture."""
    metal = builder.add_texture(textures.paint_plain(rng, 0.2, 6.0, 130.0, 14.0))
    signs = [builder.add_texture(textures.paint_sign(rng, 0.7, 0.7)) for _ in range(5)]
    boxes = [builder.add_texture(textures.paint_sign(rng, 1.1, 1.1)) for _ in range(4)]
    return FurniturePaint(metal, signs, boxes)


def plant_trees(
    rng: Rng, builder: SurfaceBuilder, paint: TreePaint, line: Line, left_m: float, span: Array
) -> None:
    """A row of trees."""
    s = float(span[0])
    while s < span[1]:
        plant_tree(rng, builder, paint, line.at(s, left_m + float(rng.normal(0.0, 0.1))))
        s += float(rng.uniform(8.0, 19.0))


def plant_tree(rng: Rng, builder: SurfaceBuilder, paint: TreePaint, foot: Array) -> None:
    """A trunk, and a crown of crossing leafy sheets."""
    height, size = float(rng.uniform(1.8, 2.8)), float(rng.uniform(2.6, 5.2))
    builder.add_box(foot, float(rng.uniform(0.0, np.pi)), (0.34, 0.34, height + 0.3 * size), paint.bark)
    for direction in float(rng.uniform(0.0, np.pi)) + np.arange(3) * np.pi / 3.0:
        aside = 0.5 * size * np.array([np.cos(direction), np.sin(direction), 0.0])
        low = raised(foot, height - 0.1 * size)
        high = raised(low, size * float(rng.uniform(0.9, 1.2)))
        sheet = np.stack([high - aside, high + aside, low + aside, low - aside])
        leaves = int(rng.choice(paint.leaves))
        builder.add_quad(sheet, leaves, two_sided=True, lit=False, shade=float(rng.uniform(0.75, 1.1)))


def place_furniture(
    rng: Rng, builder: SurfaceBuilder, paint: FurniturePaint, line: Line, left_m: float, span: Array
) -> None:
    """Lamp posts, traffic signs and junction boxes along one kerb."""
    for s in np.arange(span[0] + 4.0, span[1], 9.0):
        where = s + float(rng.uniform(-2.5, 2.5))
        foot, heading = line.at(where, left_m), float(line.heading_rad(where))
        kind = rng.random()
        if kind < 0.35:
            put_up_lamp(builder, paint.metal, foot, heading, 6.2)
        elif kind < 0.7:
            builder.add_box(foot, heading, (0.07, 0.07, 3.0), paint.metal)
            builder.add_box(raised(foot, 2.2), heading, (0.03, 0.7, 0.7), int(rng.choice(paint.signs)))
        else:
            size = (float(rng.uniform(0.5, 1.1)), float(rng.uniform(0.4, 0.6)), float(rng.uniform(0.8, 1.3)))
            builder.add_box(foot, heading, size, int(rng.choice(paint.boxes)))


def put_up_lamp(builder: SurfaceBuilder, metal: int, foot: Array, heading_rad: float, height_m: float) -> None:
    """A lamp post."""
    builder.add_box(foot, heading_rad, (0.14, 0.14, height_m), metal)
    builder.add_box(raised(foot, height_m), heading_rad, (0.9, 0.3, 0.15), metal)
    _hang_lamp(builder, raised(foot, height_m - 0.01), heading_rad, metal)


def _hang_lamp(builder: SurfaceBuilder, middle: Array, heading_rad: float, texture: int) -> None:
    """The lamp itself: a plate that faces the street from above."""
    along = 0.42 * np.array([np.cos(heading_rad), np.sin(heading_rad), 0.0])
    left = 0.13 * np.array([-np.sin(heading_rad), np.cos(heading_rad), 0.0])
    corners = middle + np.stack([along + left, -along + left, -along - left, along - left])
    builder.add_quad(corners, texture, is_lamp=True)
