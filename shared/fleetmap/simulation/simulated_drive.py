"""A simulated drive: everything a vehicle's sensors would have recorded, made when it is asked for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.drive import Antenna, Frame, GnssFix, ImuSample, SensorMounting, WheelSpeed
from fleetmap.errors import InputError
from fleetmap.geometry import Pose
from fleetmap.simulation.depth_camera import DepthErrorModel
from fleetmap.simulation.imu import ImuErrorModel, imu_samples
from fleetmap.simulation.lidar import LidarModel
from fleetmap.simulation.look import Look
from fleetmap.simulation.motion import Motion, motion_of
from fleetmap.simulation.mounting import Mounting
from fleetmap.simulation.receiver import Receiver
from fleetmap.simulation.rendering import render, render_depth, render_rolling_shutter
from fleetmap.simulation.street import Street
from fleetmap.simulation.wheel import WheelErrorModel, wheel_speeds
from fleetmap.simulation.world import Scene, World
from fleetmap.trajectory import Trajectory

Array = NDArray[np.float64]
FloatImage = NDArray[np.float32]

LONGEST_READOUT_S = 0.1


@dataclass(frozen=True)
class Sensors:
    """What a vehicle carries beside camera and receiver; None is not on board."""

    imu: ImuErrorModel | None = None
    wheels: WheelErrorModel | None = None
    depth: DepthErrorModel | None = None
    lidar: LidarModel | None = None


@dataclass(frozen=True)
class SimulatedDrive:
    """A drive through a world, as ``fleetmap.drive.Drive``; what it holds is made when it is asked for."""

    world: World
    camera: Camera
    motion: Motion  # the truth at any time
    trajectory: Trajectory  # the truth, one pose per image
    look: Look = field(default_factory=Look)
    fixes: tuple[GnssFix, ...] = ()
    mounting: Mounting = field(default_factory=Mounting)
    sensors: Sensors = field(default_factory=Sensors)
    readout_s: float = 0.0  # of a rolling shutter: from the first to the last row
    seed: int = 0
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
        """One image; with a rolling shutter its stamp is that of the middle row."""
        stamp_ns, seconds = self._moment(index)
        scene = self.scene_at(seconds)
        if self.readout_s > 0.0:
            first, last = (self.motion.map_from_cam(seconds + t * self.readout_s) for t in (-0.5, 0.5))
            image = render_rolling_shutter(scene, self.camera, first, last, self.look)
        else:
            image = render(scene, self.camera, self.map_from_cam(index), self.look)
        return Frame(stamp_ns, image)

    def depth(self, index: int) -> FloatImage:
        """The depth image (H, W) in metres that comes with one image; NaN where the camera sees none.

        Raises:
            InputError: the vehicle has no depth camera.
        """
        if self.sensors.depth is None:
            raise InputError("this simulated drive has no depth camera")
        stamp_ns, seconds = self._moment(index)
        depth_m = render_depth(self.scene_at(seconds), self.camera, self.map_from_cam(index))
        return self.sensors.depth.measured(depth_m / np.float32(self.motion.grid_scale), stamp_ns, self.seed)

    def scan(self, stamp_ns: int) -> Array:
        """The lidar's ranges in metres when a scan begins at ``stamp_ns``; infinite without return.

        Raises:
            InputError: the vehicle has no lidar.
        """
        if self.sensors.lidar is None:
            raise InputError("this simulated drive has no lidar")
        lidar, seconds = self.sensors.lidar, (stamp_ns - self.motion.start_ns) * 1e-9
        scene = self.scene_at(seconds)
        ranges_m = lidar.true_ranges_m(scene, self.motion, self.mounting.cam_from_lidar, seconds)
        return lidar.measured(ranges_m, stamp_ns, self.seed)

    def scan_stamps_ns(self) -> list[int]:
        """When the lidar's scans begin; never without one."""
        lidar = self.sensors.lidar
        return [] if lidar is None else self.motion.stamps_ns(lidar.rate_hz).tolist()

    def scene_at(self, seconds: float) -> Scene:
        """The world around the vehicle at a moment of the drive."""
        return self.world.scene_at(self.motion.traffic_s(seconds))

    def map_from_cam(self, index: int) -> Pose:
        """The true pose of one image in the world's map frame."""
        utm_from_cam = self.trajectory.pose(index)
        return Pose(utm_from_cam.rotation, self.world.anchor.map_from_utm(utm_from_cam.translation_m))

    def gnss_fixes(self) -> list[GnssFix]:
        """All fixes in time order."""
        return list(self.fixes)

    def antenna(self) -> Antenna:
        """Where the antenna sits in the camera's frame."""
        offset = self.mounting.cam_from_antenna.translation_m
        return Antenna(offset, "static transform" if offset.any() else "same frame")

    def imu_samples(self) -> Iterator[ImuSample]:
        """Inertial measurements in time order; none without an IMU on board."""
        if self.sensors.imu is None:
            return iter(())
        return imu_samples(self.motion, self.mounting.cam_from_imu, self.sensors.imu, seed=self.seed)

    def imu_mounting(self) -> SensorMounting | None:
        """How the IMU is mounted; None without one on board."""
        if self.sensors.imu is None:
            return None
        return SensorMounting(self.mounting.cam_from_imu, "static transform")

    def wheel_speeds(self) -> Iterator[WheelSpeed]:
        """Forward speeds in time order; none where the wheels are not read."""
        if self.sensors.wheels is None:
            return iter(())
        return wheel_speeds(self.motion, self.mounting.cam_from_vehicle, self.sensors.wheels, seed=self.seed)

    def wheel_mounting(self) -> SensorMounting | None:
        """The frame of the speeds, under the rear axle; None where the wheels are not read."""
        if self.sensors.wheels is None:
            return None
        return SensorMounting(self.mounting.cam_from_vehicle, "static transform")

    def _moment(self, index: int) -> tuple[int, float]:
        stamp_ns = int(self.trajectory.stamps_ns[index])
        return stamp_ns, (stamp_ns - self.motion.start_ns) * 1e-9


