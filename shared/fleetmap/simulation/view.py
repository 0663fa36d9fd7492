"""The part of a scene that a camera sees from its pose, or from several while its shutter rolls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Pose, rotation_angle_rad
from fleetmap.simulation.atlas import Atlas
from fleetmap.simulation.planes import INVERSE, planes_in_cam, surfaces_in_cone
from fleetmap.simulation.rays import RayTable
from fleetmap.simulation.surfaces import Surfaces
from fleetmap.simulation.visibility import see

Array = NDArray[np.float64]

_SMALLEST_RADIUS_PX = 0.35  # surfaces that look smaller than this are left out


class Scene(Protocol):
    """What any sensor sees at one moment, in the map frame."""

    @property
    def surfaces(self) -> Surfaces:
        """Everything that has a place."""

    @property
    def atlas(self) -> Atlas:
        """The textures on it."""


@dataclass(frozen=True)
class View:
    """Which surface each sample of each pixel sees; tiles as in RayTable."""

    table: RayTable
    samples_px: NDArray[np.float32]  # (K, 2) x and y beside the pixel's centre
    ids: NDArray[np.int64]  # (M,) the surfaces that may be in view, nearest first
    planes: NDArray[np.float32]  # (1 or B, M, 4, 3) as in planes.planes_in_cam, for all bands of rows or each
    seen: NDArray[np.int32]  # (B, T, K, TILE_PIXELS) indices into ``ids``, or NOTHING
    nearest: NDArray[np.float32]  # (B, T, K, TILE_PIXELS) inverse distance in 1/m; 0 for the sky


def view_of(scene: Scene, table: RayTable, poses: list[Pose], samples_px: Array) -> View:
    """What a camera sees from a pose ``map_from_cam``, or from one for each of its bands, on a straight way."""
    surfaces, middle = scene.surfaces, poses[len(poses) // 2]
    turn_rad = max(float(rotation_angle_rad(middle.rotation.T @ pose.rotation)) for pose in (poses[0], poses[-1]))
    moves_m = [pose.translation_m - middle.translation_m for pose in (poses[0], poses[-1])]
    ids, _ = surfaces_in_cone(
        surfaces,
        middle.translation_m,
        middle.rotation[:, 2],
        widest_rad=table.widest_rad + turn_rad,
        smallest_rad=_SMALLEST_RADIUS_PX * table.finest_rad,
        slack_m=float(np.linalg.norm(moves_m, axis=1).max()),
    )
    # What is turned away from both ends of a straight way is turned away all along.
    at_ends = planes_in_cam(surfaces, ids, (poses[0], poses[-1]))
    ids = ids[at_ends[:, :, INVERSE].any(axis=(0, 2))]
    planes = planes_in_cam(surfaces, ids, poses)
    samples = samples_px.astype(np.float32)
    seen, nearest = see(planes, surfaces.texture_indices[ids], scene.atlas.packed_opacities, table, samples)
    return View(table, samples, ids, planes, seen, nearest)
