"""Where a simulated car carries its sensors, seen from the camera.

The camera sits behind the windscreen, midway between the axles. Sensors other than the camera have the axes of the
vehicle: x forward, y left, z up (REP 103).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import CAM_FROM_BODY, Pose

CAMERA_FRAME, ANTENNA_FRAME, IMU_FRAME = "camera", "gnss", "imu"
VEHICLE_FRAME, LIDAR_FRAME = "base_link", "laser"

_REAR_AXLE_BEHIND_M = 1.3
_BUMPER_AHEAD_M, _BUMPER_HEIGHT_M = 2.1, 0.5
_IMU_IN_CAM_M = (0.12, 0.55, -0.4)  # on the middle console


@dataclass(frozen=True)
class Mounting:
    """All of it hangs on the height of the camera above the road and on where the antenna is."""

    camera_height_m: float = 1.65
    antenna_in_cam_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def cam_from_antenna(self) -> Pose:
        """The antenna, with the camera's axes."""
        return Pose(np.eye(3), np.array(self.antenna_in_cam_m, dtype=np.float64))

    @property
    def cam_from_imu(self) -> Pose:
        """The inertial measurement unit."""
        return _at(*_IMU_IN_CAM_M)

    @property
    def cam_from_vehicle(self) -> Pose:
        """``base_link``: on the road under the middle of the rear axle."""
        return _at(0.0, self.camera_height_m, -_REAR_AXLE_BEHIND_M)

    @property
    def cam_from_lidar(self) -> Pose:
        """The 2-D lidar, level in the front bumper."""
        return _at(0.0, self.camera_height_m - _BUMPER_HEIGHT_M, _BUMPER_AHEAD_M)


def _at(right_m: float, down_m: float, forward_m: float) -> Pose:
    return Pose(CAM_FROM_BODY, np.array([right_m, down_m, forward_m]))
