"""Wheels report the speed over ground of the rear axle, with a scale error, noise and steps."""

from __future__ import annotations

import numpy as np

from fleetmap.simulation.driving import plan_motion
from fleetmap.simulation.mounting import Mounting
from fleetmap.simulation.street import Street
from fleetmap.simulation.wheel import WheelErrorModel, wheel_speeds

PERFECT_WHEELS = WheelErrorModel(0.0, 0.0, 0.0)
_CAM_FROM_VEHICLE = Mounting().cam_from_vehicle


def test_perfect_wheels_add_up_to_the_way_that_the_rear_axle_went(meridian_street: Street) -> None:
    motion = plan_motion(meridian_street, speed_mps=9.0, seed=4)
    speeds = list(wheel_speeds(motion, _CAM_FROM_VEHICLE, PERFECT_WHEELS))
    assert speeds[1].stamp_ns - speeds[0].stamp_ns == 20_000_000
    rotations, cameras = motion.poses(motion.seconds(np.array([speed.stamp_ns for speed in speeds])))
    axle = cameras / [motion.grid_scale, motion.grid_scale, 1.0] + rotations @ _CAM_FROM_VEHICLE.translation_m
    way_m = np.linalg.norm(np.diff(axle, axis=0), axis=1).sum()
    measured = np.array([speed.speed_mps for speed in speeds])
    assert way_m > 30.0
    assert abs(np.trapezoid(measured, dx=0.02) - way_m) < 0.02  # the axle sways sideways as well


def test_wheels_err_by_a_constant_share_and_noise(street: Street) -> None:
    motion, model = plan_motion(street, speed_mps=9.0, seed=4), WheelErrorModel()
    true = np.array([s.speed_mps for s in wheel_speeds(motion, _CAM_FROM_VEHICLE, PERFECT_WHEELS)])
    ratios = []
    for seed in range(60):
        measured = np.array([s.speed_mps for s in wheel_speeds(motion, _CAM_FROM_VEHICLE, model, seed=seed)])
        ratios.append((measured / true).mean())
        assert 0.015 < (measured - true * ratios[-1]).std() < 0.025
        np.testing.assert_allclose(measured / model.step_mps, np.rint(measured / model.step_mps), atol=1e-6)
    assert 0.0035 < np.std(ratios) < 0.0065
    assert abs(np.mean(ratios) - 1.0) < 0.002
