"""ROS messages as this project's values.

Sources: the definitions of sensor_msgs, nav_msgs, geometry_msgs and tf2_msgs in ROS 2 Humble. ROS 1 has the same
messages; where its field names differ they are capital letters.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from fleetmap.drive import WheelSpeed
from fleetmap.drives.messages import (
    CALIBRATIONS,
    FIXES,
    IMAGES,
    INERTIAL,
    SPEEDS,
    TRANSFORMS,
    CalibrationMessage,
    CompressedPicture,
    FixMessage,
    ImageMessage,
    ImuMessage,
    RawPicture,
    Reading,
    Readings,
    Region,
    SpeedMessage,
    TransformMessage,
)
from fleetmap.drives.ros2_messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    IMU,
    NAV_SAT_FIX,
    ODOMETRY,
    TF_MESSAGE,
    TWIST_STAMPED,
    frame_id_of,
    stamp_ns_of,
)
from fleetmap.drives.value_checks import fix_of, imu_sample_of, matrix_of, rigid_transform

_NO_FIX, _COVARIANCE_UNKNOWN = -1, 0  # constants of sensor_msgs/NavSatStatus and NavSatFix
_NOT_MEASURED = -1.0  # first element of a covariance in sensor_msgs/Imu


def _compressed_image(message: Any) -> Iterator[ImageMessage]:
    picture = CompressedPicture(message.data.tobytes(), str(message.format))
    yield ImageMessage(stamp_ns_of(message.header), frame_id_of(message.header), picture)


def _image(message: Any) -> Iterator[ImageMessage]:
    picture = RawPicture(
        encoding=str(message.encoding),
        width_px=int(message.width),
        height_px=int(message.height),
        row_bytes=int(message.step),
        data=np.asarray(message.data, dtype=np.uint8),
        is_bigendian=bool(message.is_bigendian),
    )
    yield ImageMessage(stamp_ns_of(message.header), frame_id_of(message.header), picture)


def _camera_info(message: Any) -> Iterator[CalibrationMessage]:
    roi = message.roi
    yield CalibrationMessage(
        frame_id=frame_id_of(message.header),
        width_px=int(message.width),
        height_px=int(message.height),
        distortion_model=str(message.distortion_model),
        coefficients=tuple(float(value) for value in _letter(message, "d")),
        K=matrix_of(_letter(message, "k"), 3, 3),
        P=matrix_of(_letter(message, "p"), 3, 4),
        binning=(max(int(message.binning_x), 1), max(int(message.binning_y), 1)),  # 0 means the same as 1
        region=Region(int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height)),
    )


def _nav_sat_fix(message: Any) -> Iterator[FixMessage]:
    fix = None
    if int(message.status.status) > _NO_FIX:
        is_known = int(message.position_covariance_type) != _COVARIANCE_UNKNOWN
        fix = fix_of(
            stamp_ns_of(message.header),
            (float(message.latitude), float(message.longitude), float(message.altitude)),
            matrix_of(message.position_covariance, 3, 3) if is_known else None,
        )
    yield FixMessage(frame_id_of(message.header), fix)


def _tf_message(message: Any) -> Iterator[TransformMessage]:
    for stamped in message.transforms:
        parent, child = frame_id_of(stamped.header), str(stamped.child_frame_id).lstrip("/")
        t, q = stamped.transform.translation, stamped.transform.rotation
        yield TransformMessage(
            parent, child, rigid_transform(parent, child, (t.x, t.y, t.z), (q.x, q.y, q.z, q.w))
        )


def _imu(message: Any) -> Iterator[ImuMessage]:
    angular, linear = message.angular_velocity, message.linear_acceleration
    covariances = message.angular_velocity_covariance, message.linear_acceleration_covariance
    if any(float(covariance[0]) == _NOT_MEASURED for covariance in covariances):
        return
    sample = imu_sample_of(
        stamp_ns_of(message.header), (angular.x, angular.y, angular.z), (linear.x, linear.y, linear.z)
    )
    if sample is not None:
        yield ImuMessage(frame_id_of(message.header), sample)


def _odometry(message: Any) -> Iterator[SpeedMessage]:
    yield from _speed(message.header, str(message.child_frame_id).lstrip("/"), message.twist.twist.linear.x)


def _twist_stamped(message: Any) -> Iterator[SpeedMessage]:
    yield from _speed(message.header, frame_id_of(message.header), message.twist.linear.x)


READINGS: Readings = {
    COMPRESSED_IMAGE: Reading(IMAGES, _compressed_image),
    IMAGE: Reading(IMAGES, _image),
    CAMERA_INFO: Reading(CALIBRATIONS, _camera_info),
    NAV_SAT_FIX: Reading(FIXES, _nav_sat_fix),
    TF_MESSAGE: Reading(TRANSFORMS, _tf_message),
    IMU: Reading(INERTIAL, _imu),
    ODOMETRY: Reading(SPEEDS, _odometry),
    TWIST_STAMPED: Reading(SPEEDS, _twist_stamped),
}


def _speed(header: Any, frame_id: str, speed_mps: Any) -> Iterator[SpeedMessage]:
    if np.isfinite(speed_mps):
        yield SpeedMessage(frame_id, WheelSpeed(stamp_ns_of(header), float(speed_mps)))


def _letter(message: Any, name: str) -> Any:
    """A matrix of a CameraInfo; a capital letter in ROS 1."""
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.upper())
