"""A world to drive through: what stands still, what moves, and where everything truly is.

A seed fixes roads, houses, trees, hills and markers; a drive's own seed the cars that park and move on its day,
and where the sun stands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import InputError
from fleetmap.geodesy import UtmAnchor
from fleetmap.simulation import traffic
from fleetmap.simulation.atlas import Atlas, build_atlas
from fleetmap.simulation.blocks import SHORTEST_CIRCUIT_M, lay_city, lay_facades
from fleetmap.simulation.country import lay_straight, lay_tunnel
from fleetmap.simulation.ground import lay_far_ground
from fleetmap.simulation.horizon import raise_horizon
from fleetmap.simulation.markers import Marker, set_up_markers
from fleetmap.simulation.palette import Palette
from fleetmap.simulation.path import Line
from fleetmap.simulation.plot import Plot
from fleetmap.simulation.roads import RoadPath
from fleetmap.simulation.square import lay_open
from fleetmap.simulation.street import Street, anchor_at, build_street
from fleetmap.simulation.surfaces import SurfaceBuilder, Surfaces
from fleetmap.simulation.traffic import Traffic

Array = NDArray[np.float64]
Rng = np.random.Generator

WORLD_KINDS = ("city", "straight", "tunnel", "open", "facades", "street")
LONGEST_M, MOST_CARS_PER_KM = 3200.0, 150.0
_HORIZON_M = 150.0  # from the path to the ring of hills, at least


class Path(Line, Protocol):
    """The centre of the right-hand lane. A closed path takes any ``s_m``: one lap after the other.

    Its heading goes on growing from lap to lap.
    """

    def up(self, s_m: Array | float) -> Array:
        """Unit normals (..., 3) of the road."""


@dataclass(frozen=True)
class Scene:
    """What any sensor sees at one moment, in the map frame."""

    surfaces: Surfaces
    atlas: Atlas


@dataclass(frozen=True)
class World:
    """A world for one drive, in the map frame of ``anchor``: grid east, grid north, height in metres."""

    anchor: UtmAnchor
    path: Path
    length_m: float  # drivable: s from 0 to here along the path; of one lap, when closed
    is_closed: bool
    scene: Scene  # what stands still
    markers: tuple[Marker, ...] = ()
    tunnels_m: tuple[tuple[float, float], ...] = ()  # stretches (start, end) along the path without sky
    traffic: Traffic | None = None

    @staticmethod
    def of_street(street: Street) -> World:
        """A street, as a world without traffic."""
        return World(street.anchor, street.path, street.length_m, False, Scene(street.surfaces, street.atlas))

    @property
    def surfaces(self) -> Surfaces:
        """What stands still."""
        return self.scene.surfaces

    @property
    def atlas(self) -> Atlas:
        """The textures of all that stands or moves."""
        return self.scene.atlas

    def scene_at(self, seconds: float) -> Scene:
        """The scene with the moving cars where they are ``seconds`` after the start of the drive.

        Their surfaces follow those of ``scene``: numbers from ``len(scene.surfaces)`` on move.
        """
        if self.traffic is None:
            return self.scene
        return Scene(self.scene.surfaces.joined(self.traffic.surfaces_at(seconds)), self.scene.atlas)


def build_world(
    seed: int,
    *,
    kind: str = "city",
    length_m: float = 300.0,
    variant: int = 0,
    drive_seed: int = 0,
    parked_cars_changed: float = 0.3,
    moving_cars_per_km: float = 8.0,
    own_lane_m: float = 0.0,
    own_speed_mps: float = 8.0,
    sun_deg: tuple[float, float] | None = None,
    lat_deg: float = 48.77,
    lon_deg: float = 11.43,
    height_m: float = 420.0,
) -> World:
    """Build the world of a seed, as one drive finds it. Equal arguments give equal worlds.

    Args:
        seed: of all that stays the same from drive to drive.
        kind: "city": a circuit around blocks; "straight": a road out of town; "tunnel": a road through a hill;
            "open": a circuit on a wide place; "facades": a circuit among houses that look alike; "street": one
            bend, no traffic.
        length_m: of the path; of one lap on a circuit.
        variant: other than 0, a street that could be taken for the seed's own: of the same shape, with three
            quarters of its walls, roofs, hedges and pieces of road painted otherwise, other crowns on its trees,
            other cars and other hills around. "street" has none.
        drive_seed: of parked cars, moving cars and the sun.
        parked_cars_changed: share of the parked cars that differ between any two drive seeds.
        moving_cars_per_km: oncoming cars; if any, one more drives ahead (a van 6 m ahead from 60 per km on).
        own_lane_m: the recording vehicle's lane, as an offset to the left: oncoming cars keep to the other one.
        own_speed_mps: the recording vehicle's speed, which the car ahead keeps, from s = 0 at 0 seconds.
        sun_deg: azimuth from north by east, and elevation; by default the drive's seed chooses.
        lat_deg, lon_deg, height_m: the site (ellipsoidal height).

    Raises:
        InputError: no such kind of world, or no variant of it, a length or a number that makes no sense, or a
            site outside UTM.
    """
    if kind not in WORLD_KINDS:
        raise InputError(f"there is no world of kind {kind!r}; choose from {', '.join(WORLD_KINDS)}")
    if kind == "street":
        if variant:
            raise InputError("a world of kind 'street' has no variants")
        return World.of_street(build_street(seed, length_m, lat_deg=lat_deg, lon_deg=lon_deg, height_m=height_m))
    _require_sense(length_m, parked_cars_changed, moving_cars_per_km)
    anchor = anchor_at(lat_deg, lon_deg, height_m)
    plan_rng, far_rng = np.random.default_rng(seed).spawn(2)
    if variant:
        far_rng = np.random.default_rng([seed, variant])
    drive_rng = np.random.default_rng([seed, drive_seed])
    builder = SurfaceBuilder(_towards_sun(drive_rng, sun_deg))
    palette = Palette(seed, builder, variant=variant)
    plot = _LAYOUTS[kind](plan_rng, builder, palette, length_m)
    markers = set_up_markers(builder, palette, plot)
    lay_horizon(far_rng, builder, plot.path)
    cars_seed = seed + (variant << 31)
    traffic.park_cars(builder, palette, plot.kerbs, cars_seed, drive_seed, parked_cars_changed)
    moving = traffic.send_traffic(
        drive_rng,
        builder,
        palette,
        plot.path,
        (0.0, length_m) if plot.path.is_closed else (-40.0, length_m + 80.0),
        is_closed=plot.path.is_closed,
        cars_per_km=moving_cars_per_km,
        own_lane_m=own_lane_m,
        own_speed_mps=own_speed_mps,
        tunnels_m=plot.tunnels_m,
    )
    scene = Scene(builder.surfaces(), build_atlas(builder.textures))
    path = plot.path
    return World(anchor, path, path.length_m, path.is_closed, scene, markers, plot.tunnels_m, moving)


def _require_sense(length_m: float, parked_cars_changed: float, moving_cars_per_km: float) -> None:
    if not SHORTEST_CIRCUIT_M <= length_m <= LONGEST_M:
        raise InputError(
            f"a world of {length_m} m cannot be built; give {SHORTEST_CIRCUIT_M:.0f} to {LONGEST_M:.0f} m"
        )
    if not (0.0 <= parked_cars_changed <= 1.0 and 0.0 <= moving_cars_per_km <= MOST_CARS_PER_KM):
        raise InputError(
            f"{parked_cars_changed} is no share of the parked cars, or {moving_cars_per_km} moving cars per km"
            f" do not fit; give 0 to 1, and 0 to {MOST_CARS_PER_KM:.0f}"
        )


def _towards_sun(rng: Rng, sun_deg: tuple[float, float] | None) -> Array:
    """Unit vector (3,) towards the sun, in the map frame."""
    drawn = float(rng.uniform(0.0, 360.0)), float(rng.uniform(25.0, 60.0))
    azimuth, elevation = np.radians(drawn if sun_deg is None else sun_deg)
    across, up = np.cos(elevation), np.sin(elevation)
    return np.array([np.sin(azimuth) * across, np.cos(azimuth) * across, up])


def lay_horizon(rng: Rng, builder: SurfaceBuilder, path: RoadPath) -> None:
    """Fields and hills around a path, so that no line of sight ends in nothing but the sky."""
    positions = path.at(np.arange(0.0, path.length_m, 5.0))
    centre = (positions.min(axis=0) + positions.max(axis=0)) / 2.0
    radius = float(np.linalg.norm((positions - centre)[:, :2], axis=1).max()) + _HORIZON_M
    centre[2] = lay_far_ground(rng, builder, path, radius)
    raise_horizon(rng, builder, centre, radius, pictures=6)


_LAYOUTS: dict[str, Callable[[Rng, SurfaceBuilder, Palette, float], Plot]] = {
    "city": lay_city,
    "facades": lay_facades,
    "straight": lay_straight,
    "tunnel": lay_tunnel,
    "open": lay_open,
}
