"""Simulated drives: in memory for those who map and localise, or written as a recording with its reference."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tqdm import tqdm

from fleetmap.camera import Camera
from fleetmap.drive import Antenna, Frame, GnssFix, ImuSample, WheelSpeed
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.errors import InputError
from fleetmap.geometry import Pose
from fleetmap.gnss import GNSS_ERROR_MODELS, sample_fixes
from fleetmap.simulation.look import Look
from fleetmap.simulation.rendering import render
from fleetmap.simulation.street import Street
from fleetmap.trajectory import Trajectory, write_trajectory

_CAMERA_FRAME_ID, _ANTENNA_FRAME_ID = "camera", "gnss"


@dataclass(frozen=True)
class SimulatedDrive:
    """A drive through a street, as ``fleetmap.drive.Drive``; its images are rendered when they are asked for."""

    street: Street
    camera: Camera
    trajectory: Trajectory  # the truth, one pose per image
    look: Look = field(default_factory=Look)
    fixes: tuple[GnssFix, ...] = ()
    antenna_in_cam_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    name: str = "simulated drive"

    @property
    def frame_count(self) -> int:
        """Number of images."""
        return len(self.trajectory)

    def frames(self) -> Iterator[Frame]:
        """The images in time order."""
        for index in range(len(self.trajectory)):
            yield self.frame(index)

    def frame(self, index: int) -> Frame:
        """One image."""
        image = render(self.street, self.camera, self.map_from_cam(index), self.look)
        return Frame(int(self.trajectory.stamps_ns[index]), image)

    def map_from_cam(self, index: int) -> Pose:
        """The true pose of one image in the street's map frame."""
        utm_from_cam = self.trajectory.pose(index)
        return Pose(utm_from_cam.rotation, self.street.anchor.map_from_utm(utm_from_cam.translation_m))

    def gnss_fixes(self) -> list[GnssFix]:
        """All fixes in time order."""
        return list(self.fixes)

    def antenna(self) -> Antenna:
        """Where the antenna sits in the camera's frame."""
        offset = np.array(self.antenna_in_cam_m, dtype=np.float64)
        return Antenna(offset, "static transform" if offset.any() else "same frame")

    def imu_samples(self) -> Iterator[ImuSample]:
        """None are simulated."""
        return iter(())

    def wheel_speeds(self) -> Iterator[WheelSpeed]:
        """None are simulated."""
        return iter(())


def simulate_drive(
    street: Street,
    *,
    camera: Camera,
    trajectory: Trajectory,
    look: Look | None = None,
    gnss: str | None = "rtk",
    gnss_interval_s: float = 0.1,
    gnss_gap_s: tuple[float, float] | None = None,
    antenna_in_cam_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    seed: int = 0,
    name: str = "simulated drive",
) -> SimulatedDrive:
    """A drive with the fixes that a receiver of the given error model would have reported.

    Args:
        street: where.
        camera: with what.
        trajectory: the camera's true poses ``utm_from_cam``, such as ``drive_along`` gives.
        look: what lens and sensor make of the light.
        gnss: "rtk", "consumer" (see fleetmap.gnss) or None for no fixes.
        gnss_interval_s: seconds between fixes.
        gnss_gap_s: start (seconds since the first image) and length of a stretch without fixes.
        antenna_in_cam_m: the antenna in the camera's frame.
        seed: of the fixes' errors.
        name: what messages and provenance call the drive.

    Raises:
        InputError: an unknown error model, or an interval or gap that makes no sense.
    """
    fixes: list[GnssFix] = []
    if gnss is not None:
        if gnss not in GNSS_ERROR_MODELS:
            raise InputError(f"there is no GNSS error model {gnss!r}; choose from {', '.join(GNSS_ERROR_MODELS)}")
        fixes = sample_fixes(
            trajectory,
            GNSS_ERROR_MODELS[gnss],
            interval_s=gnss_interval_s,
            gap_s=gnss_gap_s,
            antenna_in_cam_m=antenna_in_cam_m,
            seed=seed,
        )
    return SimulatedDrive(street, camera, trajectory, look or Look(), tuple(fixes), antenna_in_cam_m, name)


def record_drive(
    street: Street,
    path: Path,
    *,
    camera: Camera,
    trajectory: Trajectory,
    look: Look | None = None,
    gnss: str | None = "rtk",
    gnss_interval_s: float = 0.1,
    gnss_gap_s: tuple[float, float] | None = None,
    antenna_in_cam_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    seed: int = 0,
    force: bool = False,
    progress: bool = False,
) -> Path:
    """Write a simulated drive as MCAP, and its truth beside it: ``survey.mcap``, ``survey.reference.tum``.

    The truth never enters the recording. ``force`` replaces an existing recording, ``progress`` shows a bar on
    stderr; the other arguments and errors are those of :func:`simulate_drive`.

    Returns:
        The path of the reference.

    Raises:
        OutputExistsError: the recording is there already and ``force`` is not given.
        StorageError: the disk is full or refuses.
    """
    drive = simulate_drive(
        street,
        camera=camera,
        trajectory=trajectory,
        look=look,
        gnss=gnss,
        gnss_interval_s=gnss_interval_s,
        gnss_gap_s=gnss_gap_s,
        antenna_in_cam_m=antenna_in_cam_m,
        seed=seed,
    )
    with DriveWriter(path, camera, force=force, camera_frame_id=_CAMERA_FRAME_ID) as writer:
        _write_fixes(writer, drive)
        label = f"render {path.name}"
        for frame in tqdm(drive.frames(), label, drive.frame_count, unit="image", disable=not progress):
            writer.write_image(frame.stamp_ns, frame.image)
    reference = path.with_name(f"{path.stem}.reference.tum")
    write_trajectory(reference, trajectory)
    return reference


def _write_fixes(writer: DriveWriter, drive: SimulatedDrive) -> None:
    """Fixes in the camera's own frame, or in the antenna's with a static transform to it."""
    frame_id = _CAMERA_FRAME_ID
    if any(drive.antenna_in_cam_m):
        frame_id = _ANTENNA_FRAME_ID
        mounting = Pose(np.eye(3), np.array(drive.antenna_in_cam_m, dtype=np.float64))
        writer.write_static_transform(_CAMERA_FRAME_ID, _ANTENNA_FRAME_ID, mounting)
    for fix in drive.fixes:
        writer.write_fix(fix, frame_id)
