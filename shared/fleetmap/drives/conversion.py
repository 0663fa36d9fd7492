"""What all converters share: images copied as they are, messages in time order, fixes made from a reference."""

from __future__ import annotations

import gzip
import heapq
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from fleetmap.camera import Camera
from fleetmap.drive import GnssFix, ImuSample
from fleetmap.drives.image_codec import Image, decode_compressed
from fleetmap.drives.ros2_messages import COMPRESSED_IMAGE, IMAGE, IMU, NAV_SAT_FIX
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.errors import CalibrationError, DriveError
from fleetmap.geometry import Pose
from fleetmap.gnss import GNSS_ERROR_MODELS, sample_fixes
from fleetmap.trajectory import Trajectory, write_trajectory

Progress = Callable[[str, int, int], None]  # stage, done, total
Message = tuple[int, Callable[[], None]]  # its stamp in ns, and what writes it

_JPEG_MAGIC, _PNG_MAGIC = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
_LAST_ROS_STAMP_NS = (2**31 - 1) * 1_000_000_000  # builtin_interfaces/Time counts seconds in 32 bits, until 2038


@dataclass(frozen=True)
class StampedImage:
    """One image file of a data set."""

    stamp_ns: int
    path: Path


@dataclass(frozen=True)
class Conversion:
    """What a conversion has written, and what the user should know about it."""

    recording: Path
    frame_count: int
    fix_count: int
    reference: Path | None = None  # NAME.reference.tum, where the folder holds a reference
    imu_count: int = 0
    depth_count: int = 0
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class SimulatedGnss:
    """How fixes are made from the reference; see fleetmap.gnss.sample_fixes."""

    error: str  # "rtk" or "consumer"
    interval_s: float = 0.1
    gap_s: tuple[float, float] | None = None
    antenna_in_camera_m: tuple[float, float, float] | None = None  # None: the antenna is the camera centre
    seed: int = 0
    outlier_ratio: float = 0.0


def conclude(
    writer: DriveWriter, recording: Path, reference: Trajectory | None = None, remarks: tuple[str, ...] = ()
) -> Conversion:
    """Write the reference beside the recording that ``writer`` has finished, and say what was written."""
    counts = writer.message_counts
    return Conversion(
        recording,
        frame_count=counts[COMPRESSED_IMAGE],
        fix_count=counts[NAV_SAT_FIX],
        reference=_write_reference(recording, reference),
        imu_count=counts[IMU],
        depth_count=counts[IMAGE],
        remarks=remarks,
    )


def silent(stage: str, done: int, total: int) -> None:
    """Shows no progress."""


def reference_path(recording: Path) -> Path:
    """``survey.mcap`` -> ``survey.reference.tum``."""
    return recording.with_name(f"{recording.stem}.reference.tum")


def simulated_fixes(reference: Trajectory, gnss: SimulatedGnss) -> list[GnssFix]:
    """Fixes of a receiver that goes along the reference. Raises InputError as fleetmap.gnss.sample_fixes."""
    return sample_fixes(
        reference,
        GNSS_ERROR_MODELS[gnss.error],
        interval_s=gnss.interval_s,
        gap_s=gnss.gap_s,
        antenna_in_cam_m=gnss.antenna_in_camera_m or (0.0, 0.0, 0.0),
        outlier_ratio=gnss.outlier_ratio,
        seed=gnss.seed,
    )


def mount_antenna(
    writer: DriveWriter, camera_frame_id: str, antenna_in_camera_m: tuple[float, float, float] | None
) -> str:
    """The frame for fixes: the camera's own, or ``gnss`` mounted where the antenna is."""
    if antenna_in_camera_m is None:
        return camera_frame_id
    mounting = Pose(np.eye(3), np.array(antenna_in_camera_m, dtype=np.float64))
    writer.write_static_transform(camera_frame_id, "gnss", mounting)
    return "gnss"


def write_in_time_order(*streams: Iterable[Message]) -> None:
    """Write messages of several streams, each in time order already, as one recorder would have received them."""
    for _, write in heapq.merge(*streams, key=lambda message: message[0]):
        write()


