"""A Sim(3) for every window of the road."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from evo.core import geometry

from fleetmap.errors import InputError
from fleetmap.evaluation import TrajectoryErrors, evaluate_trajectory, fit_windows
from fleetmap.geometry import rotations_from_quat_xyzw, so3_exp
from fleetmap.trajectory import Trajectory

START_NS = 1_700_000_000_000_000_000
CORNER_M = np.array([455_300.0, 5_425_500.0, 120.0])


def trajectory(positions_m: np.ndarray) -> Trajectory:
    count = len(positions_m)
    stamps_ns = START_NS + np.arange(count, dtype=np.int64) * 100_000_000
    return Trajectory(32632, stamps_ns, CORNER_M + positions_m, np.tile(np.eye(3), (count, 1, 1)))


def winding_road(length_m: float = 600.0, spacing_m: float = 0.8) -> np.ndarray:
    """Positions (N, 3) at equal steps along a winding road with a hill."""
    x = np.linspace(0.0, length_m, 20_000)
    fine = np.stack([x, 25.0 * np.sin(x / 40.0), 3.0 * np.sin(x / 90.0)], axis=1)
    driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
    at = np.arange(0.0, length_m + 1e-6, spacing_m)
    return np.stack([np.interp(at, driven, axis) for axis in fine.T], axis=1)


def errors_of(estimated_m: np.ndarray, true_m: np.ndarray, align: str = "none") -> TrajectoryErrors:
    return evaluate_trajectory(trajectory(estimated_m), trajectory(true_m), align=align)  # type: ignore[arg-type]


def test_a_scale_drift_of_known_amount_gives_the_known_ratio() -> None:
    true_m = winding_road()
    steps = np.diff(true_m, axis=0)
    share = np.arange(len(steps)) / len(steps)
    estimated_m = np.concatenate([np.zeros((1, 3)), np.cumsum(steps * (1.0 + 0.3 * share)[:, None], axis=0)])
    windows = fit_windows(errors_of(estimated_m, true_m))
    # The scale of a window is that of its middle: 25 m after the start, and 25 m before the end, of 600 m.
    first, last = 1.0 + 0.3 * 25.0 / 600.0, 1.0 + 0.3 * 575.0 / 600.0
    figures = windows.to_json()
    assert figures is not None
    assert figures["scale_max"] == pytest.approx(1.0 / first, rel=3e-3)
    assert figures["scale_min"] == pytest.approx(1.0 / last, rel=3e-3)
    assert figures["scale_ratio"] == pytest.approx(last / first, rel=3e-3)
    assert figures["log_scale_std"] == pytest.approx(np.log(last / first) / np.sqrt(12.0), rel=0.05)
    # Drift within a window bends its shape a little; the whole drive by far more.
    assert 0.0 < figures["mean_rmse_m"] < figures["max_rmse_m"] < 0.35
    assert errors_of(estimated_m, true_m, "sim3").position_m.rmse > 3.0


def test_a_straight_road_has_good_scales() -> None:
    line_m = np.outer(np.arange(200.0), [0.6, 0.8, 0.0])
    windows = fit_windows(errors_of(0.5 * line_m, line_m))
    np.testing.assert_allclose(windows.scales, 2.0, rtol=1e-9)
    assert windows.rmse_m.max() < 1e-6


@pytest.mark.parametrize("align", ["none", "se3", "sim3"])
def test_no_similarity_of_the_whole_estimate_changes_a_window(align: str) -> None:
    true_m = winding_road()
    noisy_m = true_m + np.random.default_rng(0).normal(0.0, 0.1, true_m.shape)
    turned_m = 0.4 * noisy_m @ so3_exp(np.array([0.3, -1.0, 2.0])).T + [30.0, -80.0, 5.0]
    plain = fit_windows(errors_of(noisy_m, true_m))
    windows = fit_windows(errors_of(turned_m, true_m, align))
    np.testing.assert_allclose(windows.rmse_m, plain.rmse_m, atol=1e-7)
    np.testing.assert_allclose(windows.scales, plain.scales / 0.4, rtol=1e-7)


def test_white_noise_leaves_its_own_size_less_the_seven_fitted_unknowns() -> None:
    true_m = winding_road(3000.0, 1.0)
    noisy_m = true_m + np.random.default_rng(1).normal(0.0, 0.05, true_m.shape)
    mean_rmse_m = fit_windows(errors_of(noisy_m, true_m)).rmse_m.mean()
    poses = 51
    assert mean_rmse_m == pytest.approx(0.05 * np.sqrt((3 * poses - 7) / poses), rel=0.02)


def assert_equal_to_evo(errors: TrajectoryErrors, window_m: float, step_m: float, at_least: int) -> None:
    windows = fit_windows(errors, window_m, step_m)
    assert windows.count >= at_least
    driven_m = errors.driven_m
    for start_m, rmse_m, scale in zip(windows.starts_m, windows.rmse_m, windows.scales, strict=True):
        first = int(np.searchsorted(driven_m, start_m))
        last = int(np.searchsorted(driven_m, start_m + window_m - 1e-9))
        origin_m = errors.true_positions_m[first]
        estimated = (errors.positions_m[first : last + 1] - origin_m).T
        true = (errors.true_positions_m[first : last + 1] - origin_m).T
        r, t, c = geometry.umeyama_alignment(estimated, true, with_scale=True)
        residuals = c * r @ estimated + t[:, None] - true
        assert abs(scale - c) < 1e-9
        assert abs(rmse_m - np.sqrt((residuals**2).sum(axis=0).mean())) < 1e-9


def test_every_window_equals_evos_alignment() -> None:
    true_m = winding_road()
    wandering = np.cumsum(np.random.default_rng(3).normal(0.0, 0.05, true_m.shape), axis=0)
    assert_equal_to_evo(errors_of(true_m + wandering, true_m), 50.0, 1.0, at_least=500)


def test_the_windows_of_published_trajectories_equal_evos_alignment(data_folder: Path) -> None:
    folder = data_folder / "rgbd" / "evo_ate_golden"
    if not folder.is_dir():
        pytest.skip(f"no published trajectories at {folder}")
    estimate, reference = (
        _read_tum_without_zone(folder / f"freiburg1_xyz-{name}.txt") for name in ("rgbdslam", "groundtruth")
    )
    errors = evaluate_trajectory(estimate, reference, max_offset_ns=10_000_000)
    assert_equal_to_evo(errors, 1.0, 0.05, at_least=50)


def _read_tum_without_zone(path: Path) -> Trajectory:
    rows = np.loadtxt(path)
    stamps_ns = np.round(rows[:, 0] * 1e6).astype(np.int64) * 1000
    return Trajectory(32632, stamps_ns, rows[:, 1:4], rotations_from_quat_xyzw(rows[:, 4:]))


def test_a_window_starts_every_metre_and_must_fit_whole() -> None:
    line_m = np.outer(np.arange(101) * 1.0, [1.0, 0.0, 0.0])
    assert fit_windows(errors_of(line_m, line_m)).starts_m.tolist() == pytest.approx(list(range(51)))
    dense_m = np.outer(np.arange(1001) * 0.1, [1.0, 0.0, 0.0])
    assert fit_windows(errors_of(dense_m, dense_m)).count in (50, 51)
    assert fit_windows(errors_of(line_m, line_m), window_m=100.0).count == 1
    longer = fit_windows(errors_of(line_m, line_m), window_m=100.5)
    assert (longer.count, longer.left_out, longer.to_json()) == (0, 0, None)
    assert longer.length_m == pytest.approx(100.0)


def test_waiting_adds_no_window() -> None:
    moving_m = winding_road(150.0, 1.0)
    waiting_m = np.concatenate([moving_m[:60], np.tile(moving_m[60], (500, 1)), moving_m[60:]])
    plain, waited = (fit_windows(errors_of(m, m)) for m in (moving_m, waiting_m))
    assert plain.count == waited.count
    np.testing.assert_allclose(waited.starts_m, plain.starts_m, atol=1e-6)


def test_windows_with_a_hole_or_too_few_poses_are_left_out() -> None:
    true_m = np.outer(np.arange(301) * 1.0, [1.0, 0.0, 0.0])
    reference = trajectory(true_m)
    keep = np.ones(len(true_m), dtype=bool)
    keep[100:130] = False  # 31 m between neighbours
    estimate = Trajectory(
        32632, *(a[keep] for a in (reference.stamps_ns, reference.positions_m, reference.rotations))
    )
    windows = fit_windows(evaluate_trajectory(estimate, reference))
    assert windows.left_out == 50  # those that start from 50 m to 99 m and would end behind the hole
    assert not np.any((windows.starts_m > 49.5) & (windows.starts_m < 99.5))
    sparse = slice(None, None, 12)  # five poses in 50 m
    estimate = Trajectory(
        32632, *(a[sparse] for a in (reference.stamps_ns, reference.positions_m, reference.rotations))
    )
    figures = fit_windows(evaluate_trajectory(estimate, reference))
    assert figures.to_json() is not None
    assert fit_windows(evaluate_trajectory(estimate, reference), window_m=36.0).to_json() is None


def test_windows_in_which_the_estimate_stands_still_are_left_out_and_counted() -> None:
    true_m = np.outer(np.arange(301) * 1.0, [1.0, 0.0, 0.0])
    stuck_m = true_m.copy()
    stuck_m[100:] = stuck_m[100]
    windows = fit_windows(errors_of(stuck_m, true_m))
    assert windows.left_out == 151  # from 100 m to 250 m; those that begin before hold some way
    assert windows.count == 100
    assert np.all(windows.scales > 0.0)
    assert np.all(np.isfinite(windows.scales))


@pytest.mark.parametrize("window_m", [0.0, -5.0, np.nan, np.inf])
def test_a_window_without_length_is_refused(window_m: float) -> None:
    line_m = np.outer(np.arange(10.0), [1.0, 0.0, 0.0])
    with pytest.raises(InputError, match="makes no sense"):
        fit_windows(errors_of(line_m, line_m), window_m=window_m)
