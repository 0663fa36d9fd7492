from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fleetmap.drive import GnssFix
from fleetmap.errors import TrajectoryError
from fleetmap.evaluation import evaluate_trajectory
from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import rotations_from_quat_xyzw
from fleetmap.gnss import RTK, GnssErrorModel, sample_fixes
from fleetmap.trajectory import Trajectory
from fleetmap.yardstick import compare_with_yardstick, evaluate_gnss_spline, evaluate_smoothing_spline

START_NS = 1_700_000_000_000_000_000
GRID = UtmGrid(32632)
CORNER_M = np.array([455_300.0, 5_425_500.0, 120.0])


def cubic_road(stamps_ns: np.ndarray) -> np.ndarray:
    """A road that is a cubic polynomial of time, which a not-a-knot spline passes exactly."""
    t = (stamps_ns - START_NS) / 1e9
    return CORNER_M + np.stack([7.0 * t, 0.9 * t**2 - 0.02 * t**3, 0.1 * t], axis=1)


def reference(count: int = 301) -> Trajectory:
    stamps_ns = START_NS + np.arange(count, dtype=np.int64) * 100_000_000
    return Trajectory(32632, stamps_ns, cubic_road(stamps_ns), np.tile(np.eye(3), (count, 1, 1)))


def fixes(stamps_ns: np.ndarray, shift_m: np.ndarray | float = 0.0) -> list[GnssFix]:
    geodetic = GRID.to_geodetic(cubic_road(stamps_ns) + shift_m)
    return [
        GnssFix(int(stamp), float(lat), float(lon), float(height), np.eye(3) * 0.0025)
        for stamp, lat, lon, height in zip(stamps_ns, *geodetic, strict=True)
    ]


def every(interval_ns: int, first_ns: int = 37_000_000, length_ns: int = 30_000_000_000) -> np.ndarray:
    return START_NS + np.arange(first_ns, length_ns, interval_ns, dtype=np.int64)


def test_a_cubic_road_is_passed_exactly_even_by_sparse_fixes() -> None:
    errors = evaluate_gnss_spline(fixes(every(5_000_000_000)), reference())
    assert errors.position_m.max < 1e-5
    assert errors.rotation is None
    assert "rotation_deg" not in errors.to_json()


def test_fix_noise_and_bias_pass_into_the_spline() -> None:
    stamps_ns = every(100_000_000)
    noise = np.random.default_rng(3).normal(0.0, 0.05, (len(stamps_ns), 3))
    errors = evaluate_gnss_spline(fixes(stamps_ns, noise + np.array([1.0, 0.0, 0.0])), reference())
    assert errors.position_m.mean == pytest.approx(1.0, abs=0.03)
    assert 0.03 < errors.position_m.std < 0.06


def test_only_reference_poses_between_first_and_last_fix_are_judged() -> None:
    errors = evaluate_gnss_spline(fixes(every(1_000_000_000, 10_000_000_000, 20_500_000_000)), reference())
    assert (errors.matched, errors.comparable) == (101, 301)
    assert errors.stamps_ns[0] == START_NS + 10_000_000_000
    assert errors.stamps_ns[-1] == START_NS + 20_000_000_000


def test_of_two_fixes_at_one_time_the_first_counts_and_order_does_not_matter() -> None:
    stamps_ns = every(1_000_000_000)
    ordered, wrong = fixes(stamps_ns), fixes(stamps_ns, 5.0)
    errors = evaluate_gnss_spline([*reversed(ordered), wrong[3]], reference())
    assert errors.position_m.max < 1e-5


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_fixes_make_no_spline(count: int) -> None:
    with pytest.raises(TrajectoryError, match=f"holds {count}"):
        evaluate_gnss_spline(fixes(every(1_000_000_000)[:count]), reference())


def test_a_recording_of_another_day_is_refused() -> None:
    late = [GnssFix(f.stamp_ns + 10**15, f.lat_deg, f.lon_deg, f.height_m, f.covariance_enu_m2)
            for f in fixes(every(1_000_000_000))]  # fmt: skip
    with pytest.raises(TrajectoryError, match="belong together"):
        evaluate_gnss_spline(late, reference())


