"""What the messages of a recording say, in values that know neither encoding nor schema."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from fleetmap.drive import GnssFix, ImuSample, WheelSpeed
from fleetmap.geometry import Array, Pose

T = TypeVar("T")


@dataclass(frozen=True)
class CompressedPicture:
    """A JPEG, PNG or WebP."""

    data: bytes
    format: str  # as recorded, such as "jpeg" or "bgr8; jpeg compressed bgr8"


@dataclass(frozen=True)
class RawPicture:
    """Pixels as the camera's driver gave them; the encodings are those of sensor_msgs/image_encodings.hpp."""

    encoding: str
    width_px: int
    height_px: int
    row_bytes: int  # with padding
    data: NDArray[np.uint8]  # (N,)
    is_bigendian: bool = False


@dataclass(frozen=True)
class VideoPicture:
    """What a decoder needs to turn the pictures before into this one."""

    data: bytes
    format: str  # "h264", "h265", "vp9" or "av1"


@dataclass(frozen=True)
class ImageMessage:
    """One image of a camera, not yet decoded."""

    stamp_ns: int
    frame_id: str
    picture: CompressedPicture | RawPicture | VideoPicture


@dataclass(frozen=True)
class Region:
    """Part of the sensor; all zero for the whole of it."""

    x_px: int
    y_px: int
    width_px: int
    height_px: int


@dataclass(frozen=True)
class CalibrationMessage:
    """What sensor_msgs/CameraInfo and foxglove.CameraCalibration say; zeros where they say nothing."""

    frame_id: str
    width_px: int
    height_px: int
    distortion_model: str
    coefficients: tuple[float, ...]
    K: Array  # (3, 3)
    P: Array  # (3, 4)
    binning: tuple[int, int] = (1, 1)
    region: Region = Region(0, 0, 0, 0)  # in unbinned pixels


@dataclass(frozen=True)
class FixMessage:
    """A receiver's report."""

    frame_id: str
    fix: GnssFix | None  # None where it says that it has no position


@dataclass(frozen=True)
class TransformMessage:
    """Where one frame is in another at some time."""

    parent: str
    child: str
    parent_from_child: Pose


@dataclass(frozen=True)
class ImuMessage:
    """An inertial measurement, and the frame whose axes it is along."""

    frame_id: str
    sample: ImuSample


@dataclass(frozen=True)
class SpeedMessage:
    """A measured speed, and the frame whose forward axis it is along."""

    frame_id: str
    speed: WheelSpeed


@dataclass(frozen=True)
class Kind(Generic[T]):
    """What a topic is good for; T is what its messages become."""

    name: str


IMAGES: Kind[ImageMessage] = Kind("images")
CALIBRATIONS: Kind[CalibrationMessage] = Kind("calibrations")
FIXES: Kind[FixMessage] = Kind("GNSS fixes")
TRANSFORMS: Kind[TransformMessage] = Kind("transforms")
INERTIAL: Kind[ImuMessage] = Kind("inertial measurements")
SPEEDS: Kind[SpeedMessage] = Kind("speeds")


@dataclass(frozen=True)
class Reading(Generic[T]):
    """How one message type becomes values: none for a message without information, several for a bundle."""

    kind: Kind[T]
    values_of: Callable[[Any], Iterable[T]]


Readings = Mapping[str, Reading[Any]]  # by message type
