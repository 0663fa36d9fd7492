from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline, make_smoothing_spline

from fleetmap.smoothing_spline import fit_smoothing_spline


def wandering(times_s: np.ndarray, intensity: float, seed: int) -> np.ndarray:
    """A point (N, 2) whose acceleration is white noise: the exact discrete steps of position and speed."""
    rng = np.random.default_rng(seed)
    state, values = np.array([[0.0, 0.0], [9.0, -4.0]]), [np.zeros(2)]
    for step_s in np.diff(times_s):
        spread = intensity * np.array([[step_s**3 / 3.0, step_s**2 / 2.0], [step_s**2 / 2.0, step_s]])
        state = np.array([[1.0, step_s], [0.0, 1.0]]) @ state + np.linalg.cholesky(spread) @ rng.normal(
            size=(2, 2)
        )
        values.append(state[0])
    return np.array(values)


@pytest.mark.parametrize("uneven", [False, True])
def test_it_is_scipys_smoothing_spline_with_the_smoothness_it_chose(uneven: bool) -> None:
    rng = np.random.default_rng(4)
    times_s = np.cumsum(rng.uniform(0.05, 0.6, 80)) if uneven else np.arange(80) * 0.2
    variances = rng.uniform(0.01, 0.2, (80, 2)) if uneven else np.full((80, 2), 0.04)
    values = np.stack([8.0 * times_s, 5.0 * np.sin(times_s / 2.0)], axis=1) + rng.normal(0.0, np.sqrt(variances))
    fit = fit_smoothing_spline(times_s, values, variances)
    for axis in range(2):
        weights = 1.0 / (fit.sigma_factor**2 * variances[:, axis])
        theirs = make_smoothing_spline(times_s, values[:, axis], w=weights, lam=1.0 / fit.intensity_m2_s3)
        np.testing.assert_allclose(fit.values[:, axis], theirs(times_s), atol=1e-7)
        between_s = times_s[:-1] + 0.4 * np.diff(times_s)
        ours = CubicSpline(times_s, fit.values[:, axis], bc_type="natural")
        np.testing.assert_allclose(ours(between_s), theirs(between_s), atol=1e-7)


@pytest.mark.parametrize("seed", range(5))
def test_the_restlessness_of_the_road_and_the_receivers_honesty_are_recovered(seed: int) -> None:
    times_s = np.arange(1000) * 0.1
    noise = np.random.default_rng(100 + seed).normal(0.0, 0.1, (1000, 2))
    fit = fit_smoothing_spline(times_s, wandering(times_s, 0.5, seed) + noise, np.full((1000, 2), 0.05**2))
    assert 0.25 < fit.intensity_m2_s3 < 1.0
    assert 1.9 < fit.sigma_factor < 2.1


def test_smoothing_brings_the_values_nearer_to_the_truth() -> None:
    times_s = np.arange(600) * 0.1
    truth = wandering(times_s, 0.5, 9)
    values = truth + np.random.default_rng(9).normal(0.0, 0.1, truth.shape)
    fit = fit_smoothing_spline(times_s, values, np.full(truth.shape, 0.1**2))
    before, after = (np.sqrt(((v - truth) ** 2).mean()) for v in (values, fit.values))
    assert 0.09 < before < 0.11
    assert 0.03 < after < 0.065


def test_a_doubtful_value_is_overruled_by_its_neighbours() -> None:
    times_s = np.arange(100) * 0.1
    truth = np.stack([10.0 * times_s, np.sin(times_s)], axis=1)
    values = truth + np.random.default_rng(2).normal(0.0, 0.02, truth.shape)
    variances = np.full(truth.shape, 0.02**2)
    values[50] += 15.0
    variances[50] = 20.0**2
    assert np.abs(fit_smoothing_spline(times_s, values, variances).values - truth).max() < 0.06


def test_two_values_are_left_as_they_are() -> None:
    values = np.array([[1.0], [5.0]])
    fit = fit_smoothing_spline(np.array([0.0, 1.0]), values, np.ones((2, 1)))
    np.testing.assert_array_equal(fit.values, values)


def test_a_straight_line_without_noise_stays_a_straight_line() -> None:
    times_s = np.array([0.0, 0.1, 0.7, 2.0, 2.001, 9.0])
    line = np.outer(times_s, [3.0, -2.0]) + 5.0
    np.testing.assert_allclose(fit_smoothing_spline(times_s, line, np.full((6, 2), 0.01)).values, line, atol=1e-8)
