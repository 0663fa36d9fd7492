"""A simulated car drives as it was told, and its camera looks ahead."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.drive import START_NS
from fleetmap.errors import InputError
from fleetmap.geometry import Pose, rotation_angle_rad
from fleetmap.simulation.driving import drive_along, plan_motion
from fleetmap.simulation.street import Street
from fleetmap.simulation.world import build_world


def test_it_keeps_speed_rate_and_height(street: Street) -> None:
    drive = drive_along(street, speed_mps=8.0, rate_hz=10.0, camera_height_m=1.65)
    assert len(drive) == pytest.approx(street.length_m / 0.8, abs=1)
    assert drive.stamps_ns[0] == START_NS
    np.testing.assert_array_equal(np.diff(drive.stamps_ns), 100_000_000)
    speeds_mps = np.linalg.norm(np.diff(drive.positions_m, axis=0), axis=1) / 0.1
    assert 7.7 < speeds_mps.min() < 8.0 < speeds_mps.max() < 8.3
    s = np.linspace(0.0, street.length_m, len(drive))
    heights_m = drive.positions_m[:, 2] - street.anchor.height_m - street.path.at(s)[:, 2]
    assert 1.55 < heights_m.min() < heights_m.max() < 1.75


def test_it_moves_smoothly(street: Street) -> None:
    drive = drive_along(street, rate_hz=50.0)
    acceleration_mps2 = np.diff(drive.positions_m, 2, axis=0) * 50.0**2
    assert np.linalg.norm(acceleration_mps2, axis=1).max() < 5.0
    turns = np.linalg.inv(drive.rotations[:-1]) @ drive.rotations[1:]
    assert np.degrees(rotation_angle_rad(turns)).max() * 50.0 < 35.0


def test_the_camera_looks_along_the_road_with_y_down(street: Street) -> None:
    drive = drive_along(street)
    np.testing.assert_allclose(np.linalg.det(drive.rotations), 1.0, atol=1e-9)
    course = np.diff(drive.positions_m, axis=0)
    course /= np.linalg.norm(course, axis=1, keepdims=True)
    forward, down = drive.rotations[:-1, :, 2], drive.rotations[:-1, :, 1]
    assert np.degrees(np.arccos(np.clip((forward * course).sum(axis=1), -1.0, 1.0))).max() < 4.0
    assert down[:, 2].max() < -0.99


def test_the_other_lane_is_to_the_left(street: Street) -> None:
    first = drive_along(street, end_m=8.0)
    second = drive_along(street, lane_offset_m=3.5, end_m=8.0, seed=1)
    offset = first.rotations[0].T @ (second.positions_m[0] - first.positions_m[0])
    assert offset[0] == pytest.approx(-3.5, abs=0.3)
    assert abs(offset[2]) < 0.3


def test_the_same_seed_gives_the_same_drive_and_another_seed_another(street: Street) -> None:
    first, again, other = (drive_along(street, seed=seed) for seed in (1, 1, 2))
    assert first.positions_m.tobytes() == again.positions_m.tobytes()
    assert first.rotations.tobytes() == again.rotations.tobytes()
    assert first.rotations.tobytes() != other.rotations.tobytes()


def test_the_street_bends_and_climbs(street: Street) -> None:
    drive = drive_along(street)
    forward = drive.rotations[:, :, 2]
    headings_rad = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    assert np.degrees(np.ptp(headings_rad)) > 20.0
    assert 0.05 < np.ptp(street.path.positions_m[:, 2]) < 5.0


def test_it_slows_down_where_a_bend_would_be_uncomfortable(street: Street) -> None:
    motion = plan_motion(street, speed_mps=14.0)
    felt = motion.felt_by(Pose.identity(), np.arange(0.0, motion.duration_s, 0.01))
    speeds_mps = np.linalg.norm(felt.velocity_m_s, axis=1)
    sideways, ahead = felt.acceleration_m_s2[:, 0], felt.acceleration_m_s2[:, 2]
    assert 7.5 < speeds_mps.min() < 9.0  # sqrt(2.5 m/s2 * 27 m) = 8.2 m/s
    assert speeds_mps.max() > speeds_mps.min() + 0.5
    assert 2.0 < np.abs(sideways).max() < 3.3
    assert -2.5 < ahead.min() < ahead.max() < 2.0
    even = plan_motion(street, speed_mps=14.0, slow_in_bends=False)
    assert even.duration_s < 0.9 * motion.duration_s


def test_the_traffic_around_it_slows_down_with_it(street: Street) -> None:
    motion = plan_motion(street, speed_mps=14.0, lane_offset_m=3.5, start_m=5.0)
    assert motion.traffic_s(0.0) == pytest.approx(5.0 / 14.0, rel=0.1)
    after_s = motion.traffic_s(motion.duration_s) - motion.traffic_s(0.0)
    _, positions = motion.poses(np.arange(0.0, motion.duration_s, 0.01))
    way_m = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
    assert after_s == pytest.approx(way_m / 14.0, rel=0.01)
    assert after_s < 0.9 * motion.duration_s


def test_laps_of_a_circuit_follow_one_another_without_a_seam() -> None:
    world = build_world(3, kind="city", length_m=200.0)
    motion = plan_motion(world, speed_mps=8.0, start_m=150.0, end_m=500.0)
    seconds = np.arange(0.0, motion.duration_s, 0.02)
    felt = motion.felt_by(Pose.identity(), seconds)
    assert np.linalg.norm(felt.acceleration_m_s2, axis=1).max() < 5.0
    assert np.degrees(np.linalg.norm(felt.angular_velocity_rad_s, axis=1)).max() < 60.0
    _, positions = motion.poses(seconds)
    lap = np.linalg.norm(positions - world.path.at(150.0, 0.0, 1.65), axis=1)
    assert lap[0] < 0.3
    later = seconds > 10.0
    assert lap[later].min() < 0.3


@pytest.mark.parametrize("nonsense", [{"speed_mps": 0.0}, {"rate_hz": -1.0}, {"start_m": 30.0, "end_m": 20.0}])
def test_a_drive_that_makes_no_sense_is_refused(street: Street, nonsense: dict[str, float]) -> None:
    with pytest.raises(InputError, match=r"cannot drive from|makes? no sense"):
        drive_along(street, **nonsense)
