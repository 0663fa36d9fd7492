"""A camera's true motion at any time: every sensor of a simulated drive is read off this one curve.

Positions run on a cubic spline and rotations on a cubic rotation spline (R. Kang and J. Park, as scipy's
``RotationSpline`` cites it), so velocity, acceleration, angular velocity and angular acceleration are exact
derivatives of the poses and continuous.

Poses are in the map frame, whose horizontal metres are those of the UTM grid. What a vehicle feels is in metres on
the ground: velocities and accelerations are divided by the point scale factor of the site (horizontally).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from fleetmap.errors import InputError
from fleetmap.geodesy import UtmAnchor, UtmGrid
from fleetmap.geometry import Pose
from fleetmap.trajectory import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Felt:
    """What a sensor bolted to the vehicle goes through at N moments, in its own frame."""

    velocity_m_s: Array  # (N, 3) over ground
    acceleration_m_s2: Array  # (N, 3) without gravity
    angular_velocity_rad_s: Array  # (N, 3)
    up: Array  # (N, 3) unit vectors


@dataclass(frozen=True)
class Motion:
    """``map_from_cam`` as a function of the seconds since the drive's start; make one with ``motion_through``."""

    anchor: UtmAnchor
    start_ns: int  # UTC at 0 s
    duration_s: float
    grid_scale: float  # grid metres per metre on the ground
    positions: CubicSpline  # of seconds: (3,) camera centre in map
    rotations: RotationSpline  # of seconds: map_from_cam
    pace: CubicSpline | None = None  # of seconds: when the vehicle would be there had it kept its speed from s = 0

    def traffic_s(self, seconds: float) -> float:
        """What a clock of the traffic shows: it slows down with the vehicle, so that nobody runs into it."""
        return seconds if self.pace is None else float(self.pace(seconds))

    def map_from_cam(self, seconds: float) -> Pose:
        """The camera's pose at one moment."""
        rotations, positions_m = self.poses(np.array([seconds]))
        return Pose(rotations[0], positions_m[0])

    def poses(self, seconds: Array) -> tuple[Array, Array]:
        """Rotations (N, 3, 3) ``map_from_cam`` and camera centres (N, 3) in map."""
        return np.asarray(self.rotations(seconds).as_matrix()), np.asarray(self.positions(seconds))

    def trajectory(self, stamps_ns: NDArray[np.int64]) -> Trajectory:
        """The truth ``utm_from_cam`` at some stamps."""
        rotations, positions_m = self.poses(self.seconds(stamps_ns))
        return Trajectory(self.anchor.epsg, stamps_ns, self.anchor.utm_from_map(positions_m), rotations)

    def seconds(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Seconds since the start of stamps (N,)."""
        return np.asarray((stamps_ns - self.start_ns) * 1e-9)

    def stamps_ns(self, rate_hz: float, first_s: float = 0.0) -> NDArray[np.int64]:
        """Evenly spaced stamps (N,) up to the drive's end, on whole microseconds, which a TUM file keeps."""
        seconds = np.arange(first_s, self.duration_s, 1.0 / rate_hz)
        return np.asarray(self.start_ns + 1000 * np.rint(seconds * 1e6).astype(np.int64))

    def felt_by(self, cam_from_sensor: Pose, seconds: Array) -> Felt:
        """What a sensor mounted at ``cam_from_sensor`` goes through at moments (N,).

        The Earth's own rotation (0.004 deg/s) and curvature are left out: both are far below the errors of the
        sensors that vehicles carry.
        """
        turn = np.asarray(self.rotations(seconds, 1))  # rates in the camera's frame
        turn_change = np.asarray(self.rotations(seconds, 2))
        cam_from_map = np.swapaxes(np.asarray(self.rotations(seconds).as_matrix()), 1, 2)
        arm_m = cam_from_sensor.translation_m
        on_ground = np.array([1.0 / self.grid_scale, 1.0 / self.grid_scale, 1.0])
        velocity = _rotated(cam_from_map, self.positions(seconds, 1) * on_ground) + np.cross(turn, arm_m)
        acceleration = _rotated(cam_from_map, self.positions(seconds, 2) * on_ground)
        acceleration += np.cross(turn_change, arm_m) + np.cross(turn, np.cross(turn, arm_m))
        in_cam = (velocity, acceleration, turn, cam_from_map[:, :, 2])
        return Felt(*(vectors @ cam_from_sensor.rotation for vectors in in_cam))


def motion_through(
    anchor: UtmAnchor,
    start_ns: int,
    seconds: Array,
    rotations: Array,
    positions_m: Array,
    duration_s: float,
    pace_s: Array | None = None,
) -> Motion:
    """The smooth motion through poses ``map_from_cam`` (N, 3, 3), (N, 3) at increasing moments (N,).

    Raises:
        InputError: fewer than two poses.
    """
    if len(seconds) < 2:
        raise InputError(f"a motion needs at least 2 poses, got {len(seconds)}")
    spline = RotationSpline(seconds, Rotation.from_matrix(rotations))
    pace = None if pace_s is None else CubicSpline(seconds, pace_s)
    scale = grid_scale_at(anchor)
    return Motion(anchor, start_ns, duration_s, scale, CubicSpline(seconds, positions_m), spline, pace)


def motion_of(anchor: UtmAnchor, trajectory: Trajectory) -> Motion:
    """The smooth motion through the poses of a trajectory, in the map frame of an anchor of the same zone."""
    start_ns = int(trajectory.stamps_ns[0]) if len(trajectory) else 0
    seconds = np.asarray((trajectory.stamps_ns - start_ns) * 1e-9)
    positions_m = anchor.map_from_utm(trajectory.positions_m)
    duration_s = float(seconds[-1]) if len(trajectory) else 0.0
    return motion_through(anchor, start_ns, seconds, trajectory.rotations, positions_m, duration_s)


def grid_scale_at(anchor: UtmAnchor) -> float:
    """Grid metres per metre on the ground (the ellipsoid) at an anchor."""
    lat_deg, lon_deg, _ = UtmGrid(anchor.epsg).to_geodetic(anchor.offset_m)
    return UtmGrid(anchor.epsg).point_scale_factor(float(lat_deg), float(lon_deg))


def _rotated(rotations: Array, vectors: Array) -> Array:
    return np.asarray(np.einsum("nij,nj->ni", rotations, vectors))
