"""ROS 2 messages as this project's values: cameras, fixes and static transforms."""

from __future__ import annotations

from typing import Any

import numpy as np

from fleetmap.camera import Camera
from fleetmap.drive import GnssFix
from fleetmap.drives.ros2_messages import frame_id_of, stamp_ns_of
from fleetmap.errors import CalibrationError, DriveError
from fleetmap.geometry import Array, Pose, rotations_from_quat_xyzw

UNKNOWN_COVARIANCE_SIGMA_M = 1.5  # a fix that does not say how good it is counts as a consumer receiver's
_NO_FIX, _COVARIANCE_UNKNOWN = -1, 0
_PLUMB_BOB_LIKE = ("plumb_bob", "rational_polynomial", "")
_NEVER_PINHOLE = ("equidistant", "fisheye")  # these bend the image also with all coefficients zero


def camera_from_camera_info(info: Any, info_topic: str, *, rectified: bool) -> Camera:
    """The camera of a CameraInfo; rectified images use P without distortion.

    Raises:
        CalibrationError: an uncalibrated camera, or a distortion model other than plumb_bob.
    """
    width, height = int(info.width), int(info.height)
    K, P = np.asarray(info.k, dtype=np.float64).reshape(3, 3), np.asarray(info.p, dtype=np.float64).reshape(3, 4)
    if rectified and P[0, 0] > 0.0:
        return _camera(info_topic, width, height, P[:, :3], ())
    model = str(info.distortion_model)
    coefficients = tuple(float(value) for value in info.d)
    is_plumb_bob = model in _PLUMB_BOB_LIKE and len(coefficients) >= 4 and not any(coefficients[5:])
    if model in _NEVER_PINHOLE or (any(coefficients) and not is_plumb_bob):
        raise CalibrationError(
            f"{info_topic} has distortion model '{model}' with {len(coefficients)} coefficients;"
            " fleetmap reads plumb_bob (k1, k2, p1, p2, k3): calibrate with it, or record rectified images"
        )
    return _camera(info_topic, width, height, K, coefficients if any(coefficients) else ())


def fix_from_nav_sat_fix(message: Any) -> GnssFix | None:
    """A fix, or None for a message that says there is none or lacks a finite position."""
    position = (float(message.latitude), float(message.longitude), float(message.altitude))
    is_on_globe = abs(position[0]) <= 90.0 and abs(position[1]) <= 180.0
    if int(message.status.status) <= _NO_FIX or not np.all(np.isfinite(position)) or not is_on_globe:
        return None
    covariance = np.array(message.position_covariance, dtype=np.float64).reshape(3, 3)
    if int(message.position_covariance_type) == _COVARIANCE_UNKNOWN or not _is_covariance(covariance):
        covariance = np.eye(3) * UNKNOWN_COVARIANCE_SIGMA_M**2
    return GnssFix(stamp_ns_of(message.header), *position, covariance)


def transforms_from_tf(message: Any) -> list[tuple[str, str, Pose]]:
    """Each transform of a TFMessage as parent, child, ``parent_from_child``.

    Raises:
        DriveError: numbers that are no rigid transform.
    """
    transforms = []
    for stamped in message.transforms:
        parent, child = frame_id_of(stamped.header), str(stamped.child_frame_id).lstrip("/")
        t, q = stamped.transform.translation, stamped.transform.rotation
        numbers = np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w], dtype=np.float64)
        if not np.all(np.isfinite(numbers)) or abs(np.linalg.norm(numbers[3:]) - 1.0) > 1e-2:
            raise DriveError(f"the static transform from '{parent}' to '{child}' is no rigid transform: {numbers}")
        transforms.append((parent, child, Pose(rotations_from_quat_xyzw(numbers[3:]), numbers[:3])))
    return transforms


def _camera(info_topic: str, width: int, height: int, K: Array, coefficients: tuple[float, ...]) -> Camera:
    if K[0, 0] == 0.0:
        raise CalibrationError(f"{info_topic} comes from an uncalibrated camera (its K is zero); calibrate it")
    k1, k2, p1, p2, k3 = (*coefficients, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    try:
        return Camera(width, height, *_focal_and_centre(K), distortion=(k1, k2, p1, p2, k3))
    except CalibrationError as error:
        raise CalibrationError(f"{info_topic}: {error}") from error


def _focal_and_centre(K: Array) -> tuple[float, float, float, float]:
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def _is_covariance(covariance: Array) -> bool:
    if not np.all(np.isfinite(covariance)):
        return False
    return bool(np.allclose(covariance, covariance.T) and np.linalg.eigvalsh(covariance)[0] > 0.0)
