"""How one camera sits in the frame of another, when a map has calibrated the other anew."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, quat_xyzw_from_rotations, rotation_angle_rad

Array = NDArray[np.float64]

_GRID = (33, 17)  # rays over the image


def map_from_recorded(recorded: Camera, mapped: Camera) -> Array:
    """Rotation (3, 3) from the axes of a camera as it was recorded to its axes as a map has calibrated it.

    A camera's axes are what its image centre says they are. Moved by 20 px of 984 they are turned by 1.2 deg, and
    with them every pose of the map's cameras; nothing in the world has turned. It is the rotation that best takes
    the rays of the image's pixels as recorded to those as calibrated.
    """
    right, bottom = recorded.width_px - 1.0, recorded.height_px - 1.0
    grid = np.meshgrid(np.linspace(0.0, right, _GRID[0]), np.linspace(0.0, bottom, _GRID[1]))
    pixels = np.stack(grid, axis=2).reshape(-1, 2)
    rays = [_unit(camera.unproject(pixels)) for camera in (mapped, recorded)]
    kept = np.all(np.isfinite(np.hstack(rays)), axis=1)
    turn, _ = Rotation.align_vectors(rays[0][kept], rays[1][kept])
    return np.asarray(turn.as_matrix())


def _unit(rays: Array) -> Array:
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


@dataclass(frozen=True)
class CameraPair:
    """Where a query's camera is in the frame of the survey's, as the map has it."""

    survey_from_query: Pose
    axes_turned_deg: float  # by the map's calibration of the survey's camera

    @staticmethod
    def of(recorded_from_query: Pose, recorded: Camera, mapped: Camera) -> CameraPair:
        """From the calibration of the pair, and the survey camera's calibrations before and after."""
        turn = Pose(map_from_recorded(recorded, mapped), np.zeros(3))
        return CameraPair(turn @ recorded_from_query, float(np.degrees(rotation_angle_rad(turn.rotation))))

    @property
    def options(self) -> str:
        """For ``fleetmap evaluate --against-map``."""
        offset_m, rotation = self.survey_from_query.translation_m, self.survey_from_query.rotation
        offset = ",".join(f"{value:.4f}" for value in offset_m)
        turned = ",".join(f"{value:.6f}" for value in quat_xyzw_from_rotations(rotation))
        return f"--camera-offset {offset} --camera-rotation {turned}"
