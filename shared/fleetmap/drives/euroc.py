"""EuRoC and other folders in the ASL layout -> MCAP: one camera, the IMU at its full rate, how both are mounted.

``mav0/camN/{data.csv,sensor.yaml,data/*.png}``, ``mav0/imu0/{data.csv,sensor.yaml}``, and the truth, if there is
one, in ``mav0/{state_groundtruth_estimate0,mocap0,vicon0}``. Source: M. Burri et al., "The EuRoC micro aerial
vehicle datasets", IJRR 2016.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fleetmap.camera import Camera
from fleetmap.drives.conversion import (
    Conversion,
    Progress,
    SimulatedGnss,
    StampedImage,
    conclude,
    fix_messages,
    image_messages,
    imu_messages,
    mount_antenna,
    silent,
    write_in_time_order,
)
from fleetmap.drives.euroc_files import (
    body_from_sensor,
    find_table,
    read_images,
    read_imu,
    read_poses,
    read_sensor_camera,
)
from fleetmap.drives.local_poses import TRUTH_WITHOUT_SITE, Site, fixes_at_site, reference_at_site
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.errors import CalibrationError, DriveError
from fleetmap.geometry import Pose
from fleetmap.trajectory import Trajectory

_TRUTHS = ("state_groundtruth_estimate0", "mocap0", "vicon0")  # the first that is there counts
_BODY, _IMU = "body", "imu0"


@dataclass(frozen=True)
class _Sensors:
    """What ``sensor.yaml`` files say."""

    camera: Camera
    body_from_cam: Pose | None  # None where only a calibration without mounting was given
    body_from_imu: Pose | None  # None without imu0/sensor.yaml


def convert_euroc(
    folder: Path,
    output: Path,
    *,
    camera: int = 0,
    calibration: Camera | None = None,
    site: Site | None = None,
    gnss: SimulatedGnss | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> Conversion:
    """Write one camera of a folder in the ASL layout as MCAP, with its IMU and the mounting of both.

    The truth of such folders is in a room's own frame. Only ``site`` makes it a reference in UTM, which goes to
    ``NAME.reference.tum``; then ``gnss`` can make fixes from it.

    Args:
        folder: the sequence (it holds ``mav0``), or ``mav0`` itself.
        output: the MCAP file.
        camera: which camera.
        calibration: takes the place of ``sensor.yaml``'s intrinsics.
        site: where the room is taken to stand.
        gnss: how to make fixes; None for a recording without GNSS.
        force: replace an existing output.
        progress: called with the stage, the images done, and all of them.

    Raises:
        DriveError: not in the ASL layout, a damaged row, or no truth where ``site`` or ``gnss`` need it.
        CalibrationError: ``sensor.yaml`` is missing or damaged, or its size is not the images'.
        OutputExistsError: the output is there already and ``force`` is not given.
    """
    root = _find_root(folder, camera)
    images = read_images(root / f"cam{camera}")
    sensors = _read_sensors(root, camera, calibration)
    imu_csv = find_table(root / _IMU)
    reference = _read_reference(root, sensors, images, site)
    fixes = fixes_at_site(folder, reference, gnss)
    frame_id = f"cam{camera}"
    with DriveWriter(
        output,
        sensors.camera,
        force=force,
        camera_frame_id=frame_id,
        image_topic=f"/{frame_id}/image/compressed",
        info_topic=f"/{frame_id}/camera_info",
        imu_topic=f"/{_IMU}/data",
    ) as writer:
        _write_mounting(writer, sensors, frame_id)
        gnss_frame_id = mount_antenna(writer, frame_id, gnss.antenna_in_camera_m if gnss else None)
        write_in_time_order(
            image_messages(writer, images, sensors.camera, progress),
            imu_messages(writer, read_imu(imu_csv) if imu_csv else (), _IMU),
            fix_messages(writer, fixes, gnss_frame_id),
        )
    return conclude(writer, output, reference, _remarks(root, site, imu_csv))


def _find_root(folder: Path, camera: int) -> Path:
    if not folder.is_dir():
        raise DriveError(f"there is no folder {folder}")
    root = next((place for place in (folder / "mav0", folder) if (place / f"cam{camera}").is_dir()), None)
    if root is not None:
        return root
    held = sorted(p.name for place in (folder / "mav0", folder) for p in place.glob("cam*") if p.is_dir())
    raise DriveError(
        f"{folder} has no images of camera {camera}; it has {', '.join(held)}"
        if held
        else f"{folder} is not in the ASL layout: it holds no mav0/cam{camera}"
    )


def _read_sensors(root: Path, camera: int, calibration: Camera | None) -> _Sensors:
    camera_yaml, imu_yaml = root / f"cam{camera}" / "sensor.yaml", root / _IMU / "sensor.yaml"
    body_from_imu = body_from_sensor(imu_yaml) if imu_yaml.is_file() else None
    if calibration is not None and not camera_yaml.is_file():
        return _Sensors(calibration, None, body_from_imu)
    return _Sensors(calibration or read_sensor_camera(camera_yaml), body_from_sensor(camera_yaml), body_from_imu)


def _read_reference(
    root: Path, sensors: _Sensors, images: list[StampedImage], site: Site | None
) -> Trajectory | None:
    """The truth of the body, carried to the camera and to the site; nothing without a site."""
    if site is None:
        return None
    truth = _find_truth(root)
    if truth is None:
        raise DriveError(f"--origin has nothing to place: {root} holds none of {', '.join(_TRUTHS)}")
    if sensors.body_from_cam is None:
        raise CalibrationError(f"{root} does not say how its camera is mounted (sensor.yaml with T_BS)")
    described = truth.parent / "sensor.yaml"
    body_from_truth = body_from_sensor(described) if described.is_file() else Pose.identity()
    poses = read_poses(truth)
    return reference_at_site(poses, body_from_truth.inverse() @ sensors.body_from_cam, images, site)


def _find_truth(root: Path) -> Path | None:
    return next((table for name in _TRUTHS if (table := find_table(root / name)) is not None), None)


def _write_mounting(writer: DriveWriter, sensors: _Sensors, camera_frame_id: str) -> None:
    if sensors.body_from_cam is not None:
        writer.write_static_transform(_BODY, camera_frame_id, sensors.body_from_cam)
    if sensors.body_from_imu is not None:
        writer.write_static_transform(_BODY, _IMU, sensors.body_from_imu)


def _remarks(root: Path, site: Site | None, imu_csv: Path | None) -> tuple[str, ...]:
    remarks = [] if imu_csv else [f"no IMU: {root} holds no {_IMU}/data.csv"]
    if site is None and _find_truth(root) is not None:
        remarks.append(TRUTH_WITHOUT_SITE)
    return tuple(remarks)
