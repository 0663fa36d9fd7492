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


def is_distorting(model: DistortionModel, coefficients: Coefficients) -> bool:
    """Whether the model moves any point; an equidistant lens does with all coefficients zero too."""
    return model == "equidistant" or any(coefficients)


def distort(model: DistortionModel, coefficients: Coefficients, ideal: Array) -> Array:
    """Where a lens images normalised points (N, 2) of an ideal camera; NaN where it images nothing."""
    if model == "equidistant":
        return _distort_equidistant(coefficients, ideal)
    r2 = np.einsum("ni,ni->n", ideal, ideal)
    distorted, _ = _brown_conrady(coefficients, ideal, with_derivatives=False)
    return np.where((r2 < _turning_radius(coefficients) ** 2)[:, None], distorted, np.nan)


def undistort(model: DistortionModel, coefficients: Coefficients, distorted: Array) -> Array:
    """The inverse of :func:`distort` for points (N, 2), by Newton's method; NaN where there is none.

    An equidistant lens also images points beside and behind the camera; those have no normalised coordinates.
    """
    if model == "equidistant":
        return _undistort_equidistant(coefficients, distorted)
    ideal = distorted.copy()
    reach = _turning_radius(coefficients)
    for _ in range(_NEWTON_STEPS):
        guess, (xx, xy, yx, yy) = _brown_conrady(coefficients, ideal, with_derivatives=True)
        miss = distorted - guess
        determinant = xx * yy - xy * yx
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.stack([yy * miss[:, 0] - xy * miss[:, 1], xx * miss[:, 1] - yx * miss[:, 0]], axis=1)
            ideal = _within(ideal + step / determinant[:, None], reach)
        if np.nanmax(np.abs(miss), initial=0.0) < _NEWTON_TOLERANCE:
            break
    miss = distorted - _brown_conrady(coefficients, ideal, with_derivatives=False)[0]
    found = np.all(np.abs(miss) <= _LARGEST_RESIDUAL, axis=1)
    return np.where(found[:, None], ideal, np.nan)


def jacobian(model: DistortionModel, coefficients: Coefficients, ideal: Array) -> Array:
    """d distorted / d ideal (N, 2, 2) at normalised points (N, 2); means nothing where :func:`distort` is NaN."""
    if model == "equidistant":
        return _equidistant_jacobian(coefficients, ideal)
    _, (xx, xy, yx, yy) = _brown_conrady(coefficients, ideal, with_derivatives=True)
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


def _within(points: Array, reach: float) -> Array:
    """Points (N, 2) pulled back to where the polynomial still grows: Newton's first step may overshoot."""
    radius = np.linalg.norm(points, axis=1, keepdims=True)
    return np.where(radius > reach, points * (reach / np.maximum(radius, 1e-300)), points)


def _brown_conrady(
    coefficients: Coefficients, ideal: Array, *, with_derivatives: bool
) -> tuple[Array, tuple[Array, Array, Array, Array]]:
    """Distorted points (N, 2) and the Jacobian's entries dx'/dx, dx'/dy, dy'/dx, dy'/dy, each (N,)."""
    _, _, p1, p2, *_ = coefficients
    numerator, denominator = _radial_polynomials(coefficients)
    x, y = ideal[:, 0], ideal[:, 1]
    r2 = x * x + y * y
    top, bottom = np.polyval(numerator, r2), np.polyval(denominator, r2)
    radial = top / bottom
    distorted = np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=1,
    )
    if not with_derivatives:
        return distorted, (x, x, x, x)
    slope = (np.polyval(np.polyder(numerator), r2) - radial * np.polyval(np.polyder(denominator), r2)) / bottom
    mixed = 2.0 * (x * y * slope + p1 * x + p2 * y)
    xx = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    yy = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return distorted, (xx, mixed, mixed, yy)


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
