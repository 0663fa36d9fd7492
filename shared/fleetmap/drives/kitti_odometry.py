"""KITTI odometry -> MCAP: a rectified camera, and GNSS fixes made from the reference by an error model.

Published layout: ``sequences/NN/{image_N,times.txt,calib.txt}`` and ``poses/NN.txt``. Flat layout: ``camN``,
``K.txt``, ``times.txt``, ``gt_camN_utm32n*.csv`` and ``poses_cam0_kitti.txt`` in one folder.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fleetmap.camera import Camera
from fleetmap.drive import START_NS, GnssFix
from fleetmap.drives.conversion import (
    Conversion,
    Progress,
    SimulatedGnss,
    conclude,
    fix_messages,
    image_messages,
    mount_antenna,
    read_lines,
    seconds_as_ns,
    silent,
    simulated_fixes,
    write_in_time_order,
)
from fleetmap.drives.kitti import (
    NumberedImage,
    baseline_shift_m,
    calibration_entry,
    find_reference_csv,
    image_size_px,
    pinhole,
    read_calibration,
    read_reference_csv,
    stamped_images,
)
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.errors import CalibrationError, DriveError
from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import Array, Pose
from fleetmap.trajectory import Trajectory


@dataclass(frozen=True)
class Origin:
    """Where the first camera centre stands, and where its optical axis points; the camera is level there."""

    lat_deg: float
    lon_deg: float
    height_m: float  # above the ellipsoid
    heading_deg: float  # clockwise from true north


@dataclass(frozen=True)
class _Layout:
    images: Path
    times: Path
    calibration: Path  # calib.txt or K.txt
    poses: Path  # of camera 0; need not be there
    reference_csv: Path | None


def convert_kitti_odometry(
    folder: Path,
    output: Path,
    *,
    camera: int = 0,
    sequence: str | None = None,
    gnss: SimulatedGnss | None = None,
    origin: Origin | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> Conversion:
    """Write one camera of a KITTI odometry sequence as MCAP; with ``gnss`` also fixes made from its reference.

    Times are relative, so the recording starts at 2023-11-14T22:13:20Z. The reference is placed in UTM by
    ``origin``, else by the folder's own CSV, and written to ``NAME.reference.tum``.

    Args:
        folder: the data set's root with ``sequence``, a ``sequences/NN`` folder, or a flat folder.
        output: the MCAP file.
        camera: which camera.
        sequence: such as "00", where ``folder`` is the data set's root.
        gnss: how to make fixes; None for a recording without GNSS.
        origin: where to place poses that have no site.
        force: replace an existing output.
        progress: called with the stage, the images done, and all of them.

    Raises:
        DriveError: not a KITTI odometry folder, a damaged one, or one without the reference that GNSS needs.
        CalibrationError: the calibration is missing or damaged.
        OutputExistsError: the output is there already and ``force`` is not given.
    """
    layout = _find_layout(folder, camera, sequence)
    images = stamped_images(layout.images, _read_times(layout.times), layout.times)
    calibrated, cam0_from_camera = _read_camera(layout, camera, image_size_px(images[0]))
    reference = _read_reference(layout, images, cam0_from_camera, origin)
    fixes = _make_fixes(folder, reference, gnss) if gnss else []
    frame_id = f"cam{camera}"
    with DriveWriter(
        output,
        calibrated,
        force=force,
        camera_frame_id=frame_id,
        image_topic=f"/cam{camera}/image/compressed",
        info_topic=f"/cam{camera}/camera_info",
    ) as writer:
        gnss_frame_id = mount_antenna(writer, frame_id, gnss.antenna_in_camera_m if gnss else None)
        write_in_time_order(
            image_messages(writer, images, calibrated, progress), fix_messages(writer, fixes, gnss_frame_id)
        )
    return conclude(writer, output, reference)


def place_poses(poses: list[Pose], origin: Origin) -> list[Pose]:
    """Poses ``first_from_cam`` of a metric trajectory as ``utm_from_cam``, the first one level at the origin.

    Metres of the poses are taken as grid metres (they differ by at most 0.4 mm/m at UTM's point scale).
    """
    grid = UtmGrid.at(origin.lat_deg, origin.lon_deg)
    centre = grid.from_geodetic(np.array(origin.lat_deg), np.array(origin.lon_deg), np.array(origin.height_m))
    heading = np.radians(origin.heading_deg) - grid.convergence_rad(origin.lat_deg, origin.lon_deg)
    sin, cos = np.sin(heading), np.cos(heading)
    right, down, forward = (cos, -sin, 0.0), (0.0, 0.0, -1.0), (sin, cos, 0.0)
    utm_from_level = Pose(np.array([right, down, forward]).T, centre)
    level_from_poses = poses[0].inverse()
    return [utm_from_level @ level_from_poses @ pose for pose in poses]


def _find_layout(folder: Path, camera: int, sequence: str | None) -> _Layout:
    if not folder.is_dir():
        raise DriveError(f"there is no folder {folder}")
    if sequence is None and (folder / f"cam{camera}").is_dir():
        return _Layout(
            folder / f"cam{camera}",
            folder / "times.txt",
            folder / "K.txt",
            folder / "poses_cam0_kitti.txt",
            find_reference_csv(folder, camera),
        )
    place = _sequence_folder(folder, sequence).resolve()
    images = place / f"image_{camera}"
    if not images.is_dir():
        raise DriveError(
            f"{folder} is no KITTI odometry sequence with camera {camera}: it has neither image_{camera}"
            f" (as published: sequences/NN) nor cam{camera} (flat)"
        )
    poses = place.parent.parent / "poses" / f"{place.name}.txt"
    return _Layout(images, place / "times.txt", place / "calib.txt", poses, None)


def _sequence_folder(folder: Path, sequence: str | None) -> Path:
    sequences = next((f for f in (folder / "sequences", folder / "dataset" / "sequences") if f.is_dir()), None)
    if sequences is None:
        if sequence is not None and folder.resolve().name != sequence:
            raise DriveError(f"{folder} has no sequences/{sequence}; give the data set's root with --sequence")
        return folder
    held = ", ".join(sorted(p.name for p in sequences.iterdir() if p.is_dir())) or "none"
    if sequence is None:
        raise DriveError(f"{folder} holds several sequences; choose one with --sequence ({held})")
    if not (sequences / sequence).is_dir():
        raise DriveError(f"{sequences} has no sequence {sequence}; it has {held}")
    return sequences / sequence


def _read_times(path: Path) -> dict[int, int]:
    return {
        number: START_NS + seconds_as_ns(line, f"{path} line {number + 1}")
        for number, line in enumerate(read_lines(path))
        if line.strip()
    }


def _read_camera(layout: _Layout, camera: int, size_px: tuple[int, int]) -> tuple[Camera, Pose]:
    """The rectified camera, and ``cam0_from_camera``: rectified cameras are shifted, not turned."""
    if layout.calibration.name == "K.txt":
        K, cam0_from_camera = _read_matrix(layout.calibration), Pose.identity()
    else:
        P = calibration_entry(read_calibration(layout.calibration), f"P{camera}", (3, 4), layout.calibration)
        K, cam0_from_camera = P[:, :3], Pose(np.eye(3), -baseline_shift_m(P))
    return pinhole(size_px, K), cam0_from_camera


def _read_matrix(path: Path) -> Array:
    try:
        values = np.array([float(number) for number in path.read_text(encoding="utf-8").split()])
    except (OSError, ValueError) as error:
        raise CalibrationError(f"cannot read calibration {path}: {error}") from error
    if values.size != 9:
        raise CalibrationError(f"{path} has {values.size} numbers, a camera matrix has 9")
    return values.reshape(3, 3)


def _read_reference(
    layout: _Layout, images: list[NumberedImage], cam0_from_camera: Pose, origin: Origin | None
) -> Trajectory | None:
    if origin is None:
        return read_reference_csv(layout.reference_csv, images) if layout.reference_csv else None
    if not layout.poses.is_file():
        raise DriveError(f"--origin has nothing to place: there are no poses {layout.poses}")
    placed = place_poses(_read_poses(layout.poses), origin)
    posed = [image for image in images if image.frame < len(placed)]
    if not posed:
        raise DriveError(f"{layout.poses} has no pose for any of the {len(images)} images")
    poses = [placed[image.frame] @ cam0_from_camera for image in posed]
    return Trajectory(
        UtmGrid.at(origin.lat_deg, origin.lon_deg).epsg,
        np.array([image.stamp_ns for image in posed], dtype=np.int64),
        np.array([pose.translation_m for pose in poses]),
        np.array([pose.rotation for pose in poses]),
    )


def _read_poses(path: Path) -> list[Pose]:
    """One 3x4 matrix ``first_from_cam0`` per line."""
    poses = []
    for number, line in enumerate(read_lines(path), start=1):
        try:
            matrix = np.array([float(value) for value in line.split()]).reshape(3, 4)
        except ValueError as error:
            raise DriveError(f"{path} line {number} is no pose of 12 numbers") from error
        poses.append(Pose(matrix[:, :3], matrix[:, 3]))
    if not poses:
        raise DriveError(f"{path} holds no poses")
    return poses


def _make_fixes(folder: Path, reference: Trajectory | None, gnss: SimulatedGnss) -> list[GnssFix]:
    if reference is None:
        raise DriveError(
            f"{folder} has no reference in UTM to make GNSS fixes from; a sequence with poses can be placed"
            " with --origin LAT,LON,HEIGHT,HEADING_DEG"
        )
    return simulated_fixes(reference, gnss)
