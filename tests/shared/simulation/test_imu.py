"""An IMU feels the motion it is in, and errs as its model says."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Pose, rotation_angle_rad, so3_exp
from fleetmap.simulation.driving import plan_motion
from fleetmap.simulation.imu import IMU_ERROR_MODELS, ImuErrorModel, TriadErrorModel, gravity_m_s2, imu_samples
from fleetmap.simulation.motion import Motion, motion_through
from fleetmap.simulation.mounting import Mounting
from fleetmap.simulation.street import Street

PERFECT_IMU = ImuErrorModel(TriadErrorModel(0, 0, 0, 0, 0), TriadErrorModel(0, 0, 0, 0, 0))
_CAM_FROM_IMU = Mounting().cam_from_imu


def test_integrating_perfect_measurements_gives_the_drive_again(meridian_street: Street) -> None:
    motion, rate_hz = plan_motion(meridian_street, speed_mps=9.0, seed=4), 200.0
    samples = list(imu_samples(motion, _CAM_FROM_IMU, PERFECT_IMU, rate_hz=rate_hz))
    rotation = motion.map_from_cam(0.0).rotation @ _CAM_FROM_IMU.rotation
    start = motion.felt_by(_CAM_FROM_IMU, np.zeros(1))
    position, velocity = np.zeros(3), rotation @ start.velocity_m_s[0]
    gravity = np.array([0.0, 0.0, -gravity_m_s2(motion.anchor)])
    for first, second in itertools.pairwise(samples):
        dt = (second.stamp_ns - first.stamp_ns) * 1e-9
        middle_turn = (first.angular_velocity_rad_s + second.angular_velocity_rad_s) / 2.0
        half = rotation @ so3_exp(middle_turn * dt / 2.0)
        force = (first.linear_acceleration_m_s2 + second.linear_acceleration_m_s2) / 2.0
        acceleration = half @ force + gravity
        position = position + velocity * dt + acceleration * dt**2 / 2.0
        velocity = velocity + acceleration * dt
        rotation = rotation @ so3_exp(middle_turn * dt)

    seconds = (np.array([samples[0].stamp_ns, samples[-1].stamp_ns]) - motion.start_ns) * 1e-9
    poses = [motion.map_from_cam(float(t)) @ _CAM_FROM_IMU for t in seconds]
    ground = np.array([motion.grid_scale, motion.grid_scale, 1.0])
    cameras = [motion.map_from_cam(float(t)).translation_m for t in seconds]
    lever = [pose.translation_m - camera for pose, camera in zip(poses, cameras, strict=True)]
    true = (cameras[1] - cameras[0]) / ground + lever[1] - lever[0]
    assert np.linalg.norm(true) > 25.0
    assert np.linalg.norm(position - true) < 0.005
    assert rotation_angle_rad(rotation.T @ poses[1].rotation) < 1e-4
    in_grid_metres = cameras[1] - cameras[0] + lever[1] - lever[0]
    assert np.linalg.norm(position - in_grid_metres) > 0.007  # the grid's metres are others


def _standing(seconds: float = 200.0) -> Motion:
    anchor = UtmAnchor(32632, 678_546, 5_404_737, 420)
    looking_north = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    knots = np.array([-1.0, seconds + 1.0])
    return motion_through(anchor, 0, knots, np.stack([looking_north] * 2), np.zeros((2, 3)), seconds)


def test_at_rest_it_measures_gravity_upwards(street: Street) -> None:
    sample = next(imu_samples(_standing(), _CAM_FROM_IMU, PERFECT_IMU))
    np.testing.assert_allclose(sample.angular_velocity_rad_s, 0.0, atol=1e-12)
    np.testing.assert_allclose(sample.linear_acceleration_m_s2[:2], 0.0, atol=1e-9)
    assert sample.linear_acceleration_m_s2[2] == pytest.approx(9.8079, abs=0.0005)  # at 48.8 N, 420 m


@pytest.mark.parametrize("name", list(IMU_ERROR_MODELS))
def test_its_errors_at_rest_have_the_densities_of_the_model(name: str) -> None:
    model = IMU_ERROR_MODELS[name]
    samples = list(imu_samples(_standing(), _CAM_FROM_IMU, model, rate_hz=200.0, seed=11))
    turns = np.array([sample.angular_velocity_rad_s for sample in samples])
    forces = np.array([sample.linear_acceleration_m_s2 for sample in samples]) - [0.0, 0.0, 9.808]
    for triad, errors in ((model.gyroscope, turns), (model.accelerometer, forces)):
        white = np.diff(errors, axis=0).std(axis=0) / np.sqrt(2.0) / np.sqrt(200.0)
        np.testing.assert_allclose(white, triad.noise_density, rtol=0.05)
        assert np.abs(errors[:200].mean(axis=0)).max() < 4.0 * (triad.bias_sigma + 9.81 * triad.scale_sigma)
        assert np.abs(errors[:200].mean(axis=0)).max() > 0.1 * triad.bias_sigma


def test_its_bias_walks_as_the_model_says() -> None:
    """Means over 1 s, 9 s apart: their differences grow with the root of the time."""
    triad = TriadErrorModel(1e-6, 3.0e-3, 0.0, 0.0, 0.0)
    model = replace(PERFECT_IMU, gyroscope=triad)
    samples = imu_samples(_standing(4000.0), _CAM_FROM_IMU, model, rate_hz=20.0, seed=2)
    means = np.array([sample.angular_velocity_rad_s for sample in samples]).reshape(-1, 20, 3).mean(axis=1)
    steps = means[9::10] - means[:-9:10]
    expected = 3.0e-3 * np.sqrt(9.0 - 1.0 / 3.0)
    assert 0.88 * expected < steps.std() < 1.12 * expected


def test_scale_and_misalignment_mix_the_axes_by_little() -> None:
    triad = TriadErrorModel(0.0, 0.0, 0.0, 0.01, 0.005)
    true = np.eye(3) * 10.0
    mixing = np.stack([triad.measured(true, 100.0, np.random.default_rng(seed)) for seed in range(300)]) / 10.0
    scales = np.diagonal(mixing, axis1=1, axis2=2) - 1.0
    skews = mixing[:, ~np.eye(3, dtype=bool)]
    assert 0.009 < scales.std() < 0.011
    assert 0.0045 < skews.std() < 0.0055


def test_the_same_seed_gives_the_same_errors_and_another_seed_others(street: Street) -> None:
    motion, model = plan_motion(street, end_m=4.0), IMU_ERROR_MODELS["consumer"]
    first, again, other = (
        np.array([s.linear_acceleration_m_s2 for s in imu_samples(motion, _CAM_FROM_IMU, model, seed=seed)])
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3


def test_a_tilted_mounting_turns_what_it_feels() -> None:
    tilted = Pose(_CAM_FROM_IMU.rotation @ so3_exp(np.array([0.0, np.radians(-30.0), 0.0])), np.zeros(3))
    sample = next(imu_samples(_standing(), tilted, PERFECT_IMU))
    np.testing.assert_allclose(
        sample.linear_acceleration_m_s2, 9.8079 * np.array([0.5, 0.0, np.sqrt(0.75)]), atol=0.001
    )
