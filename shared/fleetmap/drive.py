"""One vehicle's recording, whatever file it came from: time-ordered images, fixes and the way they are mounted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose

Array = NDArray[np.float64]

START_NS = 1_700_000_000_000_000_000  # 2023-11-14T22:13:20Z: where relative and simulated times start


@dataclass(frozen=True)
class Frame:
    """One image."""

    stamp_ns: int  # UTC since the epoch, from the message header
    image: NDArray[np.uint8]  # (height, width) grey


@dataclass(frozen=True)
class GnssFix:
    """One valid position of the GNSS antenna (fixes with status -1 never become a GnssFix)."""

    stamp_ns: int  # UTC since the epoch
    lat_deg: float
    lon_deg: float
    height_m: float  # above the ellipsoid
    covariance_enu_m2: Array  # (3, 3) float64, true east, north, up


@dataclass(frozen=True)
class ImuSample:
    """What an inertial measurement unit reports at one instant, in its own frame."""

    stamp_ns: int  # UTC since the epoch
    angular_velocity_rad_s: Array  # (3,) float64
    linear_acceleration_m_s2: Array  # (3,) float64 specific force: at rest it points up with 9.8 m/s^2


@dataclass(frozen=True)
class WheelSpeed:
    """The vehicle's forward speed as its wheels or its odometry report it."""

    stamp_ns: int  # UTC since the epoch
    speed_mps: float  # negative in reverse


@dataclass(frozen=True)
class Antenna:
    """Where the GNSS antenna sits, and how we know."""

    position_in_cam_m: Array  # (3,) float64
    source: str  # "same frame", "static transform", "option", or "assumed at the camera"


@dataclass(frozen=True)
class SensorMounting:
    """How a sensor is mounted, and how we know."""

    cam_from_sensor: Pose
    source: str  # "same frame", "static transform", or "assumed level and forward"


class Drive(Protocol):
    """A recorded drive of one camera. Opening it has checked that it can be read."""

    @property
    def name(self) -> str:
        """What to call the recording in messages and provenance: the file's name."""

    @property
    def camera(self) -> Camera:
        """The calibrated camera of the chosen image topic. Raises CalibrationError where there is none."""

    @property
    def frame_count(self) -> int:
        """Number of images, for progress bars."""

    def frames(self) -> Iterator[Frame]:
        """The images in time order, decoded one at a time. Raises DriveError on the first bad one."""

    def gnss_fixes(self) -> list[GnssFix]:
        """All valid fixes in time order; empty when the recording has none."""

    def antenna(self) -> Antenna:
        """Where the antenna sits in the camera's frame."""

    def imu_samples(self) -> Iterator[ImuSample]:
        """Inertial measurements in time order; nothing when the recording has none."""

    def imu_mounting(self) -> SensorMounting | None:
        """How the IMU is mounted; None without one, or where the recording does not say."""

    def wheel_speeds(self) -> Iterator[WheelSpeed]:
        """Forward speeds in time order; nothing when the recording has none."""

    def wheel_mounting(self) -> SensorMounting | None:
        """The frame (x forward, y left, z up) whose origin has the wheels' speed along x; None without speeds."""
