"""Foxglove's messages as this project's values.

Source: https://docs.foxglove.dev/docs/sdk/schemas. The same schemas exist in protobuf (``foxglove.RawImage``) and
as ROS messages (``foxglove_msgs/msg/RawImage``), whose time and field names differ a little. None of them is for
inertial data: a protobuf message that calls itself an Imu is read if it has the fields of sensor_msgs/Imu.
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
    SpeedMessage,
    TransformMessage,
    VideoPicture,
)
from fleetmap.drives.value_checks import fix_of, imu_sample_of, matrix_of, rigid_transform

IMU_FIELDS = frozenset({"angular_velocity", "linear_acceleration"})


def _compressed_image(message: Any) -> Iterator[ImageMessage]:
    yield _image(message, CompressedPicture(bytes(message.data), str(message.format)))


def _compressed_video(message: Any) -> Iterator[ImageMessage]:
    yield _image(message, VideoPicture(bytes(message.data), str(message.format)))


def _raw_image(message: Any) -> Iterator[ImageMessage]:
    data = np.frombuffer(message.data, dtype=np.uint8)
    size = int(message.width), int(message.height)
    yield _image(message, RawPicture(str(message.encoding), *size, int(message.step), data))


def _calibration(message: Any) -> Iterator[CalibrationMessage]:
    yield CalibrationMessage(
        frame_id=_frame_id(message.frame_id),
        width_px=int(message.width),
        height_px=int(message.height),
        distortion_model=str(message.distortion_model),
        coefficients=tuple(float(value) for value in _letter(message, "D")),
        K=matrix_of(_letter(message, "K"), 3, 3),
        P=matrix_of(_letter(message, "P"), 3, 4),
    )


def _fix(message: Any) -> Iterator[FixMessage]:
    position = float(message.latitude), float(message.longitude), float(message.altitude)
    # There is no status: a receiver without a position leaves all three at protobuf's default.
    is_set = any(position)
    covariance = matrix_of(message.position_covariance, 3, 3) if int(message.position_covariance_type) else None
    fix = fix_of(_stamp_ns(message.timestamp), position, covariance) if is_set else None
    yield FixMessage(_frame_id(message.frame_id), fix)


def _fixes(message: Any) -> Iterator[FixMessage]:
    for fix in message.fixes:
        yield from _fix(fix)


def _transform(message: Any) -> Iterator[TransformMessage]:
    parent, child = _frame_id(message.parent_frame_id), _frame_id(message.child_frame_id)
    t, q = message.translation, message.rotation
    quat_xyzw = (q.x, q.y, q.z, q.w) if _is_set(message, "rotation") else (0.0, 0.0, 0.0, 1.0)
    yield TransformMessage(parent, child, rigid_transform(parent, child, (t.x, t.y, t.z), quat_xyzw))


def _transforms(message: Any) -> Iterator[TransformMessage]:
    for transform in message.transforms:
        yield from _transform(transform)


def _odometry(message: Any) -> Iterator[SpeedMessage]:
    speed_mps = float(message.linear_velocity.x)
    if _is_set(message, "linear_velocity") and np.isfinite(speed_mps):
        yield SpeedMessage(_frame_id(message.body_frame_id), WheelSpeed(_stamp_ns(message.timestamp), speed_mps))


def _imu(message: Any) -> Iterator[ImuMessage]:
    angular, linear = message.angular_velocity, message.linear_acceleration
    sample = imu_sample_of(
        _imu_stamp_ns(message), (angular.x, angular.y, angular.z), (linear.x, linear.y, linear.z)
    )
    if sample is not None:
        own = message if hasattr(message, "frame_id") else getattr(message, "header", None)
        yield ImuMessage(_frame_id(getattr(own, "frame_id", "")), sample)


IMU_READING: Reading[ImuMessage] = Reading(INERTIAL, _imu)
_BY_NAME: Readings = {
    "CompressedImage": Reading(IMAGES, _compressed_image),
    "RawImage": Reading(IMAGES, _raw_image),
    "CompressedVideo": Reading(IMAGES, _compressed_video),
    "CameraCalibration": Reading(CALIBRATIONS, _calibration),
    "LocationFix": Reading(FIXES, _fix),
    "LocationFixes": Reading(FIXES, _fixes),
    "FrameTransform": Reading(TRANSFORMS, _transform),
    "FrameTransforms": Reading(TRANSFORMS, _transforms),
    "Odometry": Reading(SPEEDS, _odometry),
}
PROTOBUF_READINGS: Readings = {f"foxglove.{name}": reading for name, reading in _BY_NAME.items()}
ROS_READINGS: Readings = {f"foxglove_msgs/msg/{name}": reading for name, reading in _BY_NAME.items()}


def _image(message: Any, picture: CompressedPicture | RawPicture | VideoPicture) -> ImageMessage:
    return ImageMessage(_stamp_ns(message.timestamp), _frame_id(message.frame_id), picture)


def _imu_stamp_ns(message: Any) -> int:
    """Of a message with a time of its own, or with a header as in ROS."""
    if hasattr(message, "timestamp"):
        return _stamp_ns(message.timestamp)
    return _stamp_ns(message.header.stamp)


def _stamp_ns(time: Any) -> int:
    """Of a google.protobuf.Timestamp, or of a ROS time."""
    if hasattr(time, "seconds"):
        return int(time.seconds) * 1_000_000_000 + int(time.nanos)
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)


def _frame_id(frame_id: Any) -> str:
    return str(frame_id).lstrip("/")


def _letter(message: Any, name: str) -> Any:
    """A matrix; ROS 2 allows no capital letters in field names."""
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.lower())


def _is_set(message: Any, field: str) -> bool:
    """Whether a message of protobuf was given a field; in ROS every field is there."""
    return not hasattr(message, "HasField") or bool(message.HasField(field))
