"""How lenses bend the image, on normalised image coordinates (x / z, y / z).

===================== ============================ ===========================================================
model                 coefficients                 source
===================== ============================ ===========================================================
plumb_bob             k1 k2 p1 p2 k3               D. C. Brown, "Close-range camera calibration", 1971
rational_polynomial   k1 k2 p1 p2 k3 k4 k5 k6      D. Claus, A. Fitzgibbon, CVPR 2005; as in OpenCV
equidistant           k1 k2 k3 k4                  J. Kannala, S. Brandt, PAMI 2006, eq. 6; as in OpenCV fisheye
===================== ============================ ===========================================================

The names are those of sensor_msgs/CameraInfo. Every polynomial of a calibration turns back somewhere outside the
image it was fitted to: points beyond that have no pixel (NaN), or they would appear to lie in the image.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Coefficients = tuple[float, ...]
DistortionModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]

COEFFICIENT_COUNTS: dict[DistortionModel, int] = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}

_NEWTON_STEPS = 25
_NEWTON_TOLERANCE = 1e-13
_LARGEST_RESIDUAL = 1e-7  # normalised; a ten-thousandth of a pixel: what did not converge has no inverse
_STEEPEST_TAN = 30.0  # tan of 88 degrees off axis: no perspective camera images more
_WIDEST_RAD = np.pi
_POWERS = np.array([3.0, 2.0, 1.0])  # of r^2 in the radial polynomials, but for the constant


def is_distorting(model: DistortionModel, coefficients: Coefficients) -> bool:
    """Whether the model moves any point; an equidistant lens does with all coefficients zero too."""
    return model == "equidistant" or any(coefficients)


def distort(model: DistortionModel, coefficients: Coefficients, ideal: Array) -> Array:
    """Where a lens images normalised points (N, 2) of an ideal camera; NaN where it images nothing."""
    if model == "equidistant":
        return _distort_equidistant(coefficients, ideal)
    x, y = np.ascontiguousarray(ideal.T)
    distorted, _ = _brown_conrady(coefficients, x, y, with_derivatives=False)
    imaged = x * x + y * y < _turning_radius(coefficients) ** 2
    return np.where(imaged[:, None], np.stack(distorted, axis=1), np.nan)


def undistort(model: DistortionModel, coefficients: Coefficients, distorted: Array) -> Array:
    """The inverse of :func:`distort` for points (N, 2), by Newton's method; NaN where there is none.

    An equidistant lens also images points beside and behind the camera; those have no normalised coordinates.
    """
    if model == "equidistant":
        return _undistort_equidistant(coefficients, distorted)
    reach = _turning_radius(coefficients)
    x_seen, y_seen = np.ascontiguousarray(distorted.T)
    x, y = x_seen, y_seen
    for _ in range(_NEWTON_STEPS):
        (x_guess, y_guess), (xx, xy, yx, yy) = _brown_conrady(coefficients, x, y, with_derivatives=True)
        x_miss, y_miss = x_seen - x_guess, y_seen - y_guess
        with np.errstate(divide="ignore", invalid="ignore"):
            determinant = xx * yy - xy * yx
            x_step, y_step = yy * x_miss - xy * y_miss, xx * y_miss - yx * x_miss
            x, y = _within(x + x_step / determinant, y + y_step / determinant, reach)
        if max(_largest(x_miss), _largest(y_miss)) < _NEWTON_TOLERANCE:
            break
    (x_guess, y_guess), _ = _brown_conrady(coefficients, x, y, with_derivatives=False)
    found = (np.abs(x_seen - x_guess) <= _LARGEST_RESIDUAL) & (np.abs(y_seen - y_guess) <= _LARGEST_RESIDUAL)
    return np.where(found[:, None], np.stack([x, y], axis=1), np.nan)


def jacobian(model: DistortionModel, coefficients: Coefficients, ideal: Array) -> Array:
    """d distorted / d ideal (N, 2, 2) at normalised points (N, 2); means nothing where :func:`distort` is NaN."""
    if model == "equidistant":
        return _equidistant_jacobian(coefficients, ideal)
    _, (xx, xy, yx, yy) = _brown_conrady(coefficients, ideal[:, 0], ideal[:, 1], with_derivatives=True)
    return np.stack([np.stack([xx, xy], axis=1), np.stack([yx, yy], axis=1)], axis=1)


def coefficient_jacobian(model: DistortionModel, coefficients: Coefficients, ideal: Array) -> Array:
    """d distorted / d coefficients (N, 2, C) at normalised points (N, 2)."""
    if model == "equidistant":
        radius = np.linalg.norm(ideal, axis=1)
        theta = np.arctan(radius)
        with np.errstate(divide="ignore", invalid="ignore"):
            direction = np.where(radius[:, None] > 1e-12, ideal / radius[:, None], 0.0)
        return np.asarray(direction[:, :, None] * (theta[:, None] ** [3, 5, 7, 9])[:, None, :])
    numerator, denominator = _radial_polynomials(coefficients)
    x, y = ideal[:, 0], ideal[:, 1]
    r2 = x * x + y * y
    bottom = np.polyval(denominator, r2)
    powers = ideal[:, :, None] * (r2[:, None] ** [1, 2, 3] / bottom[:, None])[:, None, :]  # by k1, k2, k3
    by_p1 = np.stack([2.0 * x * y, r2 + 2.0 * y * y], axis=1)[:, :, None]
    by_p2 = np.stack([r2 + 2.0 * x * x, 2.0 * x * y], axis=1)[:, :, None]
    columns = [powers[:, :, :2], by_p1, by_p2, powers[:, :, 2:]]
    if len(coefficients) > COEFFICIENT_COUNTS["plumb_bob"]:
        columns.append(powers * -(np.polyval(numerator, r2) / bottom)[:, None, None])
    return np.concatenate(columns, axis=2)


def _largest(values: Array) -> float:
    """The largest absolute value, 0 of none; NaN does not count."""
    return float(np.fmax.reduce(np.abs(values), initial=0.0))


def _within(x: Array, y: Array, reach: float) -> tuple[Array, Array]:
    """Points pulled back to where the polynomial still grows: Newton's first step may overshoot."""
    radius = np.sqrt(x * x + y * y)
    if not np.any(radius > reach):
        return x, y
    shrink = np.where(radius > reach, reach / np.maximum(radius, 1e-300), 1.0)
    return x * shrink, y * shrink


