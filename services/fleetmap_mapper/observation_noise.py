"""How exact observations are, estimated from the map's own residuals: variance components and correlation.

Aligned patches and corners are two kinds of observation, each with one unknown factor on its sigmas. Errors are
alike along a track as well: see fleetmap.track_correlation.

Source: Foerstner, "A batch processing approach to parameter estimation of variance and covariance components",
1979, with medians in place of means.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.track_correlation import track_correlation, track_lengths, variance_inflation
from fleetmap_mapper.placed_map import PlacedMap, reprojection_errors_px

Array = NDArray[np.float64]

_MEDIAN_2DOF = 1.386  # of chi-square with 2 degrees of freedom
_MIN_OBSERVATIONS = 100
_FACTOR_RANGE = 0.2, 5.0  # one round changes a sigma by no more


def with_estimated_noise(placed: PlacedMap) -> PlacedMap:
    """The map with sigmas and correlation that its residuals have; it should be near its optimum."""
    errors = reprojection_errors_px(placed) / placed.sigmas_px[:, None]
    lengths = track_lengths(placed.point_index)
    # A track's own point takes three of its 2 n residuals.
    chi2 = (errors**2).sum(axis=1) * 2 * lengths / np.maximum(2 * lengths - 3, 1)
    factors = np.ones(len(chi2))
    for kind in (placed.is_aligned, ~placed.is_aligned):
        usable = kind & np.isfinite(chi2) & (lengths > 2)
        if np.count_nonzero(usable) >= _MIN_OBSERVATIONS:
            factors[kind] = np.clip(np.sqrt(np.median(chi2[usable]) / _MEDIAN_2DOF), *_FACTOR_RANGE)
    correlation = track_correlation(errors / factors[:, None], placed.keyframe_index, placed.point_index)
    return replace(placed, noise=placed.noise * factors, track_correlation=correlation)


def observation_sigmas(placed: PlacedMap) -> Array:
    """Sigma (M,) of each observation in a graph that takes them as independent."""
    return placed.sigmas_px * np.sqrt(
        variance_inflation(track_lengths(placed.point_index), placed.track_correlation)
    )
