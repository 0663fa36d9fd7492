"""A drive in an MCAP file, whatever encodings its messages have."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Set
from functools import cached_property
from pathlib import Path

import numpy as np

from fleetmap.camera import Camera
from fleetmap.drive import Antenna, Frame, GnssFix, ImuSample, SensorMounting, WheelSpeed
from fleetmap.drives.calibrations import camera_of, is_rectified
from fleetmap.drives.image_codec import Image
from fleetmap.drives.image_stream import DecodedImage, decoded_images, image_name
from fleetmap.drives.mcap_file import McapFile
from fleetmap.drives.messages import FIXES, IMAGES, INERTIAL, SPEEDS, ImageMessage
from fleetmap.drives.static_transforms import StaticTransforms, read_static_transforms
from fleetmap.drives.time_order import in_time_order
from fleetmap.drives.topic_choice import (
    choose_calibration,
    choose_gnss_topic,
    choose_image_topic,
    choose_imu_topic,
    choose_speed_topic,
)
from fleetmap.drives.topic_reading import first_value, read_values
from fleetmap.errors import CalibrationError, DriveError
from fleetmap.geometry import CAM_FROM_BODY, Pose

_log = logging.getLogger(__name__)


class McapDrive:
    """One camera's drive in an MCAP file; see fleetmap.drive.Drive."""

    def __init__(
        self,
        path: Path,
        *,
        image_topic: str | None = None,
        gnss_topic: str | None = None,
        antenna_offset_m: tuple[float, float, float] | None = None,
    ) -> None:
        """Open the recording and choose its topics.

        Args:
            path: the MCAP file.
            image_topic: needed where the recording holds those of several cameras.
            gnss_topic: needed where the recording holds several and GNSS is read.
            antenna_offset_m: the antenna from the camera centre along body axes (x forward, y left, z up of
                a level camera that looks forward), for recordings without static transforms.

        Raises:
            DriveError: not an MCAP, no images, or topics that have to be chosen.
        """
        self.path = path
        self.mcap = McapFile(path)
        self.image_topic = choose_image_topic(self.mcap, image_topic)
        self._wanted_gnss_topic = gnss_topic
        self._antenna_offset_m = antenna_offset_m
        if gnss_topic is not None:
            choose_gnss_topic(self.mcap, gnss_topic)

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.name

    @cached_property
    def image_frame_id(self) -> str:
        """The frame of the chosen images."""
        return first_value(self.mcap, IMAGES, self.image_topic).frame_id

    @cached_property
    def camera(self) -> Camera:
        """The calibrated camera of the chosen image topic. Raises CalibrationError where there is none."""
        topic, calibration = choose_calibration(self.mcap, self.image_topic, self.image_frame_id)
        return camera_of(calibration, topic, rectified=is_rectified(self.image_topic))

    @property
    def frame_count(self) -> int:
        """Number of images; a video may begin with some that cannot be decoded."""
        return self.mcap.topics[self.image_topic].message_count

    def frames(self) -> Iterator[Frame]:
        """The images in time order, decoded one at a time.

        Raises:
            DriveError: an image that cannot be decoded, or that is not later than the one before.
            CalibrationError: no calibration, or an image whose size contradicts it.
        """
        return self._frames(lambda stamp_ns: True)

    def frames_at(self, stamps_ns: Set[int]) -> Iterator[Frame]:
        """The images with some stamps; the others are not decoded, unless a video needs them.

        Raises:
            DriveError, CalibrationError: see ``frames``.
        """
        return self._frames(stamps_ns.__contains__)

    def _frames(self, wanted: Callable[[int], bool]) -> Iterator[Frame]:
        camera = self.camera
        stamp_before_ns: int | None = None
        for decoded in decoded_images(self._image_messages(), self._source, wanted):
            self._check_order(decoded, stamp_before_ns)
            self._check_size(decoded, camera)
            stamp_before_ns = decoded.stamp_ns
            yield Frame(decoded.stamp_ns, decoded.image)

    def decode_first_image(self) -> Image:
        """The first image, also of a recording without calibration. Raises DriveError if it cannot be decoded."""
        first = next(decoded_images(self._image_messages(), self._source), None)
        if first is None:
            raise DriveError(f"{self._source} holds no image")
        return first.image

    def frame_stamps_ns(self) -> list[int]:
        """The images' stamps in the order of the recording, unchecked; nothing is decoded."""
        return [message.stamp_ns for message in self._image_messages()]

    def gnss_fixes(self) -> list[GnssFix]:
        """All valid fixes in time order; empty without GNSS.

        Raises:
            DriveError: several GNSS topics and none was chosen.
        """
        return self._fixes

    @property
    def gnss_topic(self) -> str | None:
        """The topic of the fixes; None without GNSS. Raises DriveError where it has to be chosen."""
        return choose_gnss_topic(self.mcap, self._wanted_gnss_topic)

    def antenna(self) -> Antenna:
        """Where the antenna sits in the camera's frame; a guess is warned about once.

        Raises:
            DriveError: several GNSS topics and none was chosen.
        """
        return self._antenna

    def imu_samples(self) -> Iterator[ImuSample]:
        """Inertial measurements in time order; nothing when the recording has none.

        Of several topics the one with the highest rate is read.
        """
        topic = choose_imu_topic(self.mcap)
        messages = read_values(self.mcap, INERTIAL, topic) if topic else iter(())
        return in_time_order((message.sample for message in messages), f"{self.name}: {topic}")

    def imu_mounting(self) -> SensorMounting | None:
        """How the IMU is mounted; None without one, or where no static transform tells (then with a warning)."""
        return self._imu_mounting

    def wheel_speeds(self) -> Iterator[WheelSpeed]:
        """Forward speeds in time order; nothing when the recording has none.

        Of several topics (Odometry, TwistStamped) the one with the highest rate is read.
        """
        topic = choose_speed_topic(self.mcap)
        messages = read_values(self.mcap, SPEEDS, topic) if topic else iter(())
        return in_time_order((message.speed for message in messages), f"{self.name}: {topic}")

    def wheel_mounting(self) -> SensorMounting | None:
        """The frame of the speeds; a camera that looks forward is assumed, and warned about, where none tells."""
        return self._wheel_mounting

    @cached_property
    def static_transforms(self) -> StaticTransforms:
        """How the recording's frames are mounted to each other."""
        return read_static_transforms(self.mcap)

    @cached_property
    def _fixes(self) -> list[GnssFix]:
        topic = self.gnss_topic
        return read_fixes(self.mcap, topic) if topic else []

    @cached_property
    def _antenna(self) -> Antenna:
        topic = self.gnss_topic
        gnss_frame_id = first_value(self.mcap, FIXES, topic).frame_id if topic else ""
        if gnss_frame_id and gnss_frame_id == self.image_frame_id:
            return self._recorded_antenna(Antenna(np.zeros(3), "same frame"))
        cam_from_gnss = (
            self.static_transforms.between(self.image_frame_id, gnss_frame_id) if gnss_frame_id else None
        )
        if cam_from_gnss is not None:
            return self._recorded_antenna(Antenna(cam_from_gnss.translation_m, "static transform"))
        if self._antenna_offset_m is not None:
            return Antenna(CAM_FROM_BODY @ np.array(self._antenna_offset_m, dtype=np.float64), "option")
        if topic is not None:
            _log.warning(
                "%s: no static transform connects the antenna's frame '%s' with the camera's '%s'; the antenna is"
                " taken to be at the camera. Give --antenna-offset X,Y,Z (metres forward, left, up of the camera)",
                self.name, gnss_frame_id, self.image_frame_id,
            )  # fmt: skip
        return Antenna(np.zeros(3), "assumed at the camera")

    @cached_property
    def _imu_mounting(self) -> SensorMounting | None:
        topic = choose_imu_topic(self.mcap)
        first = next(read_values(self.mcap, INERTIAL, topic), None) if topic else None
        mounting = self._mounting_of(first.frame_id) if first else None
        if first and mounting is None:
            _log.warning(
                "%s: no static transform connects the IMU's frame '%s' with the camera's '%s'; it is not used",
                self.name, first.frame_id, self.image_frame_id,
            )  # fmt: skip
        return mounting

    @cached_property
    def _wheel_mounting(self) -> SensorMounting | None:
        topic = choose_speed_topic(self.mcap)
        if topic is None:
            return None
        frame_id = first_value(self.mcap, SPEEDS, topic).frame_id
        mounting = self._mounting_of(frame_id)
        if mounting is None:
            _log.warning(
                "%s: no static transform connects the vehicle's frame '%s' with the camera's '%s'; the camera is"
                " taken to look forward", self.name, frame_id, self.image_frame_id,
            )  # fmt: skip
            return SensorMounting(Pose(CAM_FROM_BODY, np.zeros(3)), "assumed level and forward")
        return mounting

    def _mounting_of(self, frame_id: str) -> SensorMounting | None:
        """The mounting of a frame; None where the recording does not say."""
        if frame_id and frame_id == self.image_frame_id:
            return SensorMounting(Pose.identity(), "same frame")
        cam_from_sensor = self.static_transforms.between(self.image_frame_id, frame_id) if frame_id else None
        return SensorMounting(cam_from_sensor, "static transform") if cam_from_sensor else None

    def _recorded_antenna(self, antenna: Antenna) -> Antenna:
        if self._antenna_offset_m is not None:
            _log.warning(
                "%s: the recording itself says where the antenna is (%s); --antenna-offset is not used",
                self.name, antenna.source,
            )  # fmt: skip
        return antenna

    @property
    def _source(self) -> str:
        return f"{self.image_topic} in {self.path}"

    def _image_messages(self) -> Iterator[ImageMessage]:
        return read_values(self.mcap, IMAGES, self.image_topic)

    def _check_order(self, decoded: DecodedImage, stamp_before_ns: int | None) -> None:
        if stamp_before_ns is not None and decoded.stamp_ns <= stamp_before_ns:
            name = image_name(decoded.number, self._source, decoded.stamp_ns)
            raise DriveError(
                f"frames out of order: {name} is not later than the one before it"
                f" ({stamp_before_ns} ns); sort the recording by header stamp"
            )

    def _check_size(self, decoded: DecodedImage, camera: Camera) -> None:
        height, width = decoded.image.shape
        if (width, height) != (camera.width_px, camera.height_px):
            name = image_name(decoded.number, self._source, decoded.stamp_ns)
            raise CalibrationError(
                f"{name} has {width}x{height} pixels, its calibration says"
                f" {camera.width_px}x{camera.height_px}; calibrate the camera at the recorded size"
            )


def read_fixes(mcap: McapFile, topic: str) -> list[GnssFix]:
    """All valid fixes of a GNSS topic in time order; of several with one stamp, the first."""
    by_stamp: dict[int, GnssFix] = {}
    for message in read_values(mcap, FIXES, topic):
        if message.fix is not None:
            by_stamp.setdefault(message.fix.stamp_ns, message.fix)
    return [by_stamp[stamp_ns] for stamp_ns in sorted(by_stamp)]
