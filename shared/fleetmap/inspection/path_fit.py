"""Fits the path a camera saw to GNSS positions, with the clocks' offset as one of the unknowns.

The camera gives the course, but neither speed nor place. With the offset d, a fix stamped g was taken at g + d
on the camera's clock, and should lie at

    x(g + d) = integral of v(t) (cos, sin)(course(t) + b(t)) dt + R(heading + b) lever + e(t)

with a speed v of white jerk, a correction b of the visual course that wanders as a random walk, and an error e of
the receiver that wanders likewise. All unknowns (d, v, b, lever, e) are found together by Gauss-Newton with
Cauchy's weights, so the offset's sigma holds all that it could be confused with: on a straight at constant speed
a later clock looks like a shifted start, and the sigma says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.inspection.path_model import Fixes, Lever, PathModel
from fleetmap.inspection.visual_course import VisualCourse

Array = NDArray[np.float64]

_ITERATIONS = 12
_CAUCHY = 2.0
_PRIOR_FREEDOM = 4.0  # how many measurements the reported sigma counts for


@dataclass(frozen=True)
class PathFit:
    """The clocks' offset (camera minus GNSS), and how far the fixes scatter about the fitted path."""

    offset_s: float
    sigma_s: float
    scatter_m: float  # per axis
    speed_mps: float
    cost: float


def fit_path(course: VisualCourse, fixes: Fixes, lever: Lever, start_offset_s: float) -> PathFit | None:
    """The fit next to ``start_offset_s``; None where the numbers do not determine one."""
    model = PathModel.of(course, fixes, lever)
    unknowns = model.start(start_offset_s)
    scatter_m = fixes.sigma_m
    noise_m = scatter_m  # of one fix, if all were independent
    for _ in range(_ITERATIONS):
        residuals, jacobian = model.linearise(unknowns)
        noise_m = max(noise_m, _spread(residuals))  # while far off, nothing is an outlier
        weights = _cauchy(residuals, noise_m)
        prior_residuals, prior_jacobian = model.priors(unknowns)
        weighted = jacobian * weights[:, None]
        measured = weighted.T @ jacobian
        information = measured + prior_jacobian.T @ prior_jacobian
        gradient = weighted.T @ residuals + prior_jacobian.T @ prior_residuals
        try:
            covariance = np.linalg.inv(information)
        except np.linalg.LinAlgError:
            return None
        step = -covariance @ gradient
        step *= min(1.0, 0.3 / max(abs(float(step[0])), 1e-12))
        unknowns = unknowns + step
        used = float(np.trace(covariance @ measured))
        scatter_m = _scatter_m(residuals, used, fixes.sigma_m)
        noise_m = scatter_m * np.sqrt(_correlated_count(residuals))
    cost = float((weights * residuals**2).sum() + (prior_residuals**2).sum())
    cost += 2.0 * len(residuals) * float(np.log(noise_m))
    if not np.all(np.isfinite(unknowns)) or covariance[0, 0] <= 0.0:
        return None
    sigma_s = float(np.sqrt(covariance[0, 0]))
    return PathFit(float(unknowns[0]), sigma_s, scatter_m, model.speed_mps(unknowns), cost)


def _cauchy(residuals: Array, scatter_m: float) -> Array:
    """Weights (2 M,) for residuals that hold all eastings, then all northings; in 1/m^2."""
    distance = np.hypot(*residuals.reshape(2, -1)) / scatter_m
    return np.tile(1.0 / (1.0 + (distance / _CAUCHY) ** 2) / scatter_m**2, 2)


def _spread(residuals: Array) -> float:
    """Standard deviation, by the median."""
    return 1.4826 * float(np.median(np.abs(residuals)))


def _scatter_m(residuals: Array, used: float, reported_m: float) -> float:
    """White noise of the fixes from what the fit leaves, with the reported sigma as a weak prior.

    ``used`` is the number of measurements that the unknowns have taken up.
    """
    squares = len(residuals) * _spread(residuals) ** 2 + _PRIOR_FREEDOM * reported_m**2
    freedom = max(len(residuals) - used, 0.0) + _PRIOR_FREEDOM
    return max(float(np.sqrt(squares / freedom)), 0.003)


def _correlated_count(residuals: Array) -> float:
    """How many successive fixes say the same: 1 + 2 sum of their autocorrelation, up to its first zero."""
    left = residuals.reshape(2, -1)
    left = np.clip(left, -3.0 * _spread(residuals), 3.0 * _spread(residuals))
    power = float((left * left).sum())
    count = 1.0
    for lag in range(1, left.shape[1] // 4):
        correlation = float((left[:, lag:] * left[:, :-lag]).sum()) / max(power, 1e-12)
        if correlation <= 0.0:
            break
        count += 2.0 * correlation
    return count
