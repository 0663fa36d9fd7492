"""Simulated drives as recordings, with the truth beside them and never inside."""

from __future__ import annotations

import heapq
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import repeat
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from fleetmap.drives.conversion import reference_path
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.files import atomic_path, refuse_existing, write_text_atomically
from fleetmap.geometry import quat_xyzw_from_rotations
from fleetmap.simulation.mounting import ANTENNA_FRAME, CAMERA_FRAME, IMU_FRAME, LIDAR_FRAME, VEHICLE_FRAME
from fleetmap.simulation.parallel import render_many
from fleetmap.simulation.rendered_images import jpeg_of, rendered_images
from fleetmap.simulation.simulated_drive import SimulatedDrive
from fleetmap.simulation.world import World
from fleetmap.trajectory import write_trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Recorded:
    """What recording a drive has written."""

    recording: Path
    reference: Path  # the true poses of the images
    markers: Path | None  # where the world's markers are, if it has some


@dataclass(frozen=True)
class _Message:
    """Something ready to be written."""

    stamp_ns: int
    write: Callable[[DriveWriter], None]
    is_image: bool = False


def record_drive(
    drive: SimulatedDrive,
    path: Path,
    *,
    force: bool = False,
    progress: bool = False,
    workers: int | None = None,
    images_from: Path | None = None,
) -> Recorded:
    """Write a simulated drive as MCAP, and its truth beside it: ``survey.mcap``, ``survey.reference.tum``.

    The truth never enters the recording; where the world has markers, they come as ``survey.markers.json``. All
    of them are there whole, or none is. The same drive gives the same bytes with any number of workers.

    Args:
        drive: what to write.
        path: the recording.
        force: replace an existing recording.
        progress: show a bar on stderr.
        workers: threads that render; by default as many as this process has cores.
        images_from: a recording of this very drive whose images are taken over, which saves rendering them.

    Raises:
        OutputExistsError: the recording is there already and ``force`` is not given.
        DriveError: the other recording cannot be read.
        InputError: the other recording shows another drive; stamps are compared, and each 20th image.
        StorageError: the disk is full or refuses.
    """
    refuse_existing(path, force)
    reference, markers = reference_path(path), path.with_name(f"{path.stem}.markers.json")
    with ExitStack() as outputs:
        write_trajectory(outputs.enter_context(atomic_path(reference)), drive.trajectory)
        if drive.world.markers:
            write_markers(outputs.enter_context(atomic_path(markers)), drive.world)
        writer = outputs.enter_context(DriveWriter(path, drive.camera, force=force, camera_frame_id=CAMERA_FRAME))
        _write_mounting(writer, drive)
        hidden = None if progress else True  # None: where stderr is a file or a pipe
        images = tqdm(desc=f"render {path.name}", total=drive.frame_count, unit="image", disable=hidden)
        with images:
            for message in _messages(drive, workers, images_from):
                message.write(writer)
                images.update(message.is_image)
    if not drive.world.markers:
        markers.unlink(missing_ok=True)  # of the recording that was replaced
    return Recorded(path, reference, markers if drive.world.markers else None)


def write_markers(path: Path, world: World) -> None:
    """Write where a world's ArUco markers are, as JSON in UTM.

    ``corners_utm_m`` are easting, northing and ellipsoidal height of the black square's corners, clockwise from
    the top left as one looks at it: the order in which OpenCV reports them.
    """
    content = {
        "epsg": world.anchor.epsg,
        "corner_order": "clockwise from the top left as seen from the front",
        "markers": [_described(world, index) for index in range(len(world.markers))],
    }
    write_text_atomically(path, json.dumps(content, indent=1) + "\n")


def _described(world: World, index: int) -> dict[str, object]:
    marker = world.markers[index]
    half = marker.side_m / 2.0
    corners = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
    middle = marker.map_from_marker
    return {
        "id": marker.number,
        "dictionary": marker.dictionary,
        "side_m": marker.side_m,
        "position_utm_m": _rounded(world.anchor.utm_from_map(middle.translation_m)),
        "quat_xyzw_utm_from_marker": _rounded(quat_xyzw_from_rotations(middle.rotation), 9),
        "corners_utm_m": _rounded(world.anchor.utm_from_map(middle.transform(corners))),
    }


