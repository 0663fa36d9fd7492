"""Sensors carry measured poses over gaps, as surely as they say, and never further than they can."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from fleetmap.drive import Antenna, GnssFix, ImuSample, SensorMounting, WheelSpeed
from fleetmap.errors import InputError
from fleetmap.evaluation.consistency import normalised_estimation_error_squared
from fleetmap.geodesy import UtmAnchor, UtmGrid
from fleetmap.geometry import CAM_FROM_BODY, Pose, so3_exp, so3_log
from fleetmap.gnss import CONSUMER, GnssErrorModel, fixes_at
from fleetmap.simulation.blocks import lay_circuit
from fleetmap.simulation.driving import plan_motion
from fleetmap.simulation.imu import IMU_ERROR_MODELS, imu_samples
from fleetmap.simulation.motion import Motion
from fleetmap.simulation.mounting import Mounting
from fleetmap.simulation.roads import RoadPath
from fleetmap.simulation.street import anchor_at
from fleetmap.simulation.wheel import WheelErrorModel, wheel_speeds
from fleetmap.trajectory import Trajectory
from fleetmap_localizer.dead_reckoning import DeadReckoning
from fleetmap_localizer.filter_settings import DeadReckoningSettings
from fleetmap_localizer.pose_estimate import PoseEstimate

RATE_HZ, IMU_HZ = 10.0, 100.0
SIGMAS = np.array([*(np.radians(0.05),) * 3, *(0.03,) * 3])
MOUNTING = Mounting(antenna_in_cam_m=(0.3, -0.4, -1.2))
STATIC = "static transform"


@dataclass(frozen=True)
class Road:
    anchor: UtmAnchor
    path: RoadPath
    length_m: float


@dataclass(frozen=True)
class SensedDrive:
    """A drive around blocks without images; what is on board is simulated as ``fleetmap simulate`` does."""

    motion: Motion
    seed: int = 0
    imu: str | None = "consumer"
    has_wheels: bool = True
    gnss: GnssErrorModel | None = None
    outlier_ratio: float = 0.0
    imu_pause_s: tuple[float, float] = (-1.0, -1.0)
    wheel_mounting_source: str = STATIC

    @property
    def truth(self) -> Trajectory:
        return self.motion.trajectory(self.motion.stamps_ns(RATE_HZ))

    def imu_samples(self) -> Iterator[ImuSample]:
        if self.imu is None:
            return
        model = IMU_ERROR_MODELS[self.imu]
        for sample in imu_samples(self.motion, MOUNTING.cam_from_imu, model, rate_hz=IMU_HZ, seed=self.seed):
            since_s = (sample.stamp_ns - self.motion.start_ns) * 1e-9
            if not self.imu_pause_s[0] < since_s < self.imu_pause_s[1]:
                yield sample

    def imu_mounting(self) -> SensorMounting | None:
        return SensorMounting(MOUNTING.cam_from_imu, STATIC) if self.imu else None

    def wheel_speeds(self) -> Iterator[WheelSpeed]:
        if not self.has_wheels:
            return iter(())
        return wheel_speeds(self.motion, MOUNTING.cam_from_vehicle, WheelErrorModel(), seed=self.seed)

    def wheel_mounting(self) -> SensorMounting | None:
        if not self.has_wheels:
            return None
        if self.wheel_mounting_source != STATIC:
            return SensorMounting(Pose(CAM_FROM_BODY, np.zeros(3)), self.wheel_mounting_source)
        return SensorMounting(MOUNTING.cam_from_vehicle, STATIC)

    def gnss_fixes(self) -> list[GnssFix]:
        assert self.gnss is not None, "GNSS is read only where it may be used"
        truth = self.motion.trajectory(self.motion.stamps_ns(5.0, 0.037))
        antennas_m = truth.positions_m + truth.rotations @ MOUNTING.cam_from_antenna.translation_m
        return fixes_at(UtmGrid(truth.epsg), truth.stamps_ns, antennas_m, self.gnss, self.seed, self.outlier_ratio)

    def antenna(self) -> Antenna:
        return Antenna(MOUNTING.cam_from_antenna.translation_m, STATIC)


def a_motion(seed: int, seconds: float, speed_mps: float = 9.0, lon_deg: float = 11.43) -> Motion:
    path, _ = lay_circuit(np.random.default_rng(seed), 600.0, 0.08)
    road = Road(anchor_at(48.77, lon_deg, 420.0), path, path.length_m)
    return plan_motion(road, speed_mps=speed_mps, end_m=speed_mps * seconds, seed=seed)


@pytest.fixture(scope="module")
def motion() -> Motion:
    return a_motion(3, 22.0)


def measured_poses(truth: Trajectory, seed: int) -> list[PoseEstimate]:
    """Poses whose errors are half their own, half the map's, which changes over 50 images."""
    rng = np.random.default_rng([seed, 77])
    shared, poses = rng.normal(size=6), []
    for index in range(len(truth)):
        kept = np.exp(-1.0 / 50.0)
        shared = kept * shared + np.sqrt(1.0 - kept**2) * rng.normal(size=6)
        xi = SIGMAS * (shared + rng.normal(size=6)) * np.sqrt(0.5)
        poses.append(estimate(truth, index, truth.pose(index) @ Pose(so3_exp(xi[:3]), xi[3:]).inverse()))
    return poses


