"""Intervals that hold the truth as often as they say, although neighbours err alike."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm
from scipy.stats import t as student

from fleetmap.evaluation import SegmentBootstrap, TrajectoryErrors, judge

# Of |x|, x ~ N(0, 1), whatever the correlation between neighbours.
HALF_NORMAL = {"mean": np.sqrt(2.0 / np.pi), "median": 0.674490, "rmse": 1.0, "p95": 1.959964}


def correlated_errors(road_m: np.ndarray, trials: int, seed: int, length_m: float = 4.0) -> np.ndarray:
    """Absolute errors (T, N) whose neighbours are alike over ``length_m``: an autoregressive process."""
    rng = np.random.default_rng(seed)
    kept = np.exp(-(road_m[1] - road_m[0]) / length_m)
    values = rng.normal(size=(trials, len(road_m)))
    for index in range(1, len(road_m)):
        values[:, index] = kept * values[:, index - 1] + np.sqrt(1.0 - kept**2) * values[:, index]
    return np.abs(values)


def share_that_holds(interval_of, trials: np.ndarray, truth: float) -> float:  # type: ignore[no-untyped-def]
    intervals = np.array([interval_of(errors) for errors in trials])
    return float(np.mean((intervals[:, 0] <= truth) & (truth <= intervals[:, 1])))


@pytest.mark.parametrize("segments", [5, 12, 40])
def test_an_interval_of_the_mean_holds_the_truth_about_95_times_in_100(segments: int) -> None:
    road_m = np.arange(0.0, segments * 50.0 + 1.0, 1.0)
    trials = correlated_errors(road_m, 400, seed=segments)
    bootstrap = SegmentBootstrap.along(road_m)
    assert bootstrap.segments == segments
    share = share_that_holds(lambda e: bootstrap.mean(e, bootstrap.segment_of), trials, HALF_NORMAL["mean"])
    assert 0.85 < share < 0.99


def test_drawing_poses_instead_of_segments_would_fake_certainty() -> None:
    road_m = np.arange(0.0, 1001.0, 1.0)
    trials = correlated_errors(road_m, 200, seed=3)
    poses = SegmentBootstrap.along(road_m, segment_m=1.0)
    assert poses.segments == 1000
    share = share_that_holds(lambda e: poses.mean(e, poses.segment_of), trials, HALF_NORMAL["mean"])
    assert 0.3 < share < 0.75


def test_intervals_of_median_rmse_and_95th_percentile_hold_the_truth_too() -> None:
    road_m = np.arange(0.0, 2001.0, 4.0)
    trials = correlated_errors(road_m, 150, seed=8)
    bootstrap = SegmentBootstrap.along(road_m)
    intervals = [bootstrap.statistics(errors, bootstrap.segment_of) for errors in trials]
    for name, truth in HALF_NORMAL.items():
        ends = np.array([interval[name] for interval in intervals])
        share = np.mean((ends[:, 0] <= truth) & (truth <= ends[:, 1]))
        assert 0.85 < share < 0.995, name


def test_an_interval_of_the_mean_is_as_wide_as_students() -> None:
    segments, road_m = 8, np.arange(0.0, 401.0, 1.0)
    means = np.random.default_rng(2).normal(10.0, 2.0, segments)
    bootstrap = SegmentBootstrap.along(road_m)
    interval = bootstrap.mean(means[bootstrap.segment_of], bootstrap.segment_of)
    assert interval is not None
    half_m = student.ppf(0.975, segments - 1) * means.std(ddof=1) / np.sqrt(segments)
    assert interval[1] - interval[0] == pytest.approx(2.0 * half_m, rel=0.15)


def test_every_figure_is_that_of_the_drawn_segments_put_together() -> None:
    rng = np.random.default_rng(6)
    road_m = np.sort(rng.uniform(0.0, 320.0, 200))
    errors = rng.gamma(2.0, 0.1, 200)
    bootstrap = SegmentBootstrap.along(road_m)
    together = [
        np.concatenate([np.tile(errors[bootstrap.segment_of == s], draw[s]) for s in range(bootstrap.segments)])
        for draw in bootstrap.draws
    ]
    figures = {
        "mean": np.array([e.mean() for e in together]),
        "median": np.array([np.median(e) for e in together]),
        "rmse": np.array([np.sqrt((e**2).mean()) for e in together]),
        "p95": np.array([np.percentile(e, 95.0) for e in together]),
    }
    intervals = bootstrap.statistics(errors, bootstrap.segment_of)
    n = bootstrap.segments
    outside = norm.cdf(-np.sqrt(n / (n - 1)) * student.ppf(0.975, n - 1))
    for name, values in figures.items():
        np.testing.assert_allclose(intervals[name], np.quantile(values, [outside, 1.0 - outside]), atol=1e-9)


def test_a_road_is_cut_into_equal_segments_of_at_least_the_length() -> None:
    bootstrap = SegmentBootstrap.along(np.linspace(7.0, 7.0 + 214.0, 300))
    assert bootstrap.segments == 4
    assert bootstrap.segment_m == pytest.approx(53.5)
    np.testing.assert_array_equal(np.bincount(bootstrap.segment_of), 75)
    assert np.all(np.diff(bootstrap.segment_of) >= 0)


def test_the_same_road_is_drawn_the_same_every_time() -> None:
    road_m = np.linspace(0.0, 400.0, 100)
    np.testing.assert_array_equal(SegmentBootstrap.along(road_m).draws, SegmentBootstrap.along(road_m).draws)
    other = SegmentBootstrap.along(road_m, seed=1).draws
    assert not np.array_equal(SegmentBootstrap.along(road_m).draws, other)


@pytest.mark.parametrize("length_m", [0.0, 99.0])
def test_one_segment_tells_nothing_of_its_scatter(length_m: float) -> None:
    road_m = np.linspace(0.0, length_m, 50)
    bootstrap = SegmentBootstrap.along(road_m)
    assert bootstrap.segments == 1
    assert set(bootstrap.statistics(np.ones(50), bootstrap.segment_of).values()) == {None}


def test_errors_known_in_one_segment_of_many_tell_nothing_of_their_scatter() -> None:
    bootstrap = SegmentBootstrap.along(np.linspace(0.0, 400.0, 100))
    rows = bootstrap.segment_of[:10]
    assert set(bootstrap.statistics(np.ones(10), rows).values()) == {None}
    assert bootstrap.mean(np.zeros(0), rows[:0]) is None


def _errors(road_m: np.ndarray, compared: np.ndarray, distances_m: np.ndarray) -> TrajectoryErrors:
    positions_m = np.stack([road_m, 0.0 * road_m, 0.0 * road_m], axis=1)[compared]
    return TrajectoryErrors(
        stamps_ns=compared.astype(np.int64) * 100_000_000,
        true_positions_m=positions_m,
        offsets_m=np.stack([0.0 * distances_m, distances_m, 0.0 * distances_m], axis=1),
        road_m=road_m,
        compared=compared,
    )


def test_coverage_is_known_as_well_as_its_holes_are_spread() -> None:
    road_m = np.arange(0.0, 1001.0, 1.0)
    spread = np.flatnonzero(np.arange(1001) % 5 != 0)
    clustered = np.flatnonzero(road_m >= 200.0)
    spread_interval, clustered_interval = (
        judge(_errors(road_m, rows, np.full(len(rows), 0.1))).coverage_interval for rows in (spread, clustered)
    )
    assert spread_interval is not None
    assert clustered_interval is not None
    for low, high in (spread_interval, clustered_interval):
        assert low <= 0.8 <= high
    assert spread_interval[1] - spread_interval[0] < 0.02
    assert 0.3 < clustered_interval[1] - clustered_interval[0] < 0.6


def test_a_judgement_holds_an_interval_for_every_figure_it_names() -> None:
    road_m = np.arange(0.0, 301.0, 1.0)
    errors = _errors(road_m, np.arange(301), correlated_errors(road_m, 1, seed=0)[0])
    figures = judge(errors).to_json()["intervals"]
    assert (figures["segments"], figures["segment_m"], figures["confidence"]) == (6, 50.0, 0.95)
    for name in ("mean", "median", "rmse", "p95"):
        low, high = figures["position_m"][name]
        assert low < getattr(errors.position_m, name) < high
        assert figures["horizontal_m"][name] == pytest.approx([low, high], abs=1e-12)
    low, high = figures["windows"]["mean_rmse_m"]
    assert low < judge(errors).windows.rmse_m.mean() < high
    assert figures["coverage"] == [1.0, 1.0]


def test_segments_are_never_shorter_than_the_windows() -> None:
    road_m = np.arange(0.0, 301.0, 1.0)
    errors = _errors(road_m, np.arange(301), np.full(301, 0.1))
    assert judge(errors, window_m=20.0).segment_m == 50.0
    assert judge(errors, window_m=100.0).segment_m == 100.0


def test_a_short_drive_is_judged_without_intervals_and_without_windows() -> None:
    road_m = np.arange(0.0, 41.0, 1.0)
    figures = judge(_errors(road_m, np.arange(41), np.full(41, 0.1))).to_json()
    assert figures["windows"] is None
    assert figures["intervals"]["segments"] == 1
    assert figures["intervals"]["position_m"] == {"mean": None, "median": None, "rmse": None, "p95": None}
    assert figures["intervals"]["windows"] == {"mean_rmse_m": None}
    assert figures["intervals"]["coverage"] is None
