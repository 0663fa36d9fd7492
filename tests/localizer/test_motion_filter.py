"""The filter's motion models and measurements: their derivatives, and a drive that integrates to itself."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest

from fleetmap.drive import GnssFix
from fleetmap.geodesy import UtmAnchor, UtmGrid, normal_gravity_m_s2
from fleetmap.geometry import Pose, rotation_angle_rad, so3_exp, so3_log
from fleetmap.simulation.blocks import lay_circuit
from fleetmap.simulation.driving import plan_motion
from fleetmap.simulation.imu import ImuErrorModel, TriadErrorModel, imu_samples
from fleetmap.simulation.motion import Motion
from fleetmap.simulation.mounting import Mounting
from fleetmap.simulation.roads import RoadPath
from fleetmap.simulation.street import anchor_at
from fleetmap_localizer.filter_measurements import fix_measurement, pose_measurement, wheel_measurement
from fleetmap_localizer.filter_process import inertial_step, rotation_of, turning_step
from fleetmap_localizer.filter_settings import DeadReckoningSettings
from fleetmap_localizer.filter_state import (
    ACCEL_BIAS,
    GNSS_BIAS,
    GYRO_BIAS,
    GYRO_MIXING,
    POSITION,
    ROTATION,
    SIZE,
    SLIP,
    VELOCITY,
    FilterState,
)
from fleetmap_localizer.filter_update import corrected
from fleetmap_localizer.motion_filter import MotionFilter, Rig, Site

GRID = UtmGrid(32632)
EAST_OF_THE_MERIDIAN = np.array([680_000.0, 5_400_000.0, 400.0])  # convergence 1.9 deg, scale 1.00000
_STEP = 1e-4


def a_state(seed: int = 0) -> FilterState:
    rng = np.random.default_rng(seed)
    return FilterState(
        position_m=EAST_OF_THE_MERIDIAN + rng.normal(size=3),
        velocity_m_s=rng.normal(0.0, 8.0, 3),
        rotation=so3_exp(rng.normal(size=3)),
        gyro_bias_rad_s=rng.normal(0.0, 0.2, 3),
        accel_bias_m_s2=rng.normal(0.0, 0.2, 3),
        gyro_mixing=rng.normal(0.0, 0.01, (3, 3)),
        wheel_scale=0.01,
        slip_rad=rng.normal(0.0, 0.05, 2),
        axle_m=0.8,
        gnss_bias_m=rng.normal(size=3),
        covariance=np.zeros((SIZE, SIZE)),
    )


def an_arm(seed: int) -> Pose:
    rng = np.random.default_rng(seed)
    return Pose(so3_exp(rng.normal(size=3)), rng.normal(size=3))


def difference(true: FilterState, nominal: FilterState) -> np.ndarray:
    """The error state that takes the nominal state to the true one."""
    error = np.zeros(SIZE)
    error[POSITION] = true.position_m - nominal.position_m
    error[VELOCITY] = true.velocity_m_s - nominal.velocity_m_s
    error[ROTATION] = so3_log(nominal.rotation.T @ true.rotation)
    return error


def step(state: FilterState, kind: str, covariance: np.ndarray) -> FilterState:
    nothing = np.zeros(SIZE)
    if kind == "inertial":
        turn, force = np.array([0.3, -0.2, 0.5]), np.array([1.0, -2.0, 9.5])
        moved = inertial_step(
            state.position_m, state.velocity_m_s, state.rotation, state.gyro_bias_rad_s, state.accel_bias_m_s2,
            state.gyro_mixing, covariance, turn, force, 9.81, 1.001, 0.005, nothing, nothing,
        )  # fmt: skip
    else:
        moved = turning_step(
            state.position_m, state.velocity_m_s, state.rotation, state.gyro_bias_rad_s, covariance, 1.001, 0.05,
            nothing, nothing,
        )  # fmt: skip
    return state.carried(*moved)


@pytest.mark.parametrize(
    ("kind", "errors"),
    [
        ("inertial", (POSITION, VELOCITY, ROTATION, GYRO_BIAS, ACCEL_BIAS, GYRO_MIXING)),
        ("turning", (POSITION, VELOCITY, ROTATION, GYRO_BIAS)),
    ],
)
def test_the_covariance_goes_the_way_that_small_errors_go(kind: str, errors: tuple[slice, ...]) -> None:
    """A covariance of one error alone comes out as the square of what that error becomes."""
    state = replace(a_state(), position_m=np.zeros(3))
    nothing = state.covariance
    nominal = step(state, kind, nothing)
    for index in np.concatenate([np.arange(SIZE)[part] for part in errors]):
        unit = np.eye(SIZE)[index]
        moved = [
            difference(
                step(state.injected(sign * _STEP * unit, state.covariance), kind, state.covariance), nominal
            )
            for sign in (1.0, -1.0)
        ]
        becomes = (moved[0] - moved[1]) / (2.0 * _STEP)
        becomes[9:] = unit[9:]
        found = step(state, kind, np.outer(unit, unit)).covariance
        # Second order in the step's length is left out: half of 5 ms x 5 ms x 10 m/s2, of 50 ms x 0.3 rad/s.
        np.testing.assert_allclose(found, np.outer(becomes, becomes), atol=3e-4 if kind == "inertial" else 0.02)
        assert np.abs(found).max() > 0.9


def test_a_step_gains_the_variance_it_is_told_and_forgets_as_it_is_told() -> None:
    state, decays, noises = a_state(), np.zeros(SIZE), np.zeros(SIZE)
    decays[GNSS_BIAS], noises[VELOCITY] = 2.0, 5.0
    *_, covariance = turning_step(
        state.position_m, np.zeros(3), state.rotation, np.zeros(3), np.eye(SIZE), 1.0, 0.1, decays, noises
    )
    np.testing.assert_allclose(np.diag(covariance)[VELOCITY], 1.5, atol=1e-9)
    np.testing.assert_allclose(np.diag(covariance)[GNSS_BIAS], np.exp(-0.4), atol=1e-9)
    np.testing.assert_allclose(np.diag(covariance)[SLIP], 1.0, atol=1e-12)


def measurement(state: FilterState, kind: str) -> tuple[np.ndarray, np.ndarray]:
    if kind == "pose":
        found = pose_measurement(
            state, an_arm(3), 1.001, Pose(so3_exp(np.ones(3)), EAST_OF_THE_MERIDIAN), np.eye(6)
        )
    elif kind == "fix":
        fix = GnssFix(0, 48.7, 11.4, 400.0, np.eye(3))
        found = fix_measurement(state, np.array([0.3, 1.0, -2.0]), GRID, 1.001, fix)
    else:
        turn_rate = np.array([0.1, -0.2, 0.4]) - state.gyro_bias_rad_s
        speed = 5.0 if kind == "wheels" else None
        found = wheel_measurement(state, an_arm(4), turn_rate, speed, np.eye(3))
    return found.residual, found.jacobian


@pytest.mark.parametrize("kind", ["wheels", "rolling only", "fix"])
def test_what_is_expected_changes_as_its_derivative_says(kind: str) -> None:
    state = a_state(1)
    _, jacobian = measurement(state, kind)
    for index in range(SIZE):
        error = _STEP * np.eye(SIZE)[index]
        above, below = (measurement(state.injected(s * error, state.covariance), kind)[0] for s in (1.0, -1.0))
        np.testing.assert_allclose(-(above - below) / (2.0 * _STEP), jacobian[:, index], atol=2e-5)
    assert len(jacobian) == (2 if kind == "rolling only" else 3)


def test_a_pose_residual_is_the_error_that_was_put_in() -> None:
    """Round trip: the pose of a state with a small error gives that error back through the derivative."""
    state, arm = a_state(2), an_arm(3)
    rng = np.random.default_rng(6)
    settings, site = DeadReckoningSettings(), Site.around(GRID.epsg, EAST_OF_THE_MERIDIAN)
    rig = Rig(arm, Pose.identity(), np.zeros(3), has_wheels=False, is_mounting_known=True)
    error = np.zeros(SIZE)
    error[POSITION], error[ROTATION] = rng.normal(0.0, 1e-4, 3), rng.normal(0.0, 1e-4, 3)
    true, _ = MotionFilter(state.injected(error, state.covariance), site, rig, settings).camera_pose()
    found = pose_measurement(state, arm, site.grid_scale, true, np.eye(6))
    np.testing.assert_allclose(found.residual, found.jacobian @ error, atol=1e-7)
    assert np.linalg.norm(found.residual) > 1e-4


def test_a_fix_east_of_the_filter_is_told_in_the_grids_directions() -> None:
    """Ten metres true east, sure to the north only; taking UTM for east and north would be 0.3 m off."""
    lat_deg, lon_deg, height_m = (float(v) for v in GRID.to_geodetic(EAST_OF_THE_MERIDIAN))
    east_deg = 10.0 / (6_378_137.0 * np.cos(np.radians(lat_deg)))
    fix = GnssFix(0, lat_deg, lon_deg + np.degrees(east_deg), height_m, np.diag([4.0, 0.01, 1.0]))
    state = replace(a_state(), position_m=EAST_OF_THE_MERIDIAN, gnss_bias_m=np.zeros(3))
    found = fix_measurement(state, np.zeros(3), GRID, 1.0, fix)
    turn = GRID.convergence_rad(lat_deg, lon_deg)
    assert np.degrees(turn) == pytest.approx(1.83, abs=0.05)
    np.testing.assert_allclose(found.residual[:2], 10.0 * np.array([np.cos(turn), np.sin(turn)]), atol=0.03)
    assert np.arctan2(*found.residual[1::-1]) == pytest.approx(turn, abs=2e-4)
    longest = np.linalg.eigh(found.covariance)[1][:, -1]
    assert longest[1] / longest[0] == pytest.approx(np.tan(turn), abs=1e-4)


def test_a_correction_is_the_weighted_mean_and_never_less_than_nothing() -> None:
    P = np.eye(SIZE) * 4.0
    H = np.zeros((1, SIZE))
    H[0, 0] = 1.0
    error, covariance = corrected(P, H, np.array([5.0]), np.array([[1.0]]))
    assert error[0] == pytest.approx(4.0)
    assert covariance[0, 0] == pytest.approx(0.8)
    assert np.linalg.eigvalsh(covariance)[0] > 0.7
    np.testing.assert_allclose(covariance, covariance.T, atol=0)


def test_one_rotation_is_as_many_at_once() -> None:
    for vector in (np.zeros(3), np.array([1e-9, 0.0, -1e-9]), np.array([0.3, -2.0, 1.0])):
        np.testing.assert_allclose(rotation_of(vector), so3_exp(vector), atol=1e-12)


@dataclass(frozen=True)
class Road:
    anchor: UtmAnchor
    path: RoadPath
    length_m: float


def a_motion(lon_deg: float, seconds: float) -> Motion:
    path, _ = lay_circuit(np.random.default_rng(5), 600.0, 0.08)
    road = Road(anchor_at(0.5, lon_deg, 200.0), path, path.length_m)
    return plan_motion(road, speed_mps=12.0, end_m=12.0 * seconds, seed=3)


@pytest.mark.parametrize(("lon_deg", "scale"), [(9.0, 0.9996), (11.99, 1.00097)])
def test_perfect_measurements_integrate_to_the_drive_in_the_grids_metres(lon_deg: float, scale: float) -> None:
    motion, perfect = a_motion(lon_deg, 20.0), TriadErrorModel(0, 0, 0, 0, 0)
    assert motion.grid_scale == pytest.approx(scale, abs=2e-5)
    cam_from_imu = Mounting().cam_from_imu
    truth = motion.trajectory(motion.stamps_ns(10.0))
    utm_from_imu = truth.pose(0) @ cam_from_imu
    start = motion.felt_by(cam_from_imu, np.zeros(1))
    state = replace(
        a_state(),
        position_m=utm_from_imu.translation_m,
        velocity_m_s=utm_from_imu.rotation @ start.velocity_m_s[0],
        rotation=utm_from_imu.rotation,
        gyro_bias_rad_s=np.zeros(3),
        accel_bias_m_s2=np.zeros(3),
        gyro_mixing=np.zeros((3, 3)),
    )
    rig = Rig(cam_from_imu.inverse(), Pose.identity(), np.zeros(3), has_wheels=False, is_mounting_known=True)
    site = Site.around(truth.epsg, truth.positions_m[0])
    motion_filter = MotionFilter(state, site, rig, DeadReckoningSettings())
    samples = list(imu_samples(motion, cam_from_imu, ImuErrorModel(perfect, perfect)))
    until = int(truth.stamps_ns[-1])
    for first, second in itertools.pairwise(samples):
        if second.stamp_ns <= until:
            turn = 0.5 * (first.angular_velocity_rad_s + second.angular_velocity_rad_s)
            force = 0.5 * (first.linear_acceleration_m_s2 + second.linear_acceleration_m_s2)
            motion_filter.predict_inertial(turn, force, (second.stamp_ns - first.stamp_ns) * 1e-9)

    found, covariance = motion_filter.camera_pose()
    way_m = truth.positions_m[-1] - truth.positions_m[0]
    off_m = float(np.linalg.norm(found.translation_m - truth.positions_m[-1]))
    assert off_m < 0.02
    assert rotation_angle_rad(found.rotation.T @ truth.rotations[-1]) < 2e-4
    if scale > 1.0:  # the same metres on the ground, taken for the grid's, would be further off
        assert abs(1.0 - 1.0 / scale) * np.linalg.norm(way_m) > 2.0 * off_m
    assert 1.0 < np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]) < 10.0


def test_gravity_and_scale_are_those_of_the_place() -> None:
    site = Site.around(GRID.epsg, EAST_OF_THE_MERIDIAN)
    lat_deg, lon_deg, height_m = (float(v) for v in GRID.to_geodetic(EAST_OF_THE_MERIDIAN))
    assert site.gravity_m_s2 == pytest.approx(normal_gravity_m_s2(lat_deg, height_m), abs=1e-12)
    assert site.grid_scale == pytest.approx(GRID.point_scale_factor(lat_deg, lon_deg), abs=1e-12)
