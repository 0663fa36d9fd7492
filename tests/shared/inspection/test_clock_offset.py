"""The clocks' offset from motion: the truth is known, because it is made here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.drive import Antenna
from fleetmap.geometry import so3_exp, so3_log
from fleetmap.gnss import CONSUMER, RTK, sample_fixes
from fleetmap.inspection.clock_offset import estimate_clock_offset
from fleetmap.inspection.gnss_quality import GnssTrack
from fleetmap.inspection.visual_course import TimedMotion
from fleetmap.trajectory import Trajectory
from fleetmap.vision.frame_motion import FrameMotion

T0_NS = 1_700_000_000_000_000_000
LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # world_from_cam, looking east
ANTENNA_IN_CAM_M = (0.3, -1.0, -1.2)


def drive_of(turns_rad, *, seconds=24.0, speed=lambda t: 8.0 + 0.0 * t, pitch_rad=0.0):
    """A drive at 10 Hz: ``turns_rad`` gives the heading, ``speed`` the speed of each time.

    The camera sits 1.3 m ahead of the point that moves along the heading, as it does on a car.
    """
    fine_s = np.arange(0.0, seconds, 0.01)
    heading, v = turns_rad(fine_s), speed(fine_s)
    rear = np.cumsum(v[:, None] * 0.01 * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    camera = rear + 1.3 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    rows = np.arange(0, len(fine_s), 10)
    positions = np.column_stack([camera[rows], np.zeros(len(rows))]) + np.array([679_000.0, 5_404_000.0, 400.0])
    yaw = so3_exp(heading[rows, None] * np.array([0.0, 0.0, 1.0]))
    rotations = yaw @ LEVEL @ so3_exp(np.array([pitch_rad, 0.0, 0.0]))
    return Trajectory(32632, T0_NS + (fine_s[rows] * 1e9).astype(np.int64), positions, rotations)


def two_turns(t):
    """Straight, 80 degrees to the left, straight, 60 degrees to the right, straight."""
    return np.radians(80.0) * smooth_step((t - 5.0) / 4.0) - np.radians(60.0) * smooth_step((t - 14.0) / 4.0)


def smooth_step(x):
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def motions_of(truth, seed=0):
    """What a camera sees of a drive, with the noise that optical flow has (0.04 and 0.5 degrees a pair)."""
    rng = np.random.default_rng(seed)
    motions = []
    for index in range(len(truth) - 1):
        first, second = truth.pose(index), truth.pose(index + 1)
        rotation = so3_log(first.rotation.T @ second.rotation) + rng.normal(0.0, np.radians(0.04), 3)
        step = first.rotation.T @ (second.translation_m - first.translation_m)
        moved = float(np.linalg.norm(step))
        direction = step / max(moved, 1e-9) + rng.normal(0.0, np.radians(0.5), 3)
        direction_sigma = np.radians(0.5) if moved > 0.05 else 1.0
        motion = FrameMotion(
            rotation, direction / np.linalg.norm(direction), np.radians(0.04), direction_sigma, 200, 10.0 * moved
        )
        stamps = truth.stamps_ns[index : index + 2].tolist()
        motions.append(TimedMotion(*stamps, motion))
    return motions


def estimate(truth, offset_s, *, model=RTK, interval_s=0.2, seed=0, source="static transform", motions=None):
    fixes = sample_fixes(truth, model, interval_s=interval_s, antenna_in_cam_m=ANTENNA_IN_CAM_M, seed=seed)
    shifted = [replace(fix, stamp_ns=fix.stamp_ns - round(offset_s * 1e9)) for fix in fixes]
    antenna = Antenna(np.array(ANTENNA_IN_CAM_M), source)
    return estimate_clock_offset(motions or motions_of(truth, seed), GnssTrack.of(shifted), antenna)


@pytest.mark.parametrize("interval_s", [0.1, 1.0])
@pytest.mark.parametrize("offset_s", [-0.2, 0.0, 0.083])
def test_the_offset_of_a_drive_with_turns_is_found_to_20_ms(offset_s, interval_s):
    truth = drive_of(two_turns)
    for seed in range(2):
        found = estimate(truth, offset_s, interval_s=interval_s, seed=seed)
        assert found.offset_s == pytest.approx(offset_s, abs=0.02)
        assert 0.0 < found.sigma_s < 0.03
        assert abs(found.offset_s - offset_s) < 3.0 * found.sigma_s


def test_a_drive_that_brakes_before_its_turns_is_no_different():
    truth = drive_of(two_turns, speed=lambda t: 8.0 - 4.0 * np.exp(-(((t - 7.0) / 2.0) ** 2)))
    assert estimate(truth, 0.12).offset_s == pytest.approx(0.12, abs=0.02)


def test_a_stop_does_not_disturb():
    truth = drive_of(
        lambda t: two_turns(t - 6.0), seconds=30.0, speed=lambda t: 8.0 * smooth_step((t - 5.0) / 2.0)
    )
    assert estimate(truth, -0.1).offset_s == pytest.approx(-0.1, abs=0.02)


def test_a_camera_that_looks_down_at_the_road_is_no_different():
    truth = drive_of(two_turns, pitch_rad=-0.25)
    assert estimate(truth, 0.12).offset_s == pytest.approx(0.12, abs=0.02)


def test_a_straight_at_constant_speed_says_nothing():
    truth = drive_of(lambda t: 0.3 + 0.006 * np.sin(0.7 * t))
    found = estimate(truth, 0.1, interval_s=0.1)
    assert (found.offset_s, found.sigma_s) == (None, None)
    assert "no turn" in found.reason


def test_a_consumer_receiver_with_a_fix_a_second_is_not_trusted_with_milliseconds():
    for seed in range(3):
        found = estimate(drive_of(two_turns), 0.1, model=CONSUMER, interval_s=1.0, seed=seed)
        assert found.offset_s is None or abs(found.offset_s - 0.1) < 3.0 * found.sigma_s


def test_an_antenna_at_an_unknown_place_could_as_well_be_a_late_clock():
    found = estimate(drive_of(two_turns), 0.1, source="assumed at the camera")
    assert found.offset_s is None
    assert "antenna" in found.reason


def test_two_fixes_in_a_turn_are_too_few():
    found = estimate(drive_of(two_turns), 0.0, interval_s=20.0)
    assert found.offset_s is None
    assert "fixes" in found.reason


def test_images_that_could_not_be_followed_split_the_drive():
    """The second turn is lost, the first one is enough."""
    truth = drive_of(two_turns)
    motions = [
        replace(timed, motion=None) if 140 <= index < 180 and index % 3 == 0 else timed
        for index, timed in enumerate(motions_of(truth))
    ]
    assert estimate(truth, 0.07, motions=motions).offset_s == pytest.approx(0.07, abs=0.02)


def test_some_wild_fixes_do_not_matter():
    truth = drive_of(two_turns)
    fixes = sample_fixes(truth, RTK, interval_s=0.2, antenna_in_cam_m=ANTENNA_IN_CAM_M, seed=1)
    wild = [
        replace(fix, lat_deg=fix.lat_deg + 5e-5) if index % 17 == 3 else fix for index, fix in enumerate(fixes)
    ]
    shifted = [replace(fix, stamp_ns=fix.stamp_ns + 60_000_000) for fix in wild]
    antenna = Antenna(np.array(ANTENNA_IN_CAM_M), "static transform")
    found = estimate_clock_offset(motions_of(truth), GnssTrack.of(shifted), antenna)
    assert found.offset_s == pytest.approx(-0.06, abs=0.02)