def _brown_conrady(
    coefficients: Coefficients, x: Array, y: Array, *, with_derivatives: bool
) -> tuple[tuple[Array, Array], tuple[Array, Array, Array, Array]]:
    """Distorted points x' and y', and the Jacobian's entries dx'/dx, dx'/dy, dy'/dx, dy'/dy; each (N,)."""
    _, _, p1, p2, *_ = coefficients
    r2 = x * x + y * y
    radial, slope = _radial(coefficients, r2, with_derivatives=with_derivatives)
    distorted = (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )
    if not with_derivatives:
        return distorted, (x, x, x, x)
    mixed = 2.0 * (x * y * slope + p1 * x + p2 * y)
    xx = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    yy = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return distorted, (xx, mixed, mixed, yy)


def _radial(coefficients: Coefficients, r2: Array, *, with_derivatives: bool) -> tuple[Array, Array]:
    """The radial factor at r^2 and its slope there, each (N,)."""
    numerator, denominator = _radial_polynomials(coefficients)
    top = _polynomial(numerator, r2)
    slope = _polynomial(numerator[:-1] * _POWERS, r2) if with_derivatives else r2
    if not np.any(denominator[:-1]):
        return top, slope
    bottom = _polynomial(denominator, r2)
    radial = top / bottom
    if with_derivatives:
        slope = (slope - radial * _polynomial(denominator[:-1] * _POWERS, r2)) / bottom
    return radial, slope


def _polynomial(highest_first: Array, at: Array) -> Array:
    """Horner's rule; numpy.polyval with fewer passes."""
    value = np.asarray(highest_first[0] * at + highest_first[1])
    for coefficient in highest_first[2:]:
        value = value * at + coefficient
    return value


def _radial_polynomials(coefficients: Coefficients) -> tuple[Array, Array]:
    """Numerator and denominator of the radial factor, as polynomials in r^2, highest power first."""
    k1, k2, _, _, k3, *rest = coefficients
    k4, k5, k6 = rest or (0.0, 0.0, 0.0)
    return np.array([k3, k2, k1, 1.0]), np.array([k6, k5, k4, 1.0])


