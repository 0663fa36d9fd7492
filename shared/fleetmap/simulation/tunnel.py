"""A tunnel: a concrete tube with lamps, doors and signs, and the hill above it."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from fleetmap.simulation import furniture, textures
from fleetmap.simulation.furniture import TreePaint
from fleetmap.simulation.ground import ROAD_HALF_M
from fleetmap.simulation.palette import Palette
from fleetmap.simulation.plot import under_roof
from fleetmap.simulation.relief import PIECE_M, Terrain
from fleetmap.simulation.surfaces import SurfaceBuilder

Array = NDArray[np.float64]
Rng = np.random.Generator

HILL_HALF_M = 36.0
_TUBE_HALF_M, _TUBE_HEIGHT_M = ROAD_HALF_M + 1.0, 5.4
_HILL_HEIGHT_M, _HILL_FOOT_M = 9.0, -1.5
_LAMP_EVERY_M = 9.0


def dig_tunnel(
    rng: Rng, builder: SurfaceBuilder, palette: Palette, terrain: Terrain, along_m: tuple[float, float]
) -> None:
    """Build the tube and the hill over a road along the u axis, from u to u."""
    cuts = np.linspace(*along_m, int(np.ceil((along_m[1] - along_m[0]) / PIECE_M)) + 1)
    for low, high in itertools.pairwise(cuts.tolist()):
        light = float(under_roof((low + high) / 2.0, (along_m,)))
        _line_walls(rng, builder, palette, terrain, (low, high), light)
        _cover(rng, builder, palette, terrain, (low, high))
    for u in np.arange(along_m[0] + 4.0, along_m[1] - 2.0, _LAMP_EVERY_M):
        _hang_lamp(builder, palette, terrain, float(u))
    for u, towards in ((along_m[0], -1.0), (along_m[1], 1.0)):
        _build_portal(rng, builder, palette, terrain, u, towards)
    trees = TreePaint(palette.crowns(), palette.bark())
    for _ in range(int((along_m[1] - along_m[0]) / 5.0)):
        u, v = rng.uniform(along_m[0] + 3.0, along_m[1] - 3.0), rng.uniform(-22.0, 22.0)
        furniture.plant_tree(
            rng, builder, trees, terrain.at(u, v, _hill_above(terrain, v) + _level(terrain, v) - 0.1)
        )


def _line_walls(
    rng: Rng, builder: SurfaceBuilder, palette: Palette, terrain: Terrain, u: tuple[float, float], light: float
) -> None:
    low, high = u
    for v, ends in ((-_TUBE_HALF_M, (high, low)), (_TUBE_HALF_M, (low, high))):  # left end first, seen from inside
        foot = terrain.at(np.array(ends), v)
        wall = palette.pick(
            rng, "tunnel wall", 14, lambda own: textures.paint_tunnel_wall(own, PIECE_M, _TUBE_HEIGHT_M)
        )
        top = terrain.at(np.array(ends), v, _TUBE_HEIGHT_M + _level(terrain, v))
        builder.add_quad(np.stack([top[0], top[1], foot[1], foot[0]]), wall, lit=False, shade=1.1 * light)
    roof = palette.pick(
        rng, "tunnel roof", 6, lambda own: textures.paint_plain(own, 2.0 * _TUBE_HALF_M, PIECE_M, 105.0, 16.0)
    )
    builder.add_quad(_across(terrain, (high, low), _TUBE_HALF_M, _TUBE_HEIGHT_M), roof, lit=False, shade=light)


def _level(terrain: Terrain, v: float) -> float:
    """What to add above v for the height above the road's middle."""
    return float(terrain.across.height_m(0.0) - terrain.across.height_m(v))


def _across(terrain: Terrain, u: tuple[float, float], half_m: float, above_m: float) -> Array:
    """Corners (4, 3) of a piece that lies level across, from (u[1], left); seen from above when u rises."""
    v = np.array([half_m, -half_m, -half_m, half_m])
    return terrain.at(np.array([u[1], u[1], u[0], u[0]]), v, above_m + np.array([_level(terrain, x) for x in v]))


