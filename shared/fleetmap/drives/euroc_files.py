"""The files of a folder in the ASL layout: ``data.csv`` and ``sensor.yaml`` of cameras, IMU and truth.

Tables have their stamps in whole nanoseconds first; ``#`` starts their header. They may be packed as data.csv.gz.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fleetmap.camera import Camera
from fleetmap.camera_file import camera_of_model
from fleetmap.drive import ImuSample
from fleetmap.drives.conversion import StampedImage, checked_stamp_ns, read_lines
from fleetmap.drives.local_poses import LocalPoses, read_local_poses
from fleetmap.errors import CalibrationError, DriveError
from fleetmap.geometry import Pose

_DISTORTION_MODELS = {"radial-tangential": "plumb_bob", "radtan": "plumb_bob"}  # other names are ROS' own


def read_images(sensor: Path) -> list[StampedImage]:
    """A camera's images by its ``data.csv``; without one by the files' names, which are their stamps.

    Raises:
        DriveError: no images, or a row that is not ``timestamp,filename``.
    """
    table = find_table(sensor)
    if table is None:
        found = sorted(
            (p for p in (sensor / "data").glob("*.png") if p.stem.isdecimal()), key=lambda p: int(p.stem)
        )
        images = [StampedImage(checked_stamp_ns(int(p.stem), str(p)), p) for p in found]
    else:
        images = [
            StampedImage(_stamp_ns(table, number, row), sensor / "data" / _image_name(table, number, row))
            for number, row in _rows(table)
        ]
    if not images:
        raise DriveError(f"{sensor} holds no images: neither rows in data.csv nor data/STAMP.png")
    return images


def read_sensor_camera(path: Path) -> Camera:
    """The intrinsics of a camera's ``sensor.yaml``. Raises CalibrationError if there are none."""
    content = _read_yaml(path)
    if str(content.get("camera_model")) != "pinhole":
        raise CalibrationError(f"{path}: camera_model is '{content.get('camera_model')}', not 'pinhole'")
    width_px, height_px = (int(value) for value in _numbers(path, content, "resolution", 2))
    fx, fy, cx, cy = _numbers(path, content, "intrinsics", 4)
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    model = str(content.get("distortion_model"))
    coefficients = tuple(_numbers(path, content, "distortion_coefficients", None))
    try:
        return camera_of_model(width_px, height_px, K, _DISTORTION_MODELS.get(model, model), coefficients)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error


def read_imu(table: Path) -> Iterator[ImuSample]:
    """Rows ``stamp, angular velocity (3), acceleration (3)`` one at a time. Raises DriveError at a damaged one."""
    before_ns = -1
    for number, row in _rows(table):
        stamp_ns, values = _stamp_ns(table, number, row), _values(table, number, row, 6)
        if stamp_ns <= before_ns:
            raise DriveError(f"{table} line {number} is not later than the line before it")
        before_ns = stamp_ns
        yield ImuSample(stamp_ns, values[:3], values[3:])


def read_poses(table: Path) -> LocalPoses:
    """Rows ``stamp, x, y, z, qw, qx, qy, qz`` and more that is not needed. Raises DriveError at a damaged one."""
    return read_local_poses(
        table,
        (
            (number, _stamp_ns(table, number, row), _values(table, number, row, 7)[[0, 1, 2, 4, 5, 6, 3]])
            for number, row in _rows(table)
        ),
    )


def body_from_sensor(path: Path) -> Pose:
    """How a ``sensor.yaml`` says that its sensor is mounted (``T_BS``). Raises CalibrationError if it does not."""
    entry = _read_yaml(path).get("T_BS")
    matrix = np.array(_numbers(path, entry if isinstance(entry, dict) else {}, "data", 16)).reshape(4, 4)
    rotation = matrix[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0.0:
        raise CalibrationError(f"{path}: T_BS is no rigid transform")
    return Pose(rotation, matrix[:3, 3])


def find_table(sensor: Path) -> Path | None:
    """A sensor's ``data.csv`` or ``data.csv.gz``, where it has one."""
    return next((p for p in (sensor / "data.csv", sensor / "data.csv.gz") if p.is_file()), None)


def _rows(table: Path) -> Iterator[tuple[int, list[str]]]:
    """Line number and fields of each row that is neither empty nor a comment."""
    for number, line in enumerate(read_lines(table), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, [field.strip() for field in next(csv.reader([line]))]


def _stamp_ns(table: Path, number: int, row: list[str]) -> int:
    if not row[0].isdecimal():
        raise DriveError(f"{table} line {number}: '{row[0]}' is no time in whole nanoseconds")
    return checked_stamp_ns(int(row[0]), f"{table} line {number}")


def _image_name(table: Path, number: int, row: list[str]) -> str:
    if len(row) < 2 or not row[1] or Path(row[1]).name != row[1]:
        raise DriveError(f"{table} line {number} is not 'timestamp,filename'")
    return row[1]


def _values(table: Path, number: int, row: list[str], count: int) -> np.ndarray:
    try:
        values = np.array([float(field) for field in row[1 : count + 1]])
    except ValueError as error:
        raise DriveError(f"{table} line {number}: {error}") from error
    if len(values) != count or not np.all(np.isfinite(values)):
        raise DriveError(f"{table} line {number} does not have {count} finite numbers after its time")
    return values


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        # OpenCV's header "%YAML:1.0" is no YAML directive.
        content = yaml.safe_load("\n".join(line for line in lines if not line.startswith("%")))
    except OSError as error:
        raise CalibrationError(f"cannot read {path}: {error.strerror or error}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise CalibrationError(f"{path} is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise CalibrationError(f"{path} is no sensor.yaml of the ASL layout")
    return content


def _numbers(path: Path, content: dict[str, Any], key: str, count: int | None) -> list[float]:
    try:
        numbers = [float(value) for value in content[key]]
    except (KeyError, TypeError, ValueError) as error:
        raise CalibrationError(f"{path}: {key} is missing or no list of numbers") from error
    if count is not None and len(numbers) != count:
        raise CalibrationError(f"{path}: {key} has {len(numbers)} numbers, it needs {count}")
    return numbers
