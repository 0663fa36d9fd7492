"""A cubic smoothing spline whose smoothness the data choose.

The cubic smoothing spline is the best estimate of a point whose acceleration is white noise of intensity q
(G. Wahba, "Improper priors, spline smoothing and the problem of guarding against model errors in regression",
JRSS B 40(3), 1978): q takes the place of the smoothing parameter, and its likelihood can be had from the data
alone. Second divided differences of the data, z = Q^T y in the notation of P. J. Green, B. W. Silverman,
"Nonparametric Regression and Generalized Linear Models", 1994, section 2.1, are free of the unknown line, and

    z ~ N(0, q R + s^2 Q^T W^-1 Q)          with five non-zero diagonals, so that n data cost O(n)

where W^-1 are the reported variances and s tells how far they are wrong. Maximising this restricted likelihood
(G. Wahba, "A comparison of GCV and GML for choosing the smoothing parameter", Annals of Statistics 13(4), 1985)
is preferred to cross-validation, which for the handful of fixes of a short drive often chooses no smoothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.optimize import minimize

Array = NDArray[np.float64]

# A receiver's own sigma is believed within this factor (one sigma of a log-normal prior) until the data tell:
# a few sparse fixes cannot tell their noise from the road's bends.
_TRUST_IN_SIGMAS = 3.0
_INTENSITY_GRID = np.geomspace(1e-5, 1e3, 9)  # m^2/s^3, from a ship to a stunt
_SIGMA_GRID = np.array([0.03, 0.1, 0.3, 1.0, 3.0])


@dataclass(frozen=True)
class SmoothedValues:
    """Values at the knots of a smoothing spline, and what was found out about road and receiver."""

    values: Array  # (N, K); the natural cubic spline through them is the smoothing spline
    intensity_m2_s3: float  # q, of the acceleration's white noise
    sigma_factor: float  # s, by which the reported sigmas are too small


def fit_smoothing_spline(times_s: Array, values: Array, variances: Array) -> SmoothedValues:
    """The smoothing spline of K axes that share their smoothness and their receiver's honesty.

    Args:
        times_s: (N,) strictly increasing, N >= 2.
        values: (N, K) in metres.
        variances: (N, K) reported ones, positive.

    With fewer than three values nothing can be smoothed: they are returned as they are.
    """
    if len(times_s) < 3:
        return SmoothedValues(values.copy(), intensity_m2_s3=0.0, sigma_factor=1.0)
    system = _System.of(times_s)
    intensity, sigma_factor = _likeliest(system, values, variances)
    smoothed = np.empty_like(values)
    for axis in range(values.shape[1]):
        noise = sigma_factor**2 * variances[:, axis]
        factor = cholesky_banded(system.covariance(intensity, noise), lower=True)
        weights = cho_solve_banded((factor, True), system.differences(values[:, axis]))
        smoothed[:, axis] = values[:, axis] - noise * system.transposed_differences(weights)
    return SmoothedValues(smoothed, intensity, sigma_factor)


def _likeliest(system: _System, values: Array, variances: Array) -> tuple[float, float]:
    """Intensity q (m^2/s^3) and factor s of the reported sigmas."""

    def cost(logarithms: Array) -> float:
        intensity, sigma_factor = np.exp(np.clip(logarithms, -40.0, 40.0))
        distrust = (np.log(sigma_factor) / np.log(_TRUST_IN_SIGMAS)) ** 2
        try:
            axes = zip(values.T, variances.T, strict=True)
            return float(distrust + sum(system.deviance(y, intensity, sigma_factor**2 * v) for y, v in axes))
        except LinAlgError:  # so extreme that rounding makes the matrix indefinite
            return float("inf")

    grid = [np.log([q, s]) for q in _INTENSITY_GRID for s in _SIGMA_GRID]
    best = min(grid, key=cost)
    found = minimize(cost, best, method="Nelder-Mead", options={"xatol": 0.01, "fatol": 0.01})
    intensity, sigma_factor = np.exp(np.clip(found.x, -40.0, 40.0))
    return float(intensity), float(sigma_factor)


@dataclass(frozen=True)
class _System:
    """The matrices Q (N, N-2) and R (N-2, N-2) of N times, by their diagonals."""

    left: Array  # (N-2,) Q[j, j] in columns counted from 0
    middle: Array  # (N-2,) Q[j + 1, j]
    right: Array  # (N-2,) Q[j + 2, j]
    gram: Array  # (3, N-2) R, lower banded form

    @staticmethod
    def of(times_s: Array) -> _System:
        steps_s = np.diff(times_s)
        left, right = 1.0 / steps_s[:-1], 1.0 / steps_s[1:]
        gram = np.zeros((3, len(left)))
        gram[0] = (steps_s[:-1] + steps_s[1:]) / 3.0
        gram[1, :-1] = steps_s[1:-1] / 6.0
        return _System(left, -left - right, right, gram)

    def differences(self, values: Array) -> Array:
        """Q^T y (N-2,)."""
        return self.left * values[:-2] + self.middle * values[1:-1] + self.right * values[2:]

    def transposed_differences(self, weights: Array) -> Array:
        """Q w (N,)."""
        values = np.zeros(len(weights) + 2)
        values[:-2] += self.left * weights
        values[1:-1] += self.middle * weights
        values[2:] += self.right * weights
        return values

    def covariance(self, intensity: float, noise: Array) -> Array:
        """Covariance of Q^T y in lower banded form (3, N-2), for noise variances (N,)."""
        first, second, third = noise[:-2], noise[1:-1], noise[2:]
        bands = intensity * self.gram
        bands[0] += self.left**2 * first + self.middle**2 * second + self.right**2 * third
        bands[1, :-1] += (self.middle * second)[:-1] * self.left[1:] + (self.right * third)[:-1] * self.middle[1:]
        bands[2, :-2] += (self.right * third)[:-2] * self.left[2:]
        return bands

    def deviance(self, values: Array, intensity: float, noise: Array) -> float:
        """-2 log of the restricted likelihood, up to a constant."""
        differences = self.differences(values)
        factor = cholesky_banded(self.covariance(intensity, noise), lower=True)
        squares = differences @ cho_solve_banded((factor, True), differences)
        return float(2.0 * np.log(factor[0]).sum() + squares)
