"""One smooth curve: what it says of speed and turning is what its poses do."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.errors import InputError
from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import Pose, rotation_angle_rad, so3_log
from fleetmap.simulation.driving import drive_along, plan_motion
from fleetmap.simulation.motion import Motion, motion_of
from fleetmap.simulation.mounting import Mounting
from fleetmap.simulation.street import Street


@pytest.fixture(scope="module")
def motion(meridian_street: Street) -> Motion:
    return plan_motion(meridian_street, speed_mps=9.0, seed=4)


def test_velocity_and_acceleration_are_those_of_the_poses_in_metres_on_the_ground(motion: Motion) -> None:
    seconds, dt = np.arange(0.1, motion.duration_s - 0.1, 0.0171), 1e-4
    rotations, positions = motion.poses(seconds)
    _, before = motion.poses(seconds - dt)
    _, after = motion.poses(seconds + dt)
    lat_deg, lon_deg, _ = UtmGrid(motion.anchor.epsg).to_geodetic(motion.anchor.utm_from_map(positions[0]))
    scale = UtmGrid(motion.anchor.epsg).point_scale_factor(float(lat_deg), float(lon_deg))
    assert scale == pytest.approx(0.9996, abs=1e-6)
    on_ground = np.array([1.0 / scale, 1.0 / scale, 1.0])
    felt = motion.felt_by(Pose.identity(), seconds)
    velocity = np.einsum("nji,nj->ni", rotations, (after - before) / (2.0 * dt) * on_ground)
    acceleration = np.einsum("nji,nj->ni", rotations, (after - 2.0 * positions + before) / dt**2 * on_ground)
    np.testing.assert_allclose(felt.velocity_m_s, velocity, atol=1e-5)
    np.testing.assert_allclose(felt.acceleration_m_s2, acceleration, atol=1e-2)
    np.testing.assert_allclose(felt.up, rotations[:, 2, :], atol=1e-12)


def test_angular_velocity_is_that_of_the_poses(motion: Motion) -> None:
    seconds, dt = np.arange(0.1, motion.duration_s - 0.1, 0.0171), 1e-4
    (before, _), (after, _) = motion.poses(seconds - dt), motion.poses(seconds + dt)
    turns = so3_log(np.swapaxes(before, 1, 2) @ after) / (2.0 * dt)
    felt = motion.felt_by(Pose.identity(), seconds).angular_velocity_rad_s
    np.testing.assert_allclose(felt, turns, atol=1e-6)
    assert np.abs(felt).max() > 0.05


def test_a_sensor_away_from_the_camera_feels_the_lever_arm(motion: Motion) -> None:
    mounting, seconds, dt = Mounting(), np.arange(0.1, motion.duration_s - 0.1, 0.0171), 1e-4

    def place(at: np.ndarray) -> np.ndarray:
        rotations, positions = motion.poses(at)
        scale = np.array([motion.grid_scale, motion.grid_scale, 1.0])
        return positions / scale + rotations @ mounting.cam_from_lidar.translation_m

    now, before, after = place(seconds), place(seconds - dt), place(seconds + dt)
    axes = motion.poses(seconds)[0] @ mounting.cam_from_lidar.rotation
    felt = motion.felt_by(mounting.cam_from_lidar, seconds)
    velocity = np.einsum("nji,nj->ni", axes, (after - before) / (2.0 * dt))
    acceleration = np.einsum("nji,nj->ni", axes, (after - 2.0 * now + before) / dt**2)
    np.testing.assert_allclose(felt.velocity_m_s, velocity, atol=1e-4)
    np.testing.assert_allclose(felt.acceleration_m_s2, acceleration, atol=2e-2)


def test_it_never_jerks_from_one_moment_to_the_next(motion: Motion) -> None:
    seconds = np.arange(0.0, motion.duration_s, 1e-3)
    felt = motion.felt_by(Pose.identity(), seconds)
    assert np.abs(np.diff(felt.acceleration_m_s2, axis=0)).max() < 0.2
    assert np.abs(np.diff(felt.angular_velocity_rad_s, axis=0)).max() < 0.01


def test_a_trajectory_becomes_a_motion_through_its_poses(street: Street) -> None:
    trajectory = drive_along(street, seed=4, rate_hz=20.0)
    through = motion_of(street.anchor, trajectory).trajectory(trajectory.stamps_ns)
    np.testing.assert_allclose(through.positions_m, trajectory.positions_m, atol=1e-6)
    assert rotation_angle_rad(np.swapaxes(through.rotations, 1, 2) @ trajectory.rotations).max() < 1e-9


def test_a_trajectory_of_one_pose_is_no_motion(street: Street) -> None:
    single = drive_along(street, end_m=0.5, rate_hz=1.0)
    assert len(single) == 1
    with pytest.raises(InputError, match="at least 2 poses"):
        motion_of(street.anchor, single)