def estimate(truth: Trajectory, index: int, utm_from_cam: Pose) -> PoseEstimate:
    stamp_ns = int(truth.stamps_ns[index])
    return PoseEstimate(stamp_ns, truth.epsg, utm_from_cam, np.diag(SIGMAS**2), "street", "v1", 60)


def error_of(pose: PoseEstimate, truth: Trajectory, index: int) -> np.ndarray:
    """The tangent (6,) from a pose to the truth."""
    between = pose.utm_from_cam.inverse() @ truth.pose(index)
    return np.concatenate([so3_log(between.rotation), between.translation_m])


@dataclass(frozen=True)
class Gap:
    """What was predicted in a gap: per image the error (6,) and the covariance (6, 6), or None."""

    predicted: list[tuple[np.ndarray, np.ndarray] | None]

    @property
    def nees(self) -> np.ndarray:
        told = [entry for entry in self.predicted if entry is not None]
        return normalised_estimation_error_squared(
            np.array([error for error, _ in told]), np.array([covariance for _, covariance in told])
        )

    @property
    def end_error_m(self) -> float:
        return float(np.linalg.norm(self.end[0][3:]))

    @property
    def end_sigma_m(self) -> float:
        return float(np.sqrt(np.linalg.eigvalsh(self.end[1][3:, 3:])[-1]))

    @property
    def end(self) -> tuple[np.ndarray, np.ndarray]:
        last = self.predicted[-1]
        assert last is not None
        return last


def drive_over(
    drive: SensedDrive,
    gap_s: tuple[float, float],
    *,
    use_gnss: bool = False,
    change: Callable[[int, PoseEstimate], PoseEstimate] = lambda index, pose: pose,
    settings: DeadReckoningSettings | None = None,
) -> Gap:
    """Let a filter see the poses outside a gap, and ask for those inside."""
    reckoning = DeadReckoning.for_drive(drive, use_gnss=use_gnss, settings=settings)  # type: ignore[arg-type]
    assert reckoning is not None
    truth, predicted = drive.truth, []
    for index, pose in enumerate(measured_poses(truth, drive.seed)[: round(gap_s[1] * RATE_HZ)]):
        if index / RATE_HZ >= gap_s[0]:
            found = reckoning.pose_at(pose.stamp_ns)
            if found is not None:
                assert found.kind == "predicted"
                assert found.inlier_count == 0
            predicted.append(None if found is None else (error_of(found, truth, index), found.covariance))
        else:
            seen = change(index, pose)
            assert reckoning.measured(seen) is seen
    return Gap(predicted)


def test_predictions_are_as_far_off_as_they_say() -> None:
    """Gaps of 8 s after 12 s, bends and straights, six drives with their own IMU and wheel errors."""
    gaps = [
        drive_over(SensedDrive(a_motion(seed, 20.2, 6.0 + 1.5 * seed), seed), (12.0, 20.0)) for seed in range(6)
    ]
    nees = np.stack([gap.nees for gap in gaps])
    assert nees.shape == (6, 80)
    assert 2.5 < nees.mean() < 9.0
    assert 2.0 < nees[:, :20].mean() < 12.0
    assert 1.0 < nees[:, -20:].mean() < 12.0
    assert 0.03 < np.median([gap.end_error_m for gap in gaps]) < 0.7
    for gap in gaps:
        sigmas = [
            np.sqrt(covariance[3:, 3:].trace()) for entry in gap.predicted if entry for covariance in entry[1:]
        ]
        assert np.all(np.diff(sigmas) > 0.0)
        assert 0.1 < gap.end_sigma_m < 1.5