def image_messages(
    writer: DriveWriter, images: Sequence[StampedImage], camera: Camera, progress: Progress = silent
) -> Iterator[Message]:
    """Image files as they are; what is neither JPEG nor PNG becomes PNG.

    Raises:
        DriveError: a file that cannot be read or decoded, or an image that is not later than the one before.
        CalibrationError: an image whose size is not the camera's.
    """
    for index, image in enumerate(images):
        if index and image.stamp_ns <= images[index - 1].stamp_ns:
            raise DriveError(
                f"{image.path} is not later than the image before it, {images[index - 1].path.name};"
                " the timestamps are damaged"
            )
        yield image.stamp_ns, partial(_write_image, writer, image, camera)
        progress("converting", index + 1, len(images))


def fix_messages(writer: DriveWriter, fixes: Iterable[GnssFix], frame_id: str) -> Iterator[Message]:
    """GNSS fixes of one antenna."""
    for fix in fixes:
        yield fix.stamp_ns, partial(writer.write_fix, fix, frame_id)


def imu_messages(writer: DriveWriter, samples: Iterable[ImuSample], frame_id: str) -> Iterator[Message]:
    """Measurements of one IMU."""
    for sample in samples:
        yield sample.stamp_ns, partial(writer.write_imu, sample, frame_id)


def seconds_as_ns(text: str, origin: str) -> int:
    """Decimal seconds, also like 1.037359e-01, as exact nanoseconds. Raises DriveError naming ``origin``."""
    try:
        return int((Decimal(text.strip()) * 1_000_000_000).to_integral_value())
    except (InvalidOperation, ValueError, OverflowError) as error:
        raise DriveError(f"{origin}: '{text.strip()}' is no time in seconds") from error


def checked_stamp_ns(stamp_ns: int, origin: str) -> int:
    """A stamp that a ROS 2 header can hold. Raises DriveError naming ``origin``."""
    if not 0 <= stamp_ns <= _LAST_ROS_STAMP_NS:
        raise DriveError(f"{origin}: {stamp_ns} ns since 1970 is no time before 2038 that a recording can hold")
    return stamp_ns


def read_lines(path: Path) -> list[str]:
    """Lines of a text file, packed by gzip if its name ends in .gz. Raises DriveError if it cannot be read."""
    try:
        data = path.read_bytes()
        return (gzip.decompress(data) if path.suffix == ".gz" else data).decode("utf-8-sig").splitlines()
    except (OSError, EOFError, zlib.error) as error:
        raise DriveError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from error
    except UnicodeDecodeError as error:
        raise DriveError(f"{path} is not a text file: {error}") from error


def read_bytes(path: Path) -> bytes:
    """A file's bytes. Raises DriveError if it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise DriveError(f"cannot read {path}: {error.strerror or error}") from error


def _write_reference(recording: Path, reference: Trajectory | None) -> Path | None:
    """Write the reference beside its recording; an older one that belongs to nothing any more is removed."""
    path = reference_path(recording)
    if reference is None:
        path.unlink(missing_ok=True)
        return None
    write_trajectory(path, reference)
    return path


def _write_image(writer: DriveWriter, image: StampedImage, camera: Camera) -> None:
    data = read_bytes(image.path)
    is_jpeg, is_png = data.startswith(_JPEG_MAGIC), data.startswith(_PNG_MAGIC)
    try:
        pixels = decode_compressed(data, image.path.suffix) if is_jpeg or is_png else _decode_other(data)
    except ValueError as error:
        raise DriveError(f"{image.path} cannot be decoded: {error}") from error
    height_px, width_px = pixels.shape[:2]
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        raise CalibrationError(
            f"{image.path} has {width_px}x{height_px} pixels, the calibration is for"
            f" {camera.width_px}x{camera.height_px}"
        )
    if is_jpeg:
        writer.write_jpeg(image.stamp_ns, data)
    elif is_png:
        writer.write_png(image.stamp_ns, data)
    else:
        writer.write_image(image.stamp_ns, pixels, png=True)


def _decode_other(data: bytes) -> Image:
    """Grey (height, width) or BGR (height, width, 3), as the file has it, in 8 bits and not turned."""
    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if data else None
    if pixels is None:
        raise ValueError(f"its {len(data)} bytes are no image that OpenCV knows")
    return np.asarray(pixels, dtype=np.uint8)
