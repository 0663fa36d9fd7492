"""Constant velocity, and what a vehicle can and cannot do."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.geometry import Pose, rotation_angle_rad, so3_exp
from fleetmap_localizer.motion import Motion
from fleetmap_localizer.settings import TrackingSettings

STEP_NS = 100_000_000
LIMITS = TrackingSettings()


def on_a_bend(seconds: float, speed_mps: float = 12.0, turn_radps: float = 0.4) -> Pose:
    """Driving a circle: the twist is constant."""
    angle = turn_radps * seconds
    radius = speed_mps / turn_radps
    position = np.array([radius * (1.0 - np.cos(angle)), 0.0, radius * np.sin(angle)])
    return Pose(so3_exp(np.array([0.0, angle, 0.0])), position)


def motion_on_a_bend() -> Motion:
    return motion_at(on_a_bend(0.0)).follow(STEP_NS, on_a_bend(0.1), 100, "street", "a")


def motion_at(utm_from_cam: Pose) -> Motion:
    return Motion(0, utm_from_cam, 100, 32632, "street", "a")


@pytest.mark.parametrize("ahead_s", [0.05, 0.1, 0.3])
def test_a_bend_is_continued(ahead_s: float) -> None:
    predicted = motion_on_a_bend().predict(STEP_NS + round(ahead_s * 1e9))
    truth = on_a_bend(0.1 + ahead_s)
    assert np.linalg.norm(predicted.translation_m - truth.translation_m) < 1e-6
    assert rotation_angle_rad(predicted.rotation.T @ truth.rotation) < 1e-6


def test_a_vehicle_whose_speed_is_not_known_is_expected_where_it_was() -> None:
    assert motion_at(on_a_bend(0.0)).predict(STEP_NS) is not None
    assert np.array_equal(motion_at(on_a_bend(0.2)).predict(STEP_NS).rotation, on_a_bend(0.2).rotation)


def test_hard_braking_is_possible_and_a_leap_is_not() -> None:
    motion = motion_on_a_bend()
    true_m = on_a_bend(0.2).translation_m
    assert motion.can_reach(2 * STEP_NS, true_m, LIMITS)
    assert motion.can_reach(2 * STEP_NS, true_m - [0.0, 0.0, 0.3], LIMITS)  # braked
    assert not motion.can_reach(2 * STEP_NS, true_m + np.array([1.5, 0.0, 0.0]), LIMITS)  # leapt


def test_from_an_unknown_speed_only_the_fastest_car_limits() -> None:
    motion = motion_at(on_a_bend(0.0))
    assert motion.can_reach(STEP_NS, np.array([0.0, 0.0, 5.0]), LIMITS)
    assert not motion.can_reach(STEP_NS, np.array([0.0, 0.0, 20.0]), LIMITS)