@pytest.mark.parametrize(("imu", "wheels", "reach_s"), [("consumer", False, 8.0), (None, True, 1.5)])
def test_each_sensor_alone_carries_as_far_as_it_can(
    motion: Motion, imu: str | None, wheels: bool, reach_s: float
) -> None:
    gap = drive_over(SensedDrive(motion, imu=imu, has_wheels=wheels), (12.0, 12.0 + reach_s))
    assert None not in gap.predicted
    assert 0.3 < gap.nees.mean() < 14.0
    assert gap.end_error_m < 3.5 * gap.end_sigma_m


def test_wheels_alone_end_where_the_heading_is_lost_and_say_nothing_more(motion: Motion) -> None:
    gap = drive_over(SensedDrive(motion, imu=None), (12.0, 20.0))
    told = [entry is not None for entry in gap.predicted]
    assert told[0]
    assert not told[-1]
    assert told == sorted(told, reverse=True)  # once silent, silent
    assert 10 < sum(told) < 60


def test_beyond_the_limit_of_its_sigma_nothing_is_told(motion: Motion) -> None:
    settings = replace(DeadReckoningSettings(), max_position_sigma_m=0.2)
    gap = drive_over(SensedDrive(motion, has_wheels=False), (12.0, 20.0), settings=settings)
    told = [entry[1] for entry in gap.predicted if entry is not None]
    assert 15 < len(told) < 75
    assert all(np.linalg.eigvalsh(covariance[3:, 3:])[-1] <= 0.2**2 for covariance in told)
    assert gap.predicted[-1] is None


def test_fixes_keep_the_pose_from_drifting_off_though_they_are_coarse() -> None:
    """Without IMU and wheels; the receiver is a metre and a half off, which was learned before the gap."""
    motion = a_motion(8, 40.0)
    gap = drive_over(SensedDrive(motion, imu=None, has_wheels=False, gnss=CONSUMER), (20.0, 39.0), use_gnss=True)
    told = [entry for entry in gap.predicted if entry is not None]
    assert len(told) > 20
    assert 0.3 < gap.nees.mean() < 9.0
    assert max(float(np.linalg.norm(error[3:])) for error, _ in told) < 5.0


def test_fixes_shrink_what_an_imu_alone_would_lose(motion: Motion) -> None:
    drive = SensedDrive(motion, has_wheels=False, gnss=CONSUMER)
    alone, aided = (drive_over(drive, (8.0, 21.0), use_gnss=use) for use in (False, True))
    assert aided.end_sigma_m < 0.7 * alone.end_sigma_m
    assert aided.end_error_m < 3.0 * aided.end_sigma_m
    assert 0.5 < aided.nees.mean() < 12.0


def test_fixes_that_are_far_off_are_not_believed(motion: Motion) -> None:
    """A fifth of them is 5 to 50 m off and does not know it."""
    drive = SensedDrive(motion, has_wheels=False, gnss=CONSUMER, outlier_ratio=0.2)
    gap = drive_over(drive, (8.0, 18.0), use_gnss=True)
    assert None not in gap.predicted
    assert 0.02 < gap.end_error_m < 2.5
    assert 0.5 < gap.nees.mean() < 12.0


def test_with_nothing_to_reckon_with_there_is_no_reckoning(motion: Motion) -> None:
    bare = SensedDrive(motion, imu=None, has_wheels=False)
    assert DeadReckoning.for_drive(bare, use_gnss=False) is None  # type: ignore[arg-type]


def test_before_two_measured_poses_nothing_is_predicted(motion: Motion) -> None:
    drive = SensedDrive(motion)
    reckoning = DeadReckoning.for_drive(drive, use_gnss=False)  # type: ignore[arg-type]
    assert reckoning is not None
    poses = measured_poses(drive.truth, 0)
    assert reckoning.pose_at(poses[0].stamp_ns) is None
    reckoning.measured(poses[1])
    assert reckoning.pose_at(poses[2].stamp_ns) is None
    reckoning.measured(poses[3])
    found = reckoning.pose_at(poses[4].stamp_ns)
    assert found is not None
    assert np.linalg.norm(error_of(found, drive.truth, 4)[3:]) < 0.5
    assert (found.map_id, found.version, found.epsg) == ("street", "v1", drive.truth.epsg)


