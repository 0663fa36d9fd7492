"""A world to drive through: what stands still, what moves, and where everything truly is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import InputError
from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Pose
from fleetmap.simulation.atlas import Atlas
from fleetmap.simulation.street import build_street
from fleetmap.simulation.surfaces import Surfaces

Array = NDArray[np.float64]

WORLD_KINDS = ("city", "straight", "tunnel", "open", "facades", "street")


class Path(Protocol):
    """The centre of the right-hand lane. A closed path takes any ``s_m``: one lap after the other."""

    def at(self, s_m: Array | float, left_m: Array | float = 0.0, above_m: Array | float = 0.0) -> Array:
        """Map points (..., 3) beside the path, above the ground."""

    def heading_rad(self, s_m: Array | float) -> Array:
        """Direction of travel, counter-clockwise from grid east; it goes on growing from lap to lap."""

    def up(self, s_m: Array | float) -> Array:
        """Unit normals (..., 3) of the road."""


@dataclass(frozen=True)
class Scene:
    """What any sensor sees at one moment, in the map frame."""

    surfaces: Surfaces
    atlas: Atlas


@dataclass(frozen=True)
class Marker:
    """A square ArUco marker on a wall or a board."""

    number: int  # its id in the dictionary
    dictionary: str  # such as "DICT_5X5_100": the name in cv2.aruco
    side_m: float  # outer edge of the black square
    map_from_marker: Pose  # origin in the middle, x right, y up as one looks at it, z out of the wall


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

    def scene_at(self, seconds: float) -> Scene:
        """The scene with the moving cars where they are ``seconds`` after the start of the drive.

        Their surfaces follow those of ``scene``: numbers from ``len(scene.surfaces)`` on move.
        """
        return self.scene


def build_world(
    seed: int,
    *,
    kind: str = "city",
    length_m: float = 300.0,
    drive_seed: int = 0,
    parked_cars_changed: float = 0.3,
    moving_cars_per_km: float = 0.0,
    own_lane_m: float = 0.0,
    own_speed_mps: float = 8.0,
    sun_deg: tuple[float, float] | None = None,
    lat_deg: float = 48.77,
    lon_deg: float = 11.43,
    height_m: float = 420.0,
) -> World:
    """Build the world of a seed, as one drive finds it. Equal arguments give equal worlds.

    Raises:
        InputError: no such kind of world, or a length that cannot be built.
    """
    if kind not in WORLD_KINDS:
        raise InputError(f"there is no world of kind {kind!r}; choose from {', '.join(WORLD_KINDS)}")
    street = build_street(seed, length_m, lat_deg=lat_deg, lon_deg=lon_deg, height_m=height_m)
    return World(street.anchor, street.path, street.length_m, False, Scene(street.surfaces, street.atlas))