def require_readout(readout_s: float) -> None:
    """Raise InputError for a rolling shutter that no camera has."""
    if not 0.0 <= readout_s <= LONGEST_READOUT_S:
        raise InputError(f"a shutter of {readout_s:g} s makes no sense; give 0 to {LONGEST_READOUT_S:g} s")


def simulate_drive(
    world: World | Street,
    *,
    camera: Camera,
    trajectory: Trajectory,
    motion: Motion | None = None,
    look: Look | None = None,
    gnss: str | None = "rtk",
    gnss_interval_s: float = 0.1,
    gnss_gap_s: tuple[float, float] | None = None,
    gnss_clock_offset_s: float = 0.0,
    gnss_outlier_ratio: float = 0.0,
    antenna_in_cam_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    camera_height_m: float = 1.65,
    sensors: Sensors | None = None,
    readout_s: float = 0.0,
    seed: int = 0,
    name: str = "simulated drive",
) -> SimulatedDrive:
    """A drive with the fixes that a receiver of the given error model would have reported.

    Args:
        world: where.
        camera: with what.
        trajectory: the camera's true poses ``utm_from_cam``, one per image, such as ``drive_along`` gives.
        motion: the truth between them, such as ``plan_motion`` gives; by default a smooth one through them.
        look: what lens and sensor make of the light.
        gnss: "rtk", "consumer" (see fleetmap.gnss) or None for no fixes.
        gnss_interval_s: seconds between fixes.
        gnss_gap_s: start (seconds since the first image) and length of a stretch without fixes.
        gnss_clock_offset_s: how late the stamps of the fixes are.
        gnss_outlier_ratio: the share of the fixes that are 5 to 50 m off and do not know it.
        antenna_in_cam_m: the antenna in the camera's frame.
        camera_height_m: above the road; other sensors hang on it.
        sensors: what else is on board.
        readout_s: a rolling shutter's time from the first row to the last; 0 is a global shutter.
        seed: of the sensors' errors.
        name: what messages and provenance call the drive.

    Raises:
        InputError: an unknown error model, or an interval, gap, offset, share or readout that makes no sense.
    """
    require_readout(readout_s)
    if isinstance(world, Street):
        world = World.of_street(world)
    motion = motion_of(world.anchor, trajectory) if motion is None else motion
    mounting = Mounting(camera_height_m, antenna_in_cam_m)
    fixes: list[GnssFix] = []
    if gnss is not None:
        receiver = Receiver(gnss, gnss_interval_s, gnss_gap_s, gnss_clock_offset_s, gnss_outlier_ratio)
        fixes = receiver.fixes(world, motion, trajectory.stamps_ns, mounting.cam_from_antenna, seed)
    return SimulatedDrive(
        world,
        camera,
        motion,
        trajectory,
        look or Look(),
        tuple(fixes),
        mounting,
        sensors or Sensors(),
        readout_s,
        seed,
        name,
    )