@lru_cache(maxsize=64)
def _turning_radius(coefficients: Coefficients) -> float:
    """The radius up to which r * radial(r^2) grows, at most tan 88 deg.

    With u = r^2 its slope has the sign of N D + 2 u (N' D - N D'), and nothing is imaged where D vanishes.
    """
    numerator, denominator = _radial_polynomials(coefficients)
    cross: Array = np.polysub(
        np.polymul(np.polyder(numerator), denominator), np.polymul(numerator, np.polyder(denominator))
    )
    slope = np.polyadd(np.polymul(numerator, denominator), np.polymul([2.0, 0.0], cross))
    roots = np.concatenate([np.roots(slope), np.roots(denominator)])
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
    return float(min(np.sqrt(real.min(initial=np.inf)), _STEEPEST_TAN))


def _distort_equidistant(coefficients: Coefficients, ideal: Array) -> Array:
    radius = np.linalg.norm(ideal, axis=1)
    theta = np.arctan(radius)
    theta_d = theta * np.polyval(_theta_polynomial(coefficients), theta * theta)
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.where(radius > 1e-12, theta_d / radius, 1.0)
    return np.where((theta < _turning_angle_rad(coefficients))[:, None], ideal * factor[:, None], np.nan)


def _equidistant_jacobian(coefficients: Coefficients, ideal: Array) -> Array:
    """Along the radius and across it the lens stretches differently: I t + n n^T (s - t)."""
    radius = np.linalg.norm(ideal, axis=1)
    theta = np.arctan(radius)
    square = theta * theta
    radial = np.polyval(_slope_polynomial(coefficients), square) / (1.0 + radius * radius)
    with np.errstate(divide="ignore", invalid="ignore"):
        across = np.where(
            radius > 1e-12, theta * np.polyval(_theta_polynomial(coefficients), square) / radius, 1.0
        )
        outwards = np.where(radius[:, None] > 1e-12, ideal / radius[:, None], 0.0)
    along = np.einsum("n,ni,nj->nij", radial - across, outwards, outwards)
    return np.asarray(across[:, None, None] * np.eye(2) + along)


def _undistort_equidistant(coefficients: Coefficients, distorted: Array) -> Array:
    theta_d = np.linalg.norm(distorted, axis=1)
    reach = _turning_angle_rad(coefficients)
    polynomial = _theta_polynomial(coefficients)
    theta = np.minimum(theta_d, reach)
    for _ in range(_NEWTON_STEPS):
        square = theta * theta
        miss = theta_d - theta * np.polyval(polynomial, square)
        slope = np.polyval(_slope_polynomial(coefficients), square)
        theta = np.clip(theta + miss / np.maximum(slope, 1e-6), 0.0, reach)
        if np.nanmax(np.abs(miss), initial=0.0) < _NEWTON_TOLERANCE:
            break
    miss = theta_d - theta * np.polyval(polynomial, theta * theta)
    found = (np.abs(miss) <= _LARGEST_RESIDUAL) & (theta < np.arctan(_STEEPEST_TAN))
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.where(theta_d > 1e-12, np.tan(theta) / theta_d, 1.0)
    return np.where(found[:, None], distorted * factor[:, None], np.nan)


def _theta_polynomial(coefficients: Coefficients) -> Array:
    k1, k2, k3, k4 = coefficients
    return np.array([k4, k3, k2, k1, 1.0])


def _slope_polynomial(coefficients: Coefficients) -> Array:
    """d(theta_d) / d(theta) as a polynomial in theta^2."""
    return np.asarray(_theta_polynomial(coefficients) * np.array([9.0, 7.0, 5.0, 3.0, 1.0]))


@lru_cache(maxsize=64)
def _turning_angle_rad(coefficients: Coefficients) -> float:
    """The angle off axis up to which the image radius grows, at most 180 degrees."""
    roots = np.roots(_slope_polynomial(coefficients))
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
    return float(min(np.sqrt(real.min(initial=np.inf)), _WIDEST_RAD))
