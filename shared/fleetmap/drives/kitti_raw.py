"""KITTI raw -> MCAP: one grey or colour camera, the OXTS positions, and how both are mounted.

Published layout: ``DATE_drive_NNNN_sync|extract/{image_0N,oxts}/{data,timestamps.txt}``, calibration in the
folder above. Flat layout: ``camN``, ``camN_timestamps.txt``, ``gnss_oxts.csv``, calibration in one folder.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fleetmap.camera import Camera
from fleetmap.drive import GnssFix
from fleetmap.drives.conversion import (
    Conversion,
    Progress,
    conclude,
    fix_messages,
    image_messages,
    read_lines,
    seconds_as_ns,
    silent,
    write_in_time_order,
)
from fleetmap.drives.kitti import (
    baseline_shift_m,
    calibration_entry,
    find_reference_csv,
    image_size_px,
    pinhole,
    read_calibration,
    read_clock_readings,
    read_reference_csv,
    read_rigid_transform,
    stamped_images,
)
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.errors import CalibrationError, DriveError
from fleetmap.geometry import Array, Pose

_DAY_NS = 86_400 * 1_000_000_000
_OXTS_LAT, _OXTS_LON, _OXTS_ALT, _OXTS_POS_ACCURACY = 0, 1, 2, 23  # columns of dataformat.txt
_CAM_TO_CAM, _IMU_TO_VELO, _VELO_TO_CAM = "calib_cam_to_cam.txt", "calib_imu_to_velo.txt", "calib_velo_to_cam.txt"


@dataclass(frozen=True)
class _Layout:
    images: Path
    timestamps: Path
    calibration: Path  # folder of the three calibration files


@dataclass(frozen=True)
class _MountedCamera:
    camera: Camera
    frame_id: str
    cam0_from_camera: Pose  # cam0 is the unrectified camera 0


def convert_kitti_raw(
    folder: Path,
    output: Path,
    *,
    camera: int = 0,
    gnss: bool = True,
    force: bool = False,
    progress: Progress = silent,
) -> Conversion:
    """Write one camera of a KITTI raw drive as MCAP, with its OXTS positions as NavSatFix of frame ``imu``.

    KITTI's clock readings count as UTC. A flat folder with reference poses also gives ``NAME.reference.tum``.

    Raises:
        DriveError: not a KITTI raw folder, or a damaged one.
        CalibrationError: calibration files are missing or fit none of the images' sizes.
        OutputExistsError: the output is there already and ``force`` is not given.
    """
    layout = _find_layout(folder, camera)
    images = stamped_images(layout.images, read_clock_readings(layout.timestamps), layout.timestamps)
    mounted = _read_camera(layout, camera, image_size_px(images[0]))
    fixes = _read_fixes(folder, images[0].stamp_ns) if gnss else []
    reference_csv = find_reference_csv(folder, camera)
    reference = read_reference_csv(reference_csv, images) if reference_csv else None
    with DriveWriter(
        output,
        mounted.camera,
        force=force,
        camera_frame_id=mounted.frame_id,
        image_topic=f"/cam{camera}/image/compressed",
        info_topic=f"/cam{camera}/camera_info",
    ) as writer:
        if gnss:
            _write_mounting(writer, layout, mounted)
        write_in_time_order(
            image_messages(writer, images, mounted.camera, progress), fix_messages(writer, fixes, "imu")
        )
    return conclude(writer, output, reference)


def _find_layout(folder: Path, camera: int) -> _Layout:
    if not folder.is_dir():
        raise DriveError(f"there is no folder {folder}")
    if (folder / f"cam{camera}").is_dir():
        return _Layout(folder / f"cam{camera}", folder / f"cam{camera}_timestamps.txt", folder)
    published = folder / f"image_{camera:02d}"
    if (published / "data").is_dir():
        calibration = folder if (folder / _CAM_TO_CAM).is_file() else folder.resolve().parent
        return _Layout(published / "data", published / "timestamps.txt", calibration)
    cameras = sorted(p.name for p in folder.iterdir() if p.name.startswith(("image_0", "cam")) and p.is_dir())
    if cameras:
        raise DriveError(f"{folder} has no images of camera {camera}; it has {', '.join(cameras)}")
    raise DriveError(
        f"{folder} is no KITTI raw drive: it has neither image_{camera:02d}/data (as published: the folder"
        f" DATE_drive_NNNN_sync or _extract) nor cam{camera} (flat)"
    )


def _read_camera(layout: _Layout, camera: int, size_px: tuple[int, int]) -> _MountedCamera:
    """Images as large as S_rect are rectified (P_rect, no distortion), as large as S not (K and D)."""
    path = layout.calibration / _CAM_TO_CAM
    entries = read_calibration(path)

    def entry(key: str, *shape: int) -> Array:
        return calibration_entry(entries, f"{key}_{camera:02d}", shape, path)

    rectified_px, original_px = (tuple(int(v) for v in entry(key, 2)) for key in ("S_rect", "S"))
    if size_px == original_px:
        cam_from_cam0 = Pose(entry("R", 3, 3), entry("T", 3))
        unrectified = pinhole(size_px, entry("K", 3, 3), entry("D", 5))
        return _MountedCamera(unrectified, f"cam{camera}", cam_from_cam0.inverse())
    if size_px == rectified_px:
        P, R_rect_00 = entry("P_rect", 3, 4), calibration_entry(entries, "R_rect_00", (3, 3), path)
        rect_from_cam0 = Pose(R_rect_00, baseline_shift_m(P))
        return _MountedCamera(pinhole(size_px, P), f"cam{camera}_rect", rect_from_cam0.inverse())
    raise CalibrationError(
        f"images of camera {camera} have {size_px[0]}x{size_px[1]} pixels; {path} knows"
        f" {original_px[0]}x{original_px[1]} (unrectified) and {rectified_px[0]}x{rectified_px[1]} (rectified)"
    )


def _write_mounting(writer: DriveWriter, layout: _Layout, mounted: _MountedCamera) -> None:
    velo_from_imu = read_rigid_transform(layout.calibration / _IMU_TO_VELO)
    cam0_from_velo = read_rigid_transform(layout.calibration / _VELO_TO_CAM)
    writer.write_static_transform("imu", "velo", velo_from_imu.inverse())
    writer.write_static_transform("velo", "cam0", cam0_from_velo.inverse())
    if mounted.frame_id != "cam0":
        writer.write_static_transform("cam0", mounted.frame_id, mounted.cam0_from_camera)


def _read_fixes(folder: Path, first_image_ns: int) -> list[GnssFix]:
    if (folder / "gnss_oxts.csv").is_file():
        return _read_flat_fixes(folder / "gnss_oxts.csv", first_image_ns // _DAY_NS * _DAY_NS)
    if (folder / "oxts" / "data").is_dir():
        return _read_oxts(folder / "oxts")
    raise DriveError(f"{folder} holds no GNSS: neither gnss_oxts.csv nor oxts/data; convert it with --no-gnss")


def _read_flat_fixes(path: Path, midnight_ns: int) -> list[GnssFix]:
    """``t_sec_of_day,lat,lon,alt,pos_accuracy_m``; the day is that of the first image."""
    fixes = []
    for number, row in enumerate(csv.DictReader(read_lines(path)), start=2):
        try:
            stamp_ns = midnight_ns + seconds_as_ns(row["t_sec_of_day"], f"{path} line {number}")
            lat, lon, alt, accuracy = (float(row[key]) for key in ("lat", "lon", "alt", "pos_accuracy_m"))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise DriveError(f"{path} line {number} is not t_sec_of_day,lat,lon,alt,pos_accuracy_m") from error
        fixes.append(GnssFix(stamp_ns, lat, lon, alt, np.eye(3) * accuracy**2))
    return fixes


def _read_oxts(folder: Path) -> list[GnssFix]:
    """Published OXTS records, one file each; the file's number is its line in timestamps.txt."""
    stamps_ns = read_clock_readings(folder / "timestamps.txt")
    fixes = []
    for path in sorted((folder / "data").glob("*.txt")):
        if not path.stem.isdigit() or int(path.stem) not in stamps_ns:
            raise DriveError(f"{path} has no time in {folder / 'timestamps.txt'}")
        try:
            values = [float(value) for value in " ".join(read_lines(path)).split()]
            lat, lon, alt, accuracy = (
                values[column] for column in (_OXTS_LAT, _OXTS_LON, _OXTS_ALT, _OXTS_POS_ACCURACY)
            )
        except (ValueError, IndexError) as error:
            raise DriveError(f"{path} is no OXTS record of 30 numbers") from error
        fixes.append(GnssFix(stamps_ns[int(path.stem)], lat, lon, alt, np.eye(3) * accuracy**2))
    return fixes
