"""A street with everything in it: built from a seed, known exactly.

Cross-section, in metres to the left of the path (the centre of the right-hand lane): front gardens and houses,
pavement, parked cars, two lanes of 3.5 m, parked cars, pavement, front gardens and houses. Depths reach from
three metres (parked cars) to two hundred (the horizon).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import InputError
from fleetmap.geodesy import UtmAnchor, UtmGrid
from fleetmap.simulation import furniture, houses, textures
from fleetmap.simulation.atlas import Atlas, build_atlas
from fleetmap.simulation.horizon import raise_horizon
from fleetmap.simulation.path import StreetPath, build_path
from fleetmap.simulation.surfaces import SurfaceBuilder, Surfaces

Array = NDArray[np.float64]
Rng = np.random.Generator

_RIGHT_KERB_M, _LEFT_KERB_M = -4.3, 7.8
_PAVEMENT_M, _KERB_HEIGHT_M = 2.4, 0.12
_GARDEN_M = 13.0
_BEFORE_M, _AFTER_M = 12.0, 90.0  # built before the start and after the end, so that the view never ends early
_HORIZON_M = 220.0
_SHORTEST_M, _LONGEST_M = 10.0, 500.0  # beyond it, textures need hundreds of megabytes


@dataclass(frozen=True)
class Street:
    """A world to drive through, in the map frame of ``anchor``: grid east, grid north, height in metres."""

    anchor: UtmAnchor
    length_m: float  # drivable: s from 0 to here along the path
    path: StreetPath
    surfaces: Surfaces
    atlas: Atlas


def build_street(
    seed: int,
    length_m: float = 150.0,
    *,
    lat_deg: float = 48.77,
    lon_deg: float = 11.43,
    height_m: float = 420.0,
) -> Street:
    """Build the street of a seed at a site (ellipsoidal height). Equal arguments give equal streets.

    Raises:
        InputError: a length that is too small or too large for its textures, or a site outside UTM.
    """
    if not _SHORTEST_M <= length_m <= _LONGEST_M:
        raise InputError(f"a street of {length_m} m cannot be built; give {_SHORTEST_M:.0f} to {_LONGEST_M:.0f} m")
    path_rng, ground_rng, house_rng, furniture_rng, far_rng = np.random.default_rng(seed).spawn(5)
    path = build_path(path_rng, length_m, _BEFORE_M, _AFTER_M)
    builder = SurfaceBuilder(_sun(path_rng))
    span = np.array([-_BEFORE_M, length_m + _AFTER_M - 25.0])
    _lay_ground(ground_rng, builder, path)
    houses.build_row(house_rng, builder, path, -1.0, _PAVEMENT_M - _RIGHT_KERB_M, span)
    houses.build_row(house_rng, builder, path, 1.0, _LEFT_KERB_M + _PAVEMENT_M, span)
    houses.build_behind(house_rng, builder, path, span)
    for kerb, side in ((_RIGHT_KERB_M, -1.0), (_LEFT_KERB_M, 1.0)):
        furniture.park_cars(furniture_rng, builder, path, kerb - side * 1.05, span)
        trees = furniture.paint_trees(furniture_rng, builder)
        furniture.plant_trees(furniture_rng, builder, trees, path, kerb + side * 1.2, span)
        paint = furniture.paint_furniture(furniture_rng, builder)
        furniture.place_furniture(furniture_rng, builder, paint, path, kerb + side * 0.45, span)
    _raise_horizon(far_rng, builder, path)
    anchor = anchor_at(lat_deg, lon_deg, height_m)
    return Street(anchor, length_m, path, builder.surfaces(), build_atlas(builder.textures))


def anchor_at(lat_deg: float, lon_deg: float, height_m: float) -> UtmAnchor:
    """The anchor of a world at a site (ellipsoidal height), in the site's UTM zone.

    Raises:
        InputError: a site outside UTM.
    """
    utm = UtmGrid.at(lat_deg, lon_deg)
    easting, northing, _ = utm.from_geodetic(np.array(lat_deg), np.array(lon_deg), np.array(height_m))
    return UtmAnchor(utm.epsg, round(float(easting)), round(float(northing)), round(height_m))


def _sun(rng: Rng) -> Array:
    """Unit vector (3,) towards the sun, in the map frame."""
    azimuth, elevation = rng.uniform(0.0, 2.0 * np.pi), np.radians(rng.uniform(30.0, 50.0))
    across, up = np.cos(elevation), np.sin(elevation)
    return np.array([np.cos(azimuth) * across, np.sin(azimuth) * across, up])


def _lay_ground(rng: Rng, builder: SurfaceBuilder, path: StreetPath) -> None:
    knots = path.knots(float(path.s_m[0]), float(path.s_m[-1]) - 12.0)
    right, left = _RIGHT_KERB_M, _LEFT_KERB_M
    stone = builder.add_texture(textures.paint_plain(rng, 6.0, _KERB_HEIGHT_M, 170.0, 14.0))
    for start, end in itertools.pairwise(knots):
        length = float(end - start)
        road = textures.paint_road(rng, length, left - right, [left - 1.75, left + 1.75, left - 5.25])
        _strip(builder, path, start, end, left, right, 0.0, builder.add_texture(road))
        for kerb, side in ((right, -1.0), (left, 1.0)):
            inner, outer = kerb + side * _PAVEMENT_M, kerb + side * (_PAVEMENT_M + _GARDEN_M)
            pavement = builder.add_texture(textures.paint_pavement(rng, length, _PAVEMENT_M))
            garden = builder.add_texture(textures.paint_grass(rng, length, _GARDEN_M))
            _strip(builder, path, start, end, max(kerb, inner), min(kerb, inner), _KERB_HEIGHT_M, pavement)
            _strip(builder, path, start, end, max(inner, outer), min(inner, outer), _KERB_HEIGHT_M, garden)
            low, high = (path.at(np.array([start, end]), kerb, z) for z in (0.0, _KERB_HEIGHT_M))
            first, last = (1, 0) if side < 0.0 else (0, 1)
            builder.add_quad(np.stack([high[first], high[last], low[last], low[first]]), stone)


def _strip(
    builder: SurfaceBuilder,
    path: StreetPath,
    start: float,
    end: float,
    left: float,
    right: float,
    z: float,
    paint: int,
) -> None:
    """A piece of ground between two offsets; its texture's rows run against the direction of travel."""
    corners = path.at(np.array([end, end, start, start]), np.array([left, right, right, left]), z)
    builder.add_quad(corners, paint)


def _raise_horizon(rng: Rng, builder: SurfaceBuilder, path: StreetPath) -> None:
    """A plain of grass under everything, and a ring of far hills and roofs around it."""
    centre = (path.positions_m.min(axis=0) + path.positions_m.max(axis=0)) / 2.0
    centre[2] = path.positions_m[:, 2].min() - 0.6
    extent = float(np.linalg.norm(path.positions_m - centre, axis=1).max()) + 60.0
    radius, tile = max(_HORIZON_M, extent), 60.0
    grass = builder.add_texture(textures.paint_grass(rng, tile, tile, 8.0))
    count = int(np.ceil(2.0 * radius / tile))
    corner = np.array([-radius, -radius, 0.0]) + centre
    square = tile * np.array([[0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    for i in range(count):
        for j in range(count):
            builder.add_quad(corner + square + [tile * i, tile * j, 0.0], grass)
    raise_horizon(rng, builder, centre, radius)
