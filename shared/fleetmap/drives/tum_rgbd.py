"""TUM RGB-D folders -> MCAP: colour images as recorded, depth images, the camera's truth.

``rgb.txt``, ``depth.txt`` (time, file) and ``groundtruth.txt`` (time, pose of the colour camera), ``rgb/*.png``,
``depth/*.png`` (16 bit, 5000 per metre, in the colour camera's pixels). Source: J. Sturm et al., "A benchmark for
the evaluation of RGB-D SLAM systems", IROS 2012, and the file formats described with the data.
``accelerometer.txt`` stays behind: without a gyroscope and a mounting it is no inertial measurement unit.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from fleetmap.camera import Camera
from fleetmap.drives.conversion import (
    Conversion,
    Message,
    Progress,
    SimulatedGnss,
    StampedImage,
    checked_stamp_ns,
    conclude,
    fix_messages,
    image_messages,
    mount_antenna,
    read_bytes,
    read_lines,
    seconds_as_ns,
    silent,
    write_in_time_order,
)
from fleetmap.drives.local_poses import (
    TRUTH_WITHOUT_SITE,
    LocalPoses,
    Site,
    fixes_at_site,
    read_local_poses,
    reference_at_site,
)
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.errors import CalibrationError, DriveError
from fleetmap.geometry import Array, Pose
from fleetmap.trajectory import Trajectory

DEPTH_UNITS_PER_METRE = np.float32(5000.0)
FRAME_ID = "camera_rgb_optical_frame"
# Published with the data for the colour cameras; freiburg3's images are rectified.
CAMERAS = {
    "1": Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": Camera(640, 480, 520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": Camera(640, 480, 535.4, 539.2, 320.1, 247.6),
}


def convert_tum_rgbd(
    folder: Path,
    output: Path,
    *,
    calibration: Camera | None = None,
    site: Site | None = None,
    gnss: SimulatedGnss | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> Conversion:
    """Write a TUM RGB-D sequence as MCAP: colour images byte by byte, depth in millimetres.

    The truth is in the room's own frame. Only ``site`` makes it a reference in UTM, which goes to
    ``NAME.reference.tum``; then ``gnss`` can make fixes from it.

    Args:
        folder: the sequence; without ``calibration`` its name says whose camera it is (freiburg1 to 3).
        output: the MCAP file.
        calibration: the colour camera.
        site: where the room is taken to stand.
        gnss: how to make fixes; None for a recording without GNSS.
        force: replace an existing output.
        progress: called with the stage, the images done, and all of them.

    Raises:
        DriveError: not a TUM RGB-D folder, a damaged line, or no truth where ``site`` or ``gnss`` need it.
        CalibrationError: no camera known for the folder, or one of another size than the images.
        OutputExistsError: the output is there already and ``force`` is not given.
    """
    if not folder.is_dir():
        raise DriveError(f"there is no folder {folder}")
    images = _read_images(folder, "rgb.txt")
    depths = _read_images(folder, "depth.txt") if (folder / "depth.txt").is_file() else []
    camera = calibration or _camera_of(folder)
    reference = _read_reference(folder, images, site)
    fixes = fixes_at_site(folder, reference, gnss)
    with DriveWriter(
        output, camera, force=force, camera_frame_id=FRAME_ID, compress_chunks=bool(depths)
    ) as writer:
        gnss_frame_id = mount_antenna(writer, FRAME_ID, gnss.antenna_in_camera_m if gnss else None)
        write_in_time_order(
            image_messages(writer, images, camera, progress),
            _depth_messages(writer, depths),
            fix_messages(writer, fixes, gnss_frame_id),
        )
    return conclude(writer, output, reference, _remarks(folder, depths, site))


def _camera_of(folder: Path) -> Camera:
    name = folder.resolve().name
    number = re.search(r"(?:freiburg|fr)([123])(?!\d)", name)
    if number is None:
        raise CalibrationError(
            f"whose camera took {name}? Its name has no freiburg1 to 3; give --camera FILE.yaml"
        )
    return CAMERAS[number[1]]


def _read_images(folder: Path, name: str) -> list[StampedImage]:
    """Lines ``time file``."""
    table = folder / name
    if not table.is_file():
        raise DriveError(f"{folder} is no TUM RGB-D folder: it holds no {name}")
    images = []
    for number, fields in _rows(table):
        path = Path(*fields[1:])
        if len(fields) != 2 or path.is_absolute() or ".." in path.parts:
            raise DriveError(f"{table} line {number} is not 'timestamp filename' of a file in {folder}")
        images.append(StampedImage(_stamp_ns(table, number, fields), folder / path))
    if not images:
        raise DriveError(f"{table} names no images")
    return images


def _depth_messages(writer: DriveWriter, depths: list[StampedImage]) -> Iterator[Message]:
    for index, depth in enumerate(depths):
        if index and depth.stamp_ns <= depths[index - 1].stamp_ns:
            raise DriveError(f"{depth.path} is not later than the depth image before it; depth.txt is damaged")
        yield depth.stamp_ns, partial(_write_depth, writer, depth)


def _write_depth(writer: DriveWriter, depth: StampedImage) -> None:
    data = read_bytes(depth.path)
    pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise DriveError(f"{depth.path} is no depth image: a PNG of one channel with 16 bits")
    try:
        writer.write_depth(depth.stamp_ns, pixels.astype(np.float32) / DEPTH_UNITS_PER_METRE)
    except CalibrationError as error:
        raise CalibrationError(f"{depth.path}: {error}") from error


def _read_reference(folder: Path, images: list[StampedImage], site: Site | None) -> Trajectory | None:
    if site is None:
        return None
    if not (folder / "groundtruth.txt").is_file():
        raise DriveError(f"--origin has nothing to place: {folder} holds no groundtruth.txt")
    return reference_at_site(_read_poses(folder / "groundtruth.txt"), Pose.identity(), images, site)


def _read_poses(table: Path) -> LocalPoses:
    return read_local_poses(
        table,
        (
            (number, _stamp_ns(table, number, fields), _pose_values(table, number, fields))
            for number, fields in _rows(table)
        ),
    )


def _pose_values(table: Path, number: int, fields: list[str]) -> Array:
    try:
        values = np.array([float(field) for field in fields[1:]])
    except ValueError as error:
        raise DriveError(f"{table} line {number}: {error}") from error
    if len(values) != 7 or not np.all(np.isfinite(values)):
        raise DriveError(f"{table} line {number} is not 'timestamp tx ty tz qx qy qz qw'")
    return values


def _remarks(folder: Path, depths: list[StampedImage], site: Site | None) -> tuple[str, ...]:
    remarks = [] if depths else [f"no depth: {folder} holds no depth.txt"]
    if site is None and (folder / "groundtruth.txt").is_file():
        remarks.append(TRUTH_WITHOUT_SITE)
    return tuple(remarks)


def _rows(table: Path) -> Iterator[tuple[int, list[str]]]:
    """Line number and fields of each line that is neither empty nor a comment."""
    for number, line in enumerate(read_lines(table), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line.split()


def _stamp_ns(table: Path, number: int, fields: list[str]) -> int:
    origin = f"{table} line {number}"
    return checked_stamp_ns(seconds_as_ns(fields[0], origin), origin)
