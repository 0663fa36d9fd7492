"""What KITTI's raw and odometry folders have in common: calibration files, numbered images, clocks, references.

The published layouts are described by A. Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013,
and the development kits that come with the data.
"""

from __future__ import annotations

import calendar
import csv
import re
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fleetmap.camera import Camera
from fleetmap.drives.conversion import StampedImage, read_bytes, read_lines
from fleetmap.drives.image_codec import decode_compressed
from fleetmap.errors import CalibrationError, DriveError
from fleetmap.geometry import Array, Pose, rotations_from_quat_xyzw
from fleetmap.trajectory import Trajectory

_IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True)
class NumberedImage(StampedImage):
    """One image file whose name is its number."""

    frame: int


def stamped_images(folder: Path, stamps_ns: dict[int, int], timestamps: Path) -> list[NumberedImage]:
    """The images of a folder in the order of their numbers, each with the stamp of that number.

    Raises:
        DriveError: no images, or an image without a stamp.
    """
    found = {int(p.stem): p for p in _listed(folder) if p.suffix in _IMAGE_SUFFIXES and p.stem.isdigit()}
    if not found:
        raise DriveError(f"{folder} holds no images named like 000000.png or 000000.jpg")
    missing = sorted(found.keys() - stamps_ns.keys())
    if missing:
        raise DriveError(f"{found[missing[0]]} has no time: {timestamps} has no line for image {missing[0]}")
    return [NumberedImage(stamps_ns[frame], found[frame], frame) for frame in sorted(found)]


def image_size_px(image: StampedImage) -> tuple[int, int]:
    """Width and height of an image file. Raises DriveError if it cannot be decoded."""
    try:
        height, width = decode_compressed(read_bytes(image.path), image.path.suffix).shape
    except ValueError as error:
        raise DriveError(f"{image.path} cannot be decoded: {error}") from error
    return width, height


def read_clock_readings(path: Path) -> dict[int, int]:
    """KITTI raw's ``timestamps.txt`` by line number from 0: nanoseconds since the epoch, read as UTC."""
    readings = {}
    for number, line in enumerate(read_lines(path)):
        if line.strip():
            readings[number] = _clock_reading_ns(path, number, line)
    return readings


def read_calibration(path: Path) -> dict[str, Array]:
    """A KITTI calibration file: ``key: numbers`` per line; lines that are not numbers are left out.

    Raises:
        CalibrationError: no such file.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"cannot read calibration {path}: {error}") from error
    entries = {}
    for line in lines:
        key, _, numbers = line.partition(":")
        try:
            entries[key.strip()] = np.array([float(number) for number in numbers.split()])
        except ValueError:
            continue
    return entries


def calibration_entry(entries: dict[str, Array], key: str, shape: tuple[int, ...], path: Path) -> Array:
    """One entry in its shape. Raises CalibrationError if it is not there or has another count of numbers."""
    values = entries.get(key)
    if values is None or values.size != np.prod(shape):
        raise CalibrationError(f"{path} has no '{key}:' with {np.prod(shape)} numbers")
    return values.reshape(shape)


def pinhole(size_px: tuple[int, int], K: Array, distortion: Array | None = None) -> Camera:
    """A camera of a size (width, height) from K (3, 3) or P (3, 4), and k1, k2, p1, p2, k3."""
    fx, fy, cx, cy = (float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    k1, k2, p1, p2, k3 = (float(value) for value in (np.zeros(5) if distortion is None else distortion))
    return Camera(*size_px, fx, fy, cx, cy, distortion=(k1, k2, p1, p2, k3))


def baseline_shift_m(P: Array) -> Array:
    """A rectified camera's shift (3,): x_cam = x_cam0 + shift, as the last column of its P (3, 4) holds it."""
    return np.asarray(np.linalg.solve(P[:, :3], P[:, 3]), dtype=np.float64)


def read_rigid_transform(path: Path) -> Pose:
    """``R:`` and ``T:`` of a KITTI calibration file."""
    entries = read_calibration(path)
    return Pose(calibration_entry(entries, "R", (3, 3), path), calibration_entry(entries, "T", (3,), path))


def read_reference_csv(path: Path, images: list[NumberedImage]) -> Trajectory:
    """Poses ``frame,...,easting,northing,alt,qx,qy,qz,qw`` of the images' numbers, at the images' stamps.

    Raises:
        DriveError: the file's name does not say its UTM zone, a column is missing, or no image has a pose.
    """
    zone = re.search(r"utm(\d{1,2})([ns])", path.name)
    if zone is None:
        raise DriveError(f"{path} does not name its UTM zone, such as gt_cam0_utm32n.csv")
    epsg = (32600 if zone[2] == "n" else 32700) + int(zone[1])
    columns = ("easting", "northing", "alt", "qx", "qy", "qz", "qw")
    try:
        rows = {
            int(row["frame"]): [float(row[column]) for column in columns]
            for row in csv.DictReader(read_lines(path))
        }
    except (KeyError, TypeError, ValueError) as error:
        raise DriveError(
            f"{path} is no reference with the columns frame, {', '.join(columns)}: {error}"
        ) from error
    posed = [image for image in images if image.frame in rows]
    if not posed:
        raise DriveError(f"{path} has no pose for any of the {len(images)} images")
    values = np.array([rows[image.frame] for image in posed])
    stamps_ns = np.array([image.stamp_ns for image in posed], dtype=np.int64)
    return Trajectory(epsg, stamps_ns, values[:, :3], rotations_from_quat_xyzw(values[:, 3:]))


def find_reference_csv(folder: Path, camera: int) -> Path | None:
    """``gt_camN_*utm32n*.csv`` of a flat folder. Raises DriveError where there are several."""
    found = sorted(folder.glob(f"gt_cam{camera}_*utm*.csv"))
    if len(found) > 1:
        raise DriveError(
            f"{folder} holds {len(found)} references of camera {camera}: {found[0].name}, {found[1].name}"
        )
    return found[0] if found else None


def _listed(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError as error:
        raise DriveError(f"cannot list images in {folder}: {error.strerror or error}") from error


def _clock_reading_ns(path: Path, number: int, line: str) -> int:
    whole, _, fraction = line.strip().partition(".")
    try:
        seconds = calendar.timegm(time.strptime(whole, "%Y-%m-%d %H:%M:%S"))
        return seconds * 1_000_000_000 + int((fraction + "0" * 9)[:9])
    except ValueError as error:
        raise DriveError(f"{path} line {number + 1} is no time like 2011-09-26 14:05:35.500923136") from error