def _hill_above(terrain: Terrain, v: float) -> float:
    """Height of the hill at v above the road's middle: down to just below the ground at its foot."""
    foot = float(np.sign(v)) * HILL_HALF_M
    foot_above = _HILL_FOOT_M - _level(terrain, foot)
    share = max(abs(v) - _TUBE_HALF_M, 0.0) / (HILL_HALF_M - _TUBE_HALF_M)
    return _HILL_HEIGHT_M + share * (foot_above - _HILL_HEIGHT_M)


def _cover(rng: Rng, builder: SurfaceBuilder, palette: Palette, terrain: Terrain, u: tuple[float, float]) -> None:
    """The hill over one piece of the tube: its top and two slopes."""
    grass = [
        palette.pick(rng, "hill", 4, lambda own: textures.paint_grass(own, PIECE_M, 30.0, 14.0)) for _ in range(2)
    ]
    top = _across(terrain, u, _TUBE_HALF_M, _HILL_HEIGHT_M)
    builder.add_quad(top, grass[0])
    feet = terrain.at(np.array([u[1], u[0]])[:, None], np.array([HILL_HALF_M, -HILL_HALF_M]), _HILL_FOOT_M)
    foot = np.stack([feet[0, 0], feet[0, 1], feet[1, 1], feet[1, 0]])
    builder.add_quad(np.stack([foot[0], top[0], top[3], foot[3]]), grass[1])
    builder.add_quad(np.stack([top[1], foot[1], foot[2], top[2]]), grass[1])


def _build_portal(
    rng: Rng, builder: SurfaceBuilder, palette: Palette, terrain: Terrain, u: float, towards: float
) -> None:
    """The face of the hill around an end of the tube; ``towards`` is the direction it faces along u."""
    left = -towards  # of the face, as one stands before it: v grows to the left when one looks along u
    stone = palette.pick(rng, "portal", 2, lambda own: textures.paint_plain(own, 6.0, 9.0, 150.0, 14.0))

    def corner(v: float, above: float) -> Array:
        return terrain.at(u, v, above + _level(terrain, v))

    def column(right: float, left_end: float) -> None:
        """A piece of the face between two v, as high as the hill is there."""
        ends = (left_end, right) if left > 0.0 else (right, left_end)
        tops = [corner(v, _hill_above(terrain, v)) for v in ends]
        feet = [corner(v, lowest) for v in reversed(ends)]
        builder.add_quad(np.stack([*tops, *feet]), stone)

    edges = np.linspace(_TUBE_HALF_M, HILL_HALF_M, 6)
    lowest = min(_hill_above(terrain, v) for v in (-HILL_HALF_M, HILL_HALF_M)) - 2.0
    for near, far in itertools.pairwise(edges.tolist()):
        column(near, far)
        column(-far, -near)
    first, second = left * _TUBE_HALF_M, -left * _TUBE_HALF_M
    lintel = [corner(first, _HILL_HEIGHT_M), corner(second, _HILL_HEIGHT_M)]
    builder.add_quad(np.stack([*lintel, corner(second, _TUBE_HEIGHT_M), corner(first, _TUBE_HEIGHT_M)]), stone)


def _hang_lamp(builder: SurfaceBuilder, palette: Palette, terrain: Terrain, u: float) -> None:
    glow = palette.numbered("glow", 0, lambda own: textures.paint_plain(own, 1.4, 0.3, 240.0, 4.0))
    for v in (-2.6, 2.6):
        middle = terrain.at(u, v, _TUBE_HEIGHT_M - 0.12 + _level(terrain, v))
        along = terrain.at(u + 0.7, v) - terrain.at(u - 0.7, v)
        across = terrain.at(u, v + 0.15) - terrain.at(u, v - 0.15)
        half = [(-0.5, 0.5), (0.5, 0.5), (0.5, -0.5), (-0.5, -0.5)]
        builder.add_quad(
            np.stack([middle + a * along + b * across for a, b in half])[::-1], glow, lit=False, is_lamp=True
        )
