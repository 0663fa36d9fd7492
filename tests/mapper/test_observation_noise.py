"""Noise of a known size and correlation is estimated from the residuals, for corners and aligned patches apart."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fleetmap.geometry import Sim3
from fleetmap_mapper.observation_noise import observation_sigmas, with_estimated_noise
from fleetmap_mapper.placed_map import PlacedMap

ALIGNED_NOISE, CORNER_NOISE = 0.2, 1.3


def disturbed(make_world: Any, correlation: float, seed: int = 0) -> PlacedMap:
    """A world at its truth whose errors follow a first-order autoregression along each track."""
    world = make_world(seed=seed, keyframes=40, points=3000, step_m=0.5, noise=0.0)
    rng = np.random.default_rng(seed)
    count = len(world.pixels)
    is_aligned = rng.random(len(world.points))[world.point_index] < 0.7
    noise = np.where(is_aligned, ALIGNED_NOISE, CORNER_NOISE)
    fresh = rng.normal(0.0, 1.0, (count, 2))
    errors = fresh.copy()
    for m in range(1, count):
        if world.point_index[m] == world.point_index[m - 1]:
            errors[m] = correlation * errors[m - 1] + np.sqrt(1.0 - correlation**2) * fresh[m]
    # The points are at their truth; the estimate expects them fitted, which takes three degrees of freedom.
    lengths = np.bincount(world.point_index)[world.point_index]
    errors *= np.sqrt((2 * lengths - 3) / (2 * lengths))[:, None]
    return PlacedMap(
        world.camera,
        Sim3.identity(),
        np.arange(40) * 10**8,
        world.poses,
        np.arange(len(world.points), dtype=np.int32),
        world.points,
        world.keyframe_index,
        world.point_index,
        np.zeros(count, np.int32),
        world.pixels + errors * (noise * world.sigmas_px)[:, None],
        world.sigmas_px,
        np.ones(count),
        is_aligned,
    )


@pytest.mark.parametrize("seed", range(3))
def test_each_kind_gets_its_own_sigma(make_world, seed):
    placed = with_estimated_noise(disturbed(make_world, 0.0, seed))
    assert np.median(placed.noise[placed.is_aligned]) == pytest.approx(ALIGNED_NOISE, rel=0.1)
    assert np.median(placed.noise[~placed.is_aligned]) == pytest.approx(CORNER_NOISE, rel=0.1)


def test_estimating_again_changes_nothing(make_world):
    once = with_estimated_noise(disturbed(make_world, 0.3))
    np.testing.assert_allclose(with_estimated_noise(once).noise, once.noise, rtol=1e-9)


@pytest.mark.parametrize("correlation", [0.3, 0.6])
def test_correlation_along_tracks_is_seen(make_world, correlation):
    independent = with_estimated_noise(disturbed(make_world, 0.0)).track_correlation
    measured = with_estimated_noise(disturbed(make_world, correlation)).track_correlation
    assert 0.7 * correlation < measured - independent < 1.2 * correlation


def test_independent_observations_keep_their_sigma(make_world):
    placed = disturbed(make_world, 0.0)
    np.testing.assert_array_equal(observation_sigmas(placed), placed.sigmas_px)


def test_a_correlated_track_weighs_as_its_mean_is_known(make_world):
    """The variance of the mean of n correlated numbers, drawn, against the weights that n observations get."""
    correlation, draws = 0.5, 40_000
    placed = replace(disturbed(make_world, 0.0), track_correlation=correlation)
    lengths = np.bincount(placed.point_index)[placed.point_index]
    n = int(np.median(lengths))
    rng = np.random.default_rng(0)
    walk = rng.normal(0.0, 1.0, (draws, n))
    for k in range(1, n):
        walk[:, k] = correlation * walk[:, k - 1] + np.sqrt(1.0 - correlation**2) * walk[:, k]
    row = int(np.flatnonzero(lengths == n)[0])
    weight = n * (placed.sigmas_px[row] / observation_sigmas(placed)[row]) ** 2
    assert 1.0 / weight == pytest.approx(walk.mean(axis=1).var(), rel=0.05)