def _rounded(numbers: Array, digits: int = 6) -> object:
    return np.round(numbers, digits).tolist()


def _write_mounting(writer: DriveWriter, drive: SimulatedDrive) -> None:
    """Say where everything is that is on board; an antenna in the camera's own frame needs no saying."""
    mounting, sensors = drive.mounting, drive.sensors
    on_board = [
        (ANTENNA_FRAME, mounting.cam_from_antenna, bool(drive.fixes and any(mounting.antenna_in_cam_m))),
        (IMU_FRAME, mounting.cam_from_imu, sensors.imu is not None),
        (VEHICLE_FRAME, mounting.cam_from_vehicle, sensors.wheels is not None),
        (LIDAR_FRAME, mounting.cam_from_lidar, sensors.lidar is not None),
    ]
    for frame, cam_from_sensor, is_there in on_board:
        if is_there:
            writer.write_static_transform(CAMERA_FRAME, frame, cam_from_sensor)


def _messages(drive: SimulatedDrive, workers: int | None, images_from: Path | None) -> Iterator[_Message]:
    """Everything a drive records, in time order."""
    antenna_frame = ANTENNA_FRAME if any(drive.mounting.antenna_in_cam_m) else CAMERA_FRAME
    fixes = (
        _Message(fix.stamp_ns, partial(DriveWriter.write_fix, fix=fix, frame_id=antenna_frame))
        for fix in drive.fixes
    )
    imu = (
        _Message(sample.stamp_ns, partial(DriveWriter.write_imu, sample=sample, frame_id=IMU_FRAME))
        for sample in drive.imu_samples()
    )
    wheels = (
        _Message(speed.stamp_ns, partial(DriveWriter.write_wheel_speed, speed=speed, frame_id=VEHICLE_FRAME))
        for speed in drive.wheel_speeds()
    )
    rendered = render_many(lambda make: make(), _rendering_jobs(drive, images_from), workers)
    return heapq.merge(fixes, imu, wheels, rendered, key=lambda message: message.stamp_ns)


def _rendering_jobs(drive: SimulatedDrive, images_from: Path | None) -> Iterator[Callable[[], _Message]]:
    """What takes time to make, in time order."""
    stamps_ns = drive.trajectory.stamps_ns.tolist()
    known = repeat(None) if images_from is None else rendered_images(images_from, drive)
    images = (
        (stamp_ns, partial(_image, drive, index, jpeg, images_from))
        for index, (stamp_ns, jpeg) in enumerate(zip(stamps_ns, known, strict=False))
    )
    depths = ((stamp_ns, partial(_depth, drive, index)) for index, stamp_ns in enumerate(stamps_ns))
    scans = ((stamp_ns, partial(_scan, drive, stamp_ns)) for stamp_ns in drive.scan_stamps_ns())
    jobs = heapq.merge(images, depths if drive.sensors.depth else (), scans, key=lambda job: job[0])
    return (make for _, make in jobs)


def _image(drive: SimulatedDrive, index: int, rendered: bytes | None, images_from: Path | None) -> _Message:
    stamp_ns, jpeg = int(drive.trajectory.stamps_ns[index]), jpeg_of(drive, index, rendered, images_from)
    return _Message(stamp_ns, lambda writer: writer.write_jpeg(stamp_ns, jpeg), is_image=True)


def _depth(drive: SimulatedDrive, index: int) -> _Message:
    stamp_ns, depth_m = int(drive.trajectory.stamps_ns[index]), drive.depth(index)
    return _Message(stamp_ns, lambda writer: writer.write_depth(stamp_ns, depth_m))


def _scan(drive: SimulatedDrive, stamp_ns: int) -> _Message:
    ranges_m, lidar = drive.scan(stamp_ns), drive.sensors.lidar
    assert lidar is not None
    return _Message(
        stamp_ns,
        partial(
            DriveWriter.write_scan,
            stamp_ns=stamp_ns,
            ranges_m=ranges_m,
            angle_min_rad=lidar.first_rad,
            angle_increment_rad=lidar.step_rad,
            range_min_m=lidar.nearest_m,
            range_max_m=lidar.farthest_m,
            frame_id=LIDAR_FRAME,
            scan_time_s=lidar.scan_s,
        ),
    )
