"""Reads a drive from MCAP with ROS 2 CDR messages."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fleetmap.camera import Camera
from fleetmap.drive import Antenna, Frame, GnssFix, ImuSample, WheelSpeed
from fleetmap.drives import image_codec
from fleetmap.drives.mcap_file import McapFile
from fleetmap.drives.ros2_messages import (
    COMPRESSED_IMAGE,
    TF_MESSAGE,
    MessageDecoder,
    frame_id_of,
    stamp_ns_of,
)
from fleetmap.drives.ros2_values import camera_from_camera_info, fix_from_nav_sat_fix, transforms_from_tf
from fleetmap.drives.static_transforms import StaticTransforms
from fleetmap.drives.topic_choice import (
    choose_calibration,
    choose_gnss_topic,
    choose_image_topic,
    first_message,
    topics_of_type,
)
from fleetmap.errors import CalibrationError, DriveError

_log = logging.getLogger(__name__)

# A level camera that looks forward: body x forward, y left, z up; cam x right, y down, z forward.
CAM_FROM_BODY = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


class Ros2Drive:
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
            image_topic: needed where the recording holds several.
            gnss_topic: needed where the recording holds several and GNSS is read.
            antenna_offset_m: the antenna from the camera centre along body axes (x forward, y left, z up of
                a level camera that looks forward), for recordings without static transforms.

        Raises:
            DriveError: not a complete MCAP, no images, or topics that have to be chosen.
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
        return frame_id_of(first_message(self.mcap, self.image_topic).header)

    @cached_property
    def camera(self) -> Camera:
        """The calibrated camera of the chosen image topic. Raises CalibrationError where there is none."""
        info_topic, info = choose_calibration(self.mcap, self.image_topic, self.image_frame_id)
        return camera_from_camera_info(info, info_topic, rectified=_is_rectified(self.image_topic))

    @property
    def frame_count(self) -> int:
        """Number of images."""
        return self.mcap.topics[self.image_topic].message_count

    def frames(self) -> Iterator[Frame]:
        """The images in time order, decoded one at a time.

        Raises:
            DriveError: an image that cannot be decoded, or that is not later than the one before.
            CalibrationError: no calibration, or an image whose size contradicts it.
        """
        camera = self.camera
        decoder = MessageDecoder(self.mcap.topics[self.image_topic])
        stamp_before_ns: int | None = None
        for index, raw in enumerate(self.mcap.messages(self.image_topic)):
            message = decoder.decode(raw.data, raw.log_time_ns)
            stamp_ns = stamp_ns_of(message.header)
            self._check_order(index, stamp_ns, stamp_before_ns)
            image = self._decode(index, stamp_ns, message)
            self._check_size(camera, index, stamp_ns, image)
            stamp_before_ns = stamp_ns
            yield Frame(stamp_ns, image)

    def decode_first_image(self) -> image_codec.Image:
        """The first image, also of a recording without calibration. Raises DriveError if it cannot be decoded."""
        message = first_message(self.mcap, self.image_topic)
        return self._decode(0, stamp_ns_of(message.header), message)

    def frame_stamps_ns(self) -> list[int]:
        """The images' header stamps in the order of the recording, unchecked; nothing is decoded."""
        decoder = MessageDecoder(self.mcap.topics[self.image_topic])
        raws = self.mcap.messages(self.image_topic)
        return [stamp_ns_of(decoder.decode(raw.data, raw.log_time_ns).header) for raw in raws]

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
        """Inertial measurements in time order; nothing when the recording has none."""
        return iter(())

    def wheel_speeds(self) -> Iterator[WheelSpeed]:
        """Forward speeds in time order; nothing when the recording has none."""
        return iter(())

    @cached_property
    def _fixes(self) -> list[GnssFix]:
        topic = self.gnss_topic
        return read_fixes(self.mcap, topic) if topic else []

    @cached_property
    def _antenna(self) -> Antenna:
        topic = self.gnss_topic
        gnss_frame_id = frame_id_of(first_message(self.mcap, topic).header) if topic else ""
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

    def _recorded_antenna(self, antenna: Antenna) -> Antenna:
        if self._antenna_offset_m is not None:
            _log.warning(
                "%s: the recording itself says where the antenna is (%s); --antenna-offset is not used",
                self.name, antenna.source,
            )  # fmt: skip
        return antenna

    @cached_property
    def static_transforms(self) -> StaticTransforms:
        """All of the recording's /tf_static."""
        transforms = StaticTransforms()
        for topic in topics_of_type(self.mcap, TF_MESSAGE):
            if topic.rpartition("/")[2] != "tf_static":
                continue
            decoder = MessageDecoder(self.mcap.topics[topic])
            for raw in self.mcap.messages(topic):
                for parent, child, parent_from_child in transforms_from_tf(
                    decoder.decode(raw.data, raw.log_time_ns)
                ):
                    transforms.add(parent, child, parent_from_child)
        return transforms

    def _decode(self, index: int, stamp_ns: int, message: Any) -> image_codec.Image:
        try:
            if self.mcap.topics[self.image_topic].message_type == COMPRESSED_IMAGE:
                return image_codec.decode_compressed(message.data.tobytes(), str(message.format))
            return image_codec.decode_raw(message)
        except ValueError as error:
            raise DriveError(f"{self._image(index, stamp_ns)} cannot be decoded: {error}") from error

    def _check_order(self, index: int, stamp_ns: int, stamp_before_ns: int | None) -> None:
        if stamp_before_ns is not None and stamp_ns <= stamp_before_ns:
            raise DriveError(
                f"frames out of order: {self._image(index, stamp_ns)} is not later than the one before it"
                f" ({stamp_before_ns} ns); sort the recording by header stamp"
            )

    def _check_size(self, camera: Camera, index: int, stamp_ns: int, image: image_codec.Image) -> None:
        height, width = image.shape
        if (width, height) != (camera.width_px, camera.height_px):
            raise CalibrationError(
                f"{self._image(index, stamp_ns)} has {width}x{height} pixels, its CameraInfo says"
                f" {camera.width_px}x{camera.height_px}; calibrate the camera at the recorded size"
            )

    def _image(self, index: int, stamp_ns: int) -> str:
        return f"image {index} of {self.image_topic} in {self.path} (stamp {stamp_ns} ns)"


def read_fixes(mcap: McapFile, topic: str) -> list[GnssFix]:
    """All valid fixes of a NavSatFix topic in time order; of several with one stamp, the first."""
    decoder = MessageDecoder(mcap.topics[topic])
    by_stamp: dict[int, GnssFix] = {}
    for raw in mcap.messages(topic):
        fix = fix_from_nav_sat_fix(decoder.decode(raw.data, raw.log_time_ns))
        if fix is not None:
            by_stamp.setdefault(fix.stamp_ns, fix)
    return [by_stamp[stamp_ns] for stamp_ns in sorted(by_stamp)]


def _is_rectified(image_topic: str) -> bool:
    """ROS' image_proc publishes rectified images as .../image_rect or .../image_rect_color."""
    return any(part.startswith("image_rect") for part in image_topic.split("/"))