def winding_drive(count: int = 600, waiting: int = 0) -> Trajectory:
    """A camera that looks along a winding road with a hill, 10 images a second; it may wait in the middle."""
    stamps_ns = START_NS + np.arange(count + waiting, dtype=np.int64) * 100_000_000
    t = np.arange(count) / 10.0
    t = np.concatenate([t[: count // 2], np.full(waiting, t[count // 2]), t[count // 2 :]])
    positions_m = CORNER_M + np.stack([8.0 * t, 20.0 * np.sin(t / 6.0), 2.0 * np.sin(t / 9.0)], axis=1)
    forward = np.stack([np.full(len(t), 8.0), 20.0 / 6.0 * np.cos(t / 6.0), 2.0 / 9.0 * np.cos(t / 9.0)], axis=1)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return Trajectory(32632, stamps_ns, positions_m, np.stack([right, np.cross(forward, right), forward], axis=-1))


def kitti_odometry(drives_folder: Path) -> Trajectory:
    rows = np.loadtxt(
        drives_folder / "kitti_odo_00_first300" / "gt_cam0_utm32n_levelled.csv", delimiter=",", skiprows=1
    )
    stamps_ns = START_NS + np.round(rows[:, 1] * 1e9).astype(np.int64)
    return Trajectory(32632, stamps_ns, rows[:, 2:5], rotations_from_quat_xyzw(rows[:, 5:]))


@pytest.mark.parametrize("seed", range(3))
def test_dense_fixes_are_averaged_where_the_cubic_passes_through_their_noise(seed: int) -> None:
    truth = winding_drive()
    rtk = sample_fixes(truth, RTK, interval_s=0.1, seed=seed)
    assert 0.065 < evaluate_gnss_spline(rtk, truth).position_m.mean < 0.085
    assert 0.02 < evaluate_smoothing_spline(rtk, truth).position_m.mean < 0.04


def test_dense_rtk_fixes_alone_are_three_centimetres_good_on_a_real_road(drives_folder: Path) -> None:
    truth = kitti_odometry(drives_folder)
    errors = evaluate_smoothing_spline(sample_fixes(truth, RTK, interval_s=0.1), truth)
    assert 0.025 < errors.position_m.mean < 0.035


def test_between_sparse_fixes_smoothing_costs_little_on_a_real_road(drives_folder: Path) -> None:
    truth = kitti_odometry(drives_folder)
    sparse = sample_fixes(truth, RTK, interval_s=5.0, seed=7)
    cubic, smoothing = evaluate_gnss_spline(sparse, truth), evaluate_smoothing_spline(sparse, truth)
    assert 0.7 < cubic.position_m.mean < 1.0
    assert 0.9 < smoothing.position_m.mean / cubic.position_m.mean < 1.1
    assert smoothing.matched == cubic.matched


@pytest.mark.parametrize("interval_s", [2.0, 5.0])
def test_between_sparse_fixes_smoothing_costs_little_on_a_winding_road(interval_s: float) -> None:
    truth = winding_drive()
    for seed in range(5):
        sparse = sample_fixes(truth, RTK, interval_s=interval_s, seed=seed)
        cubic, smoothing = evaluate_gnss_spline(sparse, truth), evaluate_smoothing_spline(sparse, truth)
        assert 0.3 < smoothing.position_m.mean / cubic.position_m.mean < 1.25


@pytest.mark.parametrize("reported_sigma_m", [0.01, 0.05, 1.5])
def test_a_receiver_that_misjudges_itself_is_smoothed_as_it_really_errs(reported_sigma_m: float) -> None:
    truth = winding_drive()
    model = GnssErrorModel(0.05, (0.0, 0.0, 0.0), 100.0, reported_sigma_m)
    errors = evaluate_smoothing_spline(sample_fixes(truth, model, seed=5), truth)
    assert 0.02 < errors.position_m.mean < 0.04


def test_a_receiver_that_says_nothing_of_itself_is_smoothed_too() -> None:
    truth = winding_drive()
    silent = [
        GnssFix(fix.stamp_ns, fix.lat_deg, fix.lon_deg, fix.height_m, np.zeros((3, 3)))
        for fix in sample_fixes(truth, RTK, seed=5)
    ]
    assert 0.02 < evaluate_smoothing_spline(silent, truth).position_m.mean < 0.04


def test_an_antenna_that_is_not_at_the_camera_is_no_excuse_for_the_yardstick() -> None:
    truth, arm_m = winding_drive(waiting=50), (0.5, -1.6, -0.8)
    fixes = sample_fixes(truth, RTK, interval_s=0.2, antenna_in_cam_m=arm_m)
    length_m = np.linalg.norm(arm_m)
    assert evaluate_gnss_spline(fixes, truth).position_m.mean == pytest.approx(length_m, abs=0.05)
    errors = evaluate_smoothing_spline(fixes, truth, np.array(arm_m))
    at_camera = evaluate_smoothing_spline(sample_fixes(truth, RTK, interval_s=0.2), truth)
    assert 0.02 < at_camera.position_m.mean < errors.position_m.mean < 0.06
    assert errors.position_m.max < at_camera.position_m.max + 0.2  # also where the vehicle waits


def test_a_vehicle_that_never_moves_has_no_direction_to_take_an_arm_off() -> None:
    drive = winding_drive(100)
    still = Trajectory(32632, drive.stamps_ns, np.tile(CORNER_M, (100, 1)), drive.rotations)
    fixes = sample_fixes(still, RTK, antenna_in_cam_m=(0.0, 0.0, 0.0))
    assert evaluate_smoothing_spline(fixes, still, np.array([0.0, -1.0, 0.0])).position_m.max < 0.3


def test_fixes_reported_twice_a_moment_apart_do_not_bend_the_spline() -> None:
    truth = winding_drive()
    once = sample_fixes(truth, RTK, interval_s=1.0, seed=2)
    again = sample_fixes(truth, RTK, interval_s=1.0, seed=3)
    twice = once + [
        GnssFix(fix.stamp_ns + 1, fix.lat_deg, fix.lon_deg, fix.height_m, fix.covariance_enu_m2) for fix in again
    ]
    for judge_spline in (evaluate_gnss_spline, evaluate_smoothing_spline):
        np.testing.assert_array_equal(judge_spline(twice, truth).offsets_m, judge_spline(once, truth).offsets_m)


def test_two_fixes_are_joined_by_a_straight_line() -> None:
    errors = evaluate_smoothing_spline(fixes(every(1_000_000_000)[:2]), reference())
    assert errors.position_m.max < 0.3
    assert errors.matched == 10


def test_the_smoothing_spline_refuses_what_the_cubic_refuses() -> None:
    with pytest.raises(TrajectoryError, match="holds 1"):
        evaluate_smoothing_spline(fixes(every(1_000_000_000)[:1]), reference())


def test_an_estimate_is_held_against_the_yardstick_where_both_are() -> None:
    truth = winding_drive()
    yardstick = evaluate_gnss_spline(sample_fixes(truth, RTK, seed=1), truth)
    keep = slice(100, 500)
    good, poor = (
        evaluate_trajectory(
            Trajectory(32632, truth.stamps_ns[keep], truth.positions_m[keep] + shift_m, truth.rotations[keep]),
            truth,
        )
        for shift_m in (np.array([0.02, 0.0, 0.0]), np.array([0.3, 0.0, 0.0]))
    )
    won, lost = compare_with_yardstick(good, yardstick), compare_with_yardstick(poor, yardstick)
    assert won is not None
    assert lost is not None
    assert won.common == lost.common == 400
    assert won.difference_m == pytest.approx(0.02 - won.yardstick_mean_m, abs=1e-8)
    assert won.interval is not None
    assert won.interval[0] < won.difference_m < won.interval[1] < 0.0
    assert won.better
    assert not lost.better
