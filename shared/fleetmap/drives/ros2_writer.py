"""Writes a drive as MCAP with ROS 2 CDR messages, as this project's reader and ROS 2's own tools read it."""

from __future__ import annotations

import os
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from fleetmap import __version__
from fleetmap.camera import Camera
from fleetmap.drive import GnssFix, ImuSample, WheelSpeed
from fleetmap.drives.image_codec import encode_image
from fleetmap.drives.ros2_messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    IMU,
    NAV_SAT_FIX,
    TF_MESSAGE,
    TWIST_STAMPED,
    definition_text,
    encode,
    standard_typestore,
)
from fleetmap.errors import CalibrationError
from fleetmap.files import atomic_path, refuse_existing
from fleetmap.geometry import Array, Pose, quat_xyzw_from_rotations

_LASER_SCAN = "sensor_msgs/msg/LaserScan"
_TF_STATIC_TOPIC = "/tf_static"
_COVARIANCE_KNOWN, _FIX, _GPS = 3, 0, 1  # constants of sensor_msgs/NavSatFix and NavSatStatus
_NOT_MEASURED = -1.0  # first element of a sensor_msgs/Imu covariance whose quantity the sensor does not give
_MILLIMETRES_PER_METRE, _FARTHEST_MM = 1000.0, 65_535


