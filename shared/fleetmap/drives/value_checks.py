"""What makes a message's numbers a fix, a rigid transform, a matrix or an inertial sample, in any encoding."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fleetmap.drive import GnssFix, ImuSample
from fleetmap.errors import DriveError
from fleetmap.geometry import Array, Pose, rotations_from_quat_xyzw

UNKNOWN_COVARIANCE_SIGMA_M = 1.5  # a fix that does not say how good it is counts as a consumer receiver's


def fix_of(stamp_ns: int, position: tuple[float, float, float], covariance: Array | None) -> GnssFix | None:
    """A fix at latitude, longitude (degrees) and height (m); None if that is no place on the globe.

    A covariance (3, 3) that is missing, or that no measurement can have, becomes a consumer receiver's.
    """
    if not np.all(np.isfinite(position)) or abs(position[0]) > 90.0 or abs(position[1]) > 180.0:
        return None
    if covariance is None or not _is_covariance(covariance):
        covariance = np.eye(3) * UNKNOWN_COVARIANCE_SIGMA_M**2
    return GnssFix(stamp_ns, *position, covariance)


def rigid_transform(parent: str, child: str, translation_m: Sequence[float], quat_xyzw: Sequence[float]) -> Pose:
    """``parent_from_child``.

    Raises:
        DriveError: numbers that are no rigid transform.
    """
    numbers = np.array([*translation_m, *quat_xyzw], dtype=np.float64)
    if not np.all(np.isfinite(numbers)) or abs(np.linalg.norm(numbers[3:]) - 1.0) > 1e-2:
        raise DriveError(f"the transform from '{parent}' to '{child}' is no rigid transform: {numbers}")
    return Pose(rotations_from_quat_xyzw(numbers[3:]), numbers[:3])


def matrix_of(values: Any, rows: int, cols: int) -> Array:
    """A matrix (rows, cols) of values row by row; zeros where there are no values.

    Raises:
        ValueError: another number of values.
    """
    flat = np.array(values, dtype=np.float64).ravel()
    return flat.reshape(rows, cols) if flat.size else np.zeros((rows, cols))


def imu_sample_of(
    stamp_ns: int, angular_velocity_rad_s: Sequence[float], linear_acceleration_m_s2: Sequence[float]
) -> ImuSample | None:
    """A sample, or None if one of its numbers is not finite."""
    angular = np.array(angular_velocity_rad_s, dtype=np.float64)
    linear = np.array(linear_acceleration_m_s2, dtype=np.float64)
    if not (np.all(np.isfinite(angular)) and np.all(np.isfinite(linear))):
        return None
    return ImuSample(stamp_ns, angular, linear)


def _is_covariance(covariance: Array) -> bool:
    if not np.all(np.isfinite(covariance)):
        return False
    return bool(np.allclose(covariance, covariance.T) and np.linalg.eigvalsh(covariance)[0] > 0.0)
