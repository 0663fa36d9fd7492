"""A small world of points for what reckons without images, and a simulated drive for the whole mapper."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.drive import Antenna, Frame, GnssFix, ImuSample, SensorMounting, WheelSpeed
from fleetmap.drives import open_drive
from fleetmap.geometry import Pose, so3_exp
from fleetmap_mapper.mapper import MappedDrive, map_drive
from fleetmap_mapper.settings import MapperSettings

Array = NDArray[np.float64]
CAMERA = Camera(640, 400, 430.0, 435.0, 322.0, 197.0)


@dataclass(frozen=True)
class World:
    """Cameras that drive through a cloud of points, and the pixels they see it at. Sorted by point."""

    camera: Camera
    poses: list[Pose]  # K world_from_cam: x east, y north, z up
    points: Array  # (P, 3)
    keyframe_index: NDArray[np.int32]  # (M,)
    point_index: NDArray[np.int32]  # (M,) sorted
    pixels: Array  # (M, 2) undistorted
    sigmas_px: Array  # (M,)

    @property
    def centres(self) -> Array:
        return np.array([pose.translation_m for pose in self.poses])

    def moved(self, rng: np.random.Generator, shift_m: float, turn_rad: float, point_m: float) -> World:
        """The same observations, with a start that is off by so much."""
        poses = [
            Pose(
                pose.rotation @ so3_exp(rng.normal(0.0, turn_rad, 3)),
                pose.translation_m + rng.normal(0, shift_m, 3),
            )
            for pose in self.poses
        ]
        return replace(self, poses=poses, points=self.points + rng.normal(0.0, point_m, self.points.shape))


def looking(heading_rad: float, roll_rad: float = 0.0) -> Array:
    """Rotation ``world_from_cam`` of a level camera that looks along a heading, then rolled about its axis."""
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    level = np.array([[sin, 0.0, cos], [-cos, 0.0, sin], [0.0, -1.0, 0.0]])
    return np.asarray(level @ so3_exp(np.array([0.0, 0.0, roll_rad])))


def drive_through_points(
    seed: int = 0,
    keyframes: int = 10,
    points: int = 240,
    step_m: float = 1.0,
    radius_m: float | None = 25.0,
    roll_rad: float = 0.0,
    noise: float = 1.0,
    outliers: float = 0.0,
) -> World:
    """A drive along an arc (or straight on), noise in sigmas, and a share of observations that are just wrong."""
    rng = np.random.default_rng(seed)
    poses, position, heading = [], np.array([0.0, 0.0, 1.6]), 0.4
    for _ in range(keyframes):
        poses.append(Pose(looking(heading, roll_rad), position))
        position = position + step_m * np.array([np.cos(heading), np.sin(heading), 0.0])
        heading += step_m / radius_m if radius_m else 0.0
    home = rng.integers(0, keyframes, points)
    in_cam = np.stack(
        [rng.uniform(-12.0, 12.0, points), rng.uniform(-6.0, 1.6, points), rng.uniform(5.0, 30.0, points)], axis=1
    )
    cloud = np.array([poses[k].transform(p) for k, p in zip(home, in_cam, strict=True)])
    seen = []
    for k, pose in enumerate(poses):
        points_in_cam = pose.inverse().transform(cloud)
        pixels = CAMERA.project_ideal(points_in_cam)
        visible = CAMERA.is_inside(pixels) & (points_in_cam[:, 2] < 45.0)
        seen += [(int(p), k, *pixels[p]) for p in np.flatnonzero(visible)]
    counts = np.bincount([s[0] for s in seen], minlength=points)
    kept = np.flatnonzero(counts >= 3)
    row = np.full(points, -1)
    row[kept] = np.arange(len(kept))
    rows = np.array(sorted(s for s in seen if row[s[0]] >= 0))
    sigmas = 1.2 ** rng.integers(0, 5, len(rows)).astype(np.float64)
    pixels = rows[:, 2:4] + noise * sigmas[:, None] * rng.normal(0.0, 1.0, (len(rows), 2))
    wrong = rng.random(len(rows)) < outliers
    pixels[wrong] += rng.uniform(-60.0, 60.0, (int(wrong.sum()), 2))
    return World(
        CAMERA,
        poses,
        cloud[kept],
        rows[:, 1].astype(np.int32),
        row[rows[:, 0].astype(int)].astype(np.int32),
        pixels,
        sigmas,
    )


@pytest.fixture(scope="session")
def make_world() -> Callable[..., World]:
    return drive_through_points


@dataclass(frozen=True)
class DriveInMemory:
    """``fleetmap.drive.Drive`` over decoded images, to be edited with ``dataclasses.replace``."""

    name: str
    camera: Camera
    images: tuple[Frame, ...]
    fixes: tuple[GnssFix, ...]
    antenna_in_cam_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def frame_count(self) -> int:
        return len(self.images)

    def frames(self) -> Iterator[Frame]:
        return iter(self.images)

    def gnss_fixes(self) -> list[GnssFix]:
        return list(self.fixes)

    def antenna(self) -> Antenna:
        return Antenna(np.array(self.antenna_in_cam_m), "static transform")

    def imu_samples(self) -> Iterator[ImuSample]:
        return iter(())

    def imu_mounting(self) -> SensorMounting | None:
        return None

    def wheel_speeds(self) -> Iterator[WheelSpeed]:
        return iter(())

    def wheel_mounting(self) -> SensorMounting | None:
        return None

    def blacked_out(self, first: int, last: int) -> DriveInMemory:
        """The same with images ``first`` to ``last`` black."""
        images = [
            replace(frame, image=np.zeros_like(frame.image)) if first <= i <= last else frame
            for i, frame in enumerate(self.images)
        ]
        return replace(self, images=tuple(images))


@pytest.fixture(scope="session")
def survey_drive(survey: Any, survey_frames: tuple[Frame, ...]) -> DriveInMemory:
    drive = open_drive(survey.recording)
    return DriveInMemory(drive.name, drive.camera, survey_frames, tuple(drive.gnss_fixes()))


@pytest.fixture(scope="session")
def mapped(survey_drive: DriveInMemory) -> MappedDrive:
    """The survey drive mapped with the settings as they come."""
    return map_drive(survey_drive, MapperSettings())
