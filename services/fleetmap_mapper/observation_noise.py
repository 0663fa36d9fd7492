"""How exact observations are, estimated from the map's own residuals: variance components and correlation.

Aligned patches and corners are two kinds of observation, each with one unknown factor on its sigmas. Errors are
alike along a track as well, since a patch that is seen a little wrong in one image is seen so in the next; n
observations whose errors correlate by rho from one to the next weigh as much as n / f independent ones, with

    f(n) = 1 + 2 sum_{k=1}^{n-1} (1 - k/n) rho^k

Sources: Foerstner, "A batch processing approach to parameter estimation of variance and covariance components",
1979, with medians in place of means; for the variance of a mean under first-order autoregression, Bartlett, 1946.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fleetmap_mapper.placed_map import PlacedMap, reprojection_errors_px

Array = NDArray[np.float64]

_MEDIAN_2DOF = 1.386  # of chi-square with 2 degrees of freedom
_LONG_TRACK = 8  # observations; shorter tracks say little about correlation
_MIN_OBSERVATIONS = 100
_FACTOR_RANGE = 0.2, 5.0  # one round changes a sigma by no more
_MAX_CORRELATION = 0.9
_MAX_SIGMAS = 3.0  # errors beyond are cut off where correlation is measured


def with_estimated_noise(placed: PlacedMap) -> PlacedMap:
    """The map with sigmas and correlation that its residuals have; it should be near its optimum."""
    errors = reprojection_errors_px(placed) / placed.sigmas_px[:, None]
    lengths = _track_lengths(placed)
    # A track's own point takes three of its 2 n residuals.
    chi2 = (errors**2).sum(axis=1) * 2 * lengths / np.maximum(2 * lengths - 3, 1)
    factors = np.ones(len(chi2))
    for kind in (placed.is_aligned, ~placed.is_aligned):
        usable = kind & np.isfinite(chi2) & (lengths > 2)
        if np.count_nonzero(usable) >= _MIN_OBSERVATIONS:
            factors[kind] = np.clip(np.sqrt(np.median(chi2[usable]) / _MEDIAN_2DOF), *_FACTOR_RANGE)
    correlation = _correlation(errors / factors[:, None], placed, lengths)
    return replace(placed, noise=placed.noise * factors, track_correlation=correlation)


def observation_sigmas(placed: PlacedMap) -> Array:
    """Sigma (M,) of each observation in a graph that takes them as independent."""
    return placed.sigmas_px * np.sqrt(_inflation(_track_lengths(placed), placed.track_correlation))


def _track_lengths(placed: PlacedMap) -> NDArray[np.int64]:
    """For each observation (M,) how many its landmark has."""
    counts = np.bincount(placed.point_index, minlength=len(placed.points_m))
    return np.asarray(counts[placed.point_index], dtype=np.int64)


def _inflation(lengths: NDArray[np.int64], correlation: float) -> Array:
    """f(n) of the module's formula, (M,)."""
    table = np.ones(int(lengths.max(initial=0)) + 1)
    for n in range(2, len(table)):
        k = np.arange(1, n)
        table[n] = 1.0 + 2.0 * float(((1.0 - k / n) * correlation**k).sum())
    return table[lengths]


def _correlation(errors: Array, placed: PlacedMap, lengths: NDArray[np.int64]) -> float:
    """Of normalised errors (M, 2) from one observation of a track to the next, over long tracks."""
    order = np.lexsort((placed.keyframe_index, placed.point_index))
    cut = np.clip(np.nan_to_num(errors[order]), -_MAX_SIGMAS, _MAX_SIGMAS)
    tracks, lengths = placed.point_index[order], lengths[order]
    is_long = lengths >= _LONG_TRACK
    follows = (tracks[1:] == tracks[:-1]) & is_long[1:]
    if np.count_nonzero(follows) < _MIN_OBSERVATIONS:
        return 0.0
    measured = (cut[1:] * cut[:-1])[follows].mean() / (cut[is_long] ** 2).mean()
    # The point's fit takes 1.5 degrees of freedom from each coordinate's n errors: white noise measures -1.5 / n.
    return float(np.clip(measured + 1.5 / lengths[is_long].mean(), 0.0, _MAX_CORRELATION))