class DriveWriter:
    """A context manager; the recording appears whole when the block ends without error, or not at all.

    Messages may come in any order: log times are header stamps, and readers go by log time.
    Use it as ``with DriveWriter(path, camera) as writer: writer.write_image(stamp_ns, image)``.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera | None,
        *,
        force: bool = False,
        camera_frame_id: str = "camera",
        image_topic: str = "/camera/image/compressed",
        info_topic: str = "/camera/camera_info",
        gnss_topic: str = "/gnss/fix",
        imu_topic: str = "/imu/data",
        wheel_topic: str = "/vehicle/speed",
        depth_topic: str = "/camera/depth/image",
        depth_info_topic: str = "/camera/depth/camera_info",
        scan_topic: str = "/scan",
        compress_chunks: bool = False,
    ) -> None:
        """Nothing is written before the block is entered; ``camera=None`` records without calibration.

        ``compress_chunks`` is for recordings with depth images or scans: they halve and better (zstd), while
        JPEG and PNG only cost time a second time.

        Raises:
            OutputExistsError: the file is there already and ``force`` is not given.
        """
        refuse_existing(path, force)
        self._path, self._camera, self._camera_frame_id = path, camera, camera_frame_id
        self._image_topic, self._info_topic, self._gnss_topic = image_topic, info_topic, gnss_topic
        self._imu_topic, self._wheel_topic, self._scan_topic = imu_topic, wheel_topic, scan_topic
        self._depth_topic, self._depth_info_topic = depth_topic, depth_info_topic
        self._compression = CompressionType.ZSTD if compress_chunks else CompressionType.NONE
        self._types = standard_typestore().types
        self._transforms: list[tuple[str, str, Pose]] = []
        self._channel_ids: dict[str, int] = {}
        self.message_counts: Counter[str] = Counter()  # of each type, such as sensor_msgs/msg/Imu
        self._first_stamp_ns: int | None = None
        self._stack = ExitStack()
        self._file: IO[bytes]
        self._writer: Writer

    def __enter__(self) -> Self:
        draft = self._stack.enter_context(atomic_path(self._path))
        try:
            self._file = self._stack.enter_context(draft.open("wb"))
            self._writer = Writer(self._file, compression=self._compression)
            self._writer.start(profile="ros2", library=f"fleetmap {__version__}")
        except OSError as error:
            self._stack.__exit__(type(error), error, error.__traceback__)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:  # closes the file and removes it; a full disk becomes a StorageError
            self._stack.__exit__(kind, error, trace)
            return
        with self._stack:
            self._write_transforms()
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.flush()
            os.fsync(self._file.fileno())

    def write_image(self, stamp_ns: int, image: NDArray[np.uint8], *, png: bool = False) -> None:
        """Compress an image, grey (height, width) or BGR (height, width, 3), as JPEG of quality 95 or as PNG."""
        self._write_compressed(stamp_ns, encode_image(image, png=png), "png" if png else "jpeg")

    def write_jpeg(self, stamp_ns: int, jpeg: bytes) -> None:
        """Write an image that is a JPEG already; its bytes stay as they are."""
        self._write_compressed(stamp_ns, jpeg, "jpeg")

    def write_png(self, stamp_ns: int, png: bytes) -> None:
        """Write an image that is a PNG already; its bytes stay as they are."""
        self._write_compressed(stamp_ns, png, "png")

    def write_fix(self, fix: GnssFix, frame_id: str) -> None:
        """Write a fix of the antenna whose frame is ``frame_id``; use the camera's own for a zero lever arm."""
        status = self._types["sensor_msgs/msg/NavSatStatus"](status=_FIX, service=_GPS)
        message = self._types[NAV_SAT_FIX](
            header=self._header(fix.stamp_ns, frame_id),
            status=status,
            latitude=fix.lat_deg,
            longitude=fix.lon_deg,
            altitude=fix.height_m,
            position_covariance=np.ascontiguousarray(fix.covariance_enu_m2, dtype=np.float64).reshape(9),
            position_covariance_type=_COVARIANCE_KNOWN,
        )
        self._write(self._gnss_topic, message, fix.stamp_ns)

    def write_imu(
        self,
        sample: ImuSample,
        frame_id: str,
        *,
        angular_velocity_covariance: Array | None = None,
        linear_acceleration_covariance: Array | None = None,
    ) -> None:
        """Write a measurement of the IMU whose frame is ``frame_id``.

        Covariances (3, 3) in (rad/s)^2 and (m/s^2)^2; None says that they are not known, as ROS does with zeros.
        """
        unknown = np.zeros((3, 3))
        message = self._types[IMU](
            header=self._header(sample.stamp_ns, frame_id),
            orientation=self._quaternion(np.array([0.0, 0.0, 0.0, 1.0])),
            orientation_covariance=np.array([_NOT_MEASURED, *(0.0,) * 8]),
            angular_velocity=self._vector(sample.angular_velocity_rad_s),
            angular_velocity_covariance=_nine(angular_velocity_covariance, unknown),
            linear_acceleration=self._vector(sample.linear_acceleration_m_s2),
            linear_acceleration_covariance=_nine(linear_acceleration_covariance, unknown),
        )
        self._write(self._imu_topic, message, sample.stamp_ns)

    def write_wheel_speed(self, speed: WheelSpeed, frame_id: str = "base_link") -> None:
        """Write a forward speed, the x axis of the vehicle's frame ``frame_id`` (REP 103)."""
        twist = self._types["geometry_msgs/msg/Twist"](
            linear=self._vector(np.array([speed.speed_mps, 0.0, 0.0])), angular=self._vector(np.zeros(3))
        )
        message = self._types[TWIST_STAMPED](header=self._header(speed.stamp_ns, frame_id), twist=twist)
        self._write(self._wheel_topic, message, speed.stamp_ns)

    def write_depth(self, stamp_ns: int, depth_m: NDArray[np.floating[Any]]) -> None:
        """Write a depth image (height, width) of the camera's own pixels, with a CameraInfo of its own.

        It becomes ``16UC1`` in millimetres (REP 118); 0 where there is no return: NaN, not positive, or beyond
        65.535 m.

        Raises:
            CalibrationError: the depth image is not as large as the camera's images.
        """
        height_px, width_px = depth_m.shape
        if self._camera is not None:
            if (width_px, height_px) != (self._camera.width_px, self._camera.height_px):
                raise CalibrationError(
                    f"a depth image of {width_px}x{height_px} pixels does not belong to a camera of"
                    f" {self._camera.width_px}x{self._camera.height_px}"
                )
            self._write(self._depth_info_topic, self._camera_info(self._camera, stamp_ns), stamp_ns)
        message = self._types[IMAGE](
            header=self._header(stamp_ns, self._camera_frame_id),
            height=height_px,
            width=width_px,
            encoding="16UC1",
            is_bigendian=0,
            step=2 * width_px,
            data=_millimetres(depth_m).astype("<u2").view(np.uint8).reshape(-1),
        )
        self._write(self._depth_topic, message, stamp_ns)

    def write_scan(
        self,
        stamp_ns: int,
        ranges_m: NDArray[np.floating[Any]],
        *,
        angle_min_rad: float,
        angle_increment_rad: float,
        range_min_m: float,
        range_max_m: float,
        frame_id: str = "laser",
        scan_time_s: float = 0.0,
    ) -> None:
        """Write one turn of a 2-D lidar: ranges (N,) from ``angle_min_rad`` on, counter-clockwise about z.

        A beam without return is infinite (REP 117); ``stamp_ns`` is that of the first beam, and the beams are
        spread evenly over ``scan_time_s``.
        """
        count = len(ranges_m)
        message = self._types[_LASER_SCAN](
            header=self._header(stamp_ns, frame_id),
            angle_min=angle_min_rad,
            angle_max=angle_min_rad + angle_increment_rad * max(count - 1, 0),
            angle_increment=angle_increment_rad,
            time_increment=scan_time_s / count if count else 0.0,
            scan_time=scan_time_s,
            range_min=range_min_m,
            range_max=range_max_m,
            ranges=np.asarray(ranges_m, dtype=np.float32),
            intensities=np.zeros(0, dtype=np.float32),
        )
        self._write(self._scan_topic, message, stamp_ns)

    def write_static_transform(self, parent: str, child: str, parent_from_child: Pose) -> None:
        """Say how two frames are mounted; all of them are written as one /tf_static message at the end."""
        self._transforms.append((parent, child, parent_from_child))

    def _write_compressed(self, stamp_ns: int, data: bytes, image_format: str) -> None:
        if self._camera is not None:
            self._write(self._info_topic, self._camera_info(self._camera, stamp_ns), stamp_ns)
        message = self._types[COMPRESSED_IMAGE](
            header=self._header(stamp_ns, self._camera_frame_id),
            format=image_format,
            data=np.frombuffer(data, dtype=np.uint8),
        )
        self._write(self._image_topic, message, stamp_ns)

    def _write_transforms(self) -> None:
        if not self._transforms:
            return
        stamp_ns = self._first_stamp_ns or 0
        stamped = [
            self._types["geometry_msgs/msg/TransformStamped"](
                header=self._header(stamp_ns, parent), child_frame_id=child, transform=self._transform(pose)
            )
            for parent, child, pose in self._transforms
        ]
        self._write(_TF_STATIC_TOPIC, self._types[TF_MESSAGE](transforms=stamped), stamp_ns)

    def _write(self, topic: str, message: Any, stamp_ns: int) -> None:
        message_type: str = message.__msgtype__
        if topic not in self._channel_ids:
            schema_id = self._writer.register_schema(
                message_type, "ros2msg", definition_text(message_type).encode()
            )
            self._channel_ids[topic] = self._writer.register_channel(topic, "cdr", schema_id)
        if self._first_stamp_ns is None or stamp_ns < self._first_stamp_ns:
            self._first_stamp_ns = stamp_ns
        self.message_counts[message_type] += 1
        self._writer.add_message(self._channel_ids[topic], stamp_ns, encode(message), stamp_ns)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        sec, nanosec = divmod(stamp_ns, 1_000_000_000)
        time = self._types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
        return self._types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)

    def _camera_info(self, camera: Camera, stamp_ns: int) -> Any:
        whole_image = self._types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self._types[CAMERA_INFO](
            header=self._header(stamp_ns, self._camera_frame_id),
            height=camera.height_px,
            width=camera.width_px,
            distortion_model=camera.distortion_model,
            d=np.array(camera.distortion, dtype=np.float64),
            k=camera.matrix.reshape(9),
            r=np.eye(3).reshape(9),
            p=np.hstack([camera.matrix, np.zeros((3, 1))]).reshape(12),
            binning_x=0,
            binning_y=0,
            roi=whole_image,
        )

    def _transform(self, pose: Pose) -> Any:
        return self._types["geometry_msgs/msg/Transform"](
            translation=self._vector(pose.translation_m),
            rotation=self._quaternion(quat_xyzw_from_rotations(pose.rotation)),
        )

    def _vector(self, xyz: Array) -> Any:
        x, y, z = (float(value) for value in xyz)
        return self._types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)

    def _quaternion(self, quat_xyzw: Array) -> Any:
        x, y, z, w = (float(value) for value in quat_xyzw)
        return self._types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def _nine(covariance: Array | None, unknown: Array) -> Array:
    return np.ascontiguousarray(unknown if covariance is None else covariance, dtype=np.float64).reshape(9)


def _millimetres(depth_m: NDArray[np.floating[Any]]) -> NDArray[np.uint16]:
    with np.errstate(invalid="ignore", over="ignore"):
        millimetres = np.rint(np.asarray(depth_m, dtype=np.float64) * _MILLIMETRES_PER_METRE)
        is_return = (millimetres > 0.0) & (millimetres <= _FARTHEST_MM)
    return np.where(is_return, millimetres, 0.0).astype(np.uint16)