def test_one_wrong_measured_pose_does_not_carry_the_filter_away(motion: Motion) -> None:
    def one_is_wrong(index: int, pose: PoseEstimate) -> PoseEstimate:
        shift = np.array([3.0, -2.0, 0.5]) if index == 115 else np.zeros(3)
        return replace(
            pose, utm_from_cam=replace(pose.utm_from_cam, translation_m=pose.utm_from_cam.translation_m + shift)
        )

    drive = SensedDrive(motion)
    right, wrong = drive_over(drive, (12.0, 15.0)), drive_over(drive, (12.0, 15.0), change=one_is_wrong)
    assert None not in wrong.predicted
    assert abs(wrong.end_error_m - right.end_error_m) < 0.05
    assert wrong.end_error_m < 0.6


def test_in_a_dispute_with_the_camera_nothing_is_predicted(motion: Motion) -> None:
    def last_is_wrong(index: int, pose: PoseEstimate) -> PoseEstimate:
        if index != 119:
            return pose
        return replace(pose, utm_from_cam=pose.utm_from_cam @ Pose(np.eye(3), np.array([2.0, 0.0, 0.0])))

    assert set(drive_over(SensedDrive(motion), (12.0, 14.0), change=last_is_wrong).predicted) == {None}


def test_a_filter_that_contradicts_the_camera_for_long_gives_in(motion: Motion) -> None:
    """From 9 s on all poses are 5 m to the side, as another map might have it: that is where it predicts."""

    def moved(index: int, pose: PoseEstimate) -> PoseEstimate:
        shift = np.array([5.0, 0.0, 0.0]) if index >= 90 else np.zeros(3)
        return replace(
            pose, utm_from_cam=replace(pose.utm_from_cam, translation_m=pose.utm_from_cam.translation_m + shift)
        )

    gap = drive_over(SensedDrive(motion), (12.0, 14.0), change=moved)
    assert None not in gap.predicted
    assert 4.7 < gap.end_error_m < 5.3


def test_another_map_may_be_off_by_its_own_error_without_a_jump_in_speed(motion: Motion) -> None:
    """Its poses lie 0.12 m beside, which both maps' sigmas allow: the filter goes along, and stays sure enough."""

    def other_map(index: int, pose: PoseEstimate) -> PoseEstimate:
        if index < 115:
            return pose
        beside = replace(
            pose.utm_from_cam, translation_m=pose.utm_from_cam.translation_m + np.array([0.08, 0.08, 0.0])
        )
        return replace(pose, utm_from_cam=beside, map_id="avenue", version="v7")

    gap = drive_over(SensedDrive(motion), (12.0, 14.0), change=other_map)
    assert None not in gap.predicted
    assert 0.02 < gap.end_error_m < 0.45
    assert gap.nees.mean() < 30.0


def test_a_pause_of_the_imu_ends_the_prediction_and_the_camera_begins_it_anew(motion: Motion) -> None:
    drive = SensedDrive(motion, imu_pause_s=(13.0, 13.5))
    gap = drive_over(drive, (12.0, 15.0))
    told = [entry is not None for entry in gap.predicted]
    assert told[:10] == [True] * 10
    assert not any(told[12:])
    assert None not in drive_over(drive, (16.0, 18.0)).predicted


def test_a_mounting_that_is_assumed_is_learned_from_the_drive(motion: Motion) -> None:
    """The wheels' frame is said to be at the camera: the rolling axle is where it is all the same."""
    gap = drive_over(SensedDrive(motion, wheel_mounting_source="assumed level and forward"), (12.0, 18.0))
    assert None not in gap.predicted
    assert gap.end_error_m < 3.0 * gap.end_sigma_m
    assert gap.end_error_m < 1.0


def test_the_grids_metres_and_turn_count() -> None:
    """At the edge of a zone the grid has 0.8 mm/m more metres (at this latitude 0.1) and turns by 2 degrees."""
    motion = a_motion(4, 20.2, 10.0, lon_deg=11.99)
    drive = SensedDrive(motion, seed=1, gnss=replace(CONSUMER, bias_sigma_m=(0.0, 0.0, 0.0)))
    assert np.degrees(UtmGrid(drive.truth.epsg).convergence_rad(48.77, 11.99)) > 2.0
    gap = drive_over(drive, (8.0, 20.0), use_gnss=True)
    assert gap.end_error_m < 0.8
    assert 0.5 < gap.nees.mean() < 12.0


def test_time_does_not_run_backwards(motion: Motion) -> None:
    drive = SensedDrive(motion)
    reckoning = DeadReckoning.for_drive(drive, use_gnss=False)  # type: ignore[arg-type]
    assert reckoning is not None
    poses = measured_poses(drive.truth, 0)
    reckoning.measured(poses[5])
    with pytest.raises(InputError, match="sort them by time"):
        reckoning.pose_at(poses[4].stamp_ns)
