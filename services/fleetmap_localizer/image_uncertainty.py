"""How well an image holds a pose: the covariance of the fit, relative to the map.

Landmarks are not independent witnesses. Each match errs by itself (white noise of the corner, and the landmark's
own error as far as the map tells it), but neighbouring ones also err together: they were mapped from the same
keyframes, and what lens and calibration leave is smooth over the image. So the residuals have the covariance

    V = s_w diag(sigma_i^2) + s_c K + L

with K an exponentially correlated error field over the image, one value for all landmarks of a cell of a coarse
grid, and L the landmarks' covariances projected into the image. The two variance components are estimated from the
residuals of each image, by equating the two quadratic forms r'Wr and r'W K W r with their expectations. What is
smooth over the image a pose absorbs, and few residuals tell little of it: to s_c its own standard error is added.
The pose stays the least-squares one, and its covariance is A^-1 J'W V WJ A^-1 with A = J'WJ, not A^-1.

Sources: C. R. Rao, "Estimation of variance and covariance components - MINQUE theory", J. Multivariate Analysis 1,
1971; for least squares under correlated errors, H. White, "A heteroskedasticity-consistent covariance matrix
estimator", Econometrica 48, 1980, here with the modelled V in place of the residuals' squares.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.vision.absolute_pose import CHI2_95_2DOF
from fleetmap.visual_map import Landmarks
from fleetmap_localizer.gate import Fit

Array = NDArray[np.float64]

_COLUMNS, _ROWS = 8, 4
_CORRELATION_LENGTH = 0.3  # of the common error, in image widths
_LEAST_WHITE = 0.05  # s_w is at least this: no corner is known better than to a fifth of its octave's pixel


@dataclass(frozen=True)
class _Linearised:
    """Inliers (N,) at the fitted pose, all in units of their sigmas."""

    cells: NDArray[np.int64]  # (N,) of the grid over the image
    weights: Array  # (N,) 1 / sigma
    residuals: Array  # (N, 2)
    J: Array  # (N, 2, 6) by the tangent [rotation (rad), translation (m)] in the camera's frame
    L: Array  # (N, 2, 2) covariance that the landmark's own error has in the image

    def kept_covariance(self) -> Array:
        """What of L (N, 2, 2) shows in the residuals of inliers, among which there are no large ones."""
        x = CHI2_95_2DOF / np.clip(np.einsum("naa->n", self.L), 0.1, None)
        return np.asarray(self.L * (1.0 - x / np.expm1(x))[:, None, None])


@dataclass(frozen=True)
class _CellSums:
    """What the inliers of each cell C sum up to; x and y of a cell's common error stand one after the other."""

    G: Array  # (2 C, 6) Z'X
    residuals: Array  # (2 C,) Z'r
    ZZ: Array  # (2 C,) the diagonal of Z'Z
    ZLZ: Array  # (2 C, 2 C) Z'L Z
    ZLX: Array  # (2 C, 6) Z'L X
    XLX: Array  # (6, 6) X'L X
    own: float  # tr L


def relative_covariance(fit: Fit, landmarks: Landmarks, camera: Camera) -> Array:
    """Covariance (6, 6) of a fitted pose's tangent [rotation (rad), translation (m)], the map taken as true."""
    seen = _linearise(fit, landmarks, camera)
    X = seen.J.reshape(-1, 6)
    A = X.T @ X
    A_inverse = np.asarray(np.linalg.inv(A), dtype=np.float64)
    sums, K = _sum_in_cells(seen), _correlations(camera)
    white, common = _variance_components(seen, sums, K, A_inverse)
    meat = white * A + common * sums.G.T @ K @ sums.G + np.einsum("nai,nab,nbj->ij", seen.J, seen.L, seen.J)
    covariance = A_inverse @ meat @ A_inverse
    return np.asarray((covariance + covariance.T) / 2.0)


def _variance_components(seen: _Linearised, sums: _CellSums, K: Array, A_inverse: Array) -> tuple[float, float]:
    """(s_w, s_c): with M = I - X A^-1 X', residuals have E[r'M Q M r] = tr(M Q M V); Q = I first, then Z K Z'."""
    P = A_inverse @ sums.G.T
    ZMZ = np.diag(sums.ZZ) - sums.G @ P
    cross = sums.ZLX @ P
    ZMLMZ = sums.ZLZ - cross - cross.T + P.T @ sums.XLX @ P
    KZMZ = K @ ZMZ
    by_white, by_common = np.trace(KZMZ), float(np.einsum("ij,ji->", KZMZ, KZMZ))
    freedom = 2.0 * len(seen.residuals) - 6.0
    own = sums.own - float(np.einsum("ij,ji->", A_inverse, sums.XLX))
    squares = float((seen.residuals**2).sum()) - own
    correlated = float(sums.residuals @ K @ sums.residuals) - float(np.einsum("ij,ji->", K, ZMLMZ))
    T = np.array([[freedom, by_white], [by_white, by_common]])
    white, common = np.linalg.solve(T, [squares, correlated]).tolist()
    if white < _LEAST_WHITE:
        white, common = _LEAST_WHITE, (correlated - by_white * _LEAST_WHITE) / by_common
    if common < 0.0:
        white = max(squares / freedom, _LEAST_WHITE)
    spread = white * KZMZ + max(common, 0.0) * KZMZ @ KZMZ  # var(q) = 2 tr(spread^2) of the second quadratic form
    doubt = np.linalg.inv(T)[1, 1] * np.sqrt(2.0 * np.einsum("ij,ji->", spread, spread))
    return white, max(common + float(doubt), 0.0)


def _linearise(fit: Fit, landmarks: Landmarks, camera: Camera) -> _Linearised:
    inliers, pose = fit.answer.inliers, fit.answer.map_from_cam
    rows, pixels, sigmas_px = fit.landmarks[inliers], fit.matched_px[inliers], fit.matched_sigmas_px[inliers]
    points = pose.inverse().transform(landmarks.points_m[rows])
    z, f = points[:, 2], np.array([camera.fx_px, camera.fy_px])
    u, v = points[:, 0] / z, points[:, 1] / z
    J = np.zeros((len(rows), 2, 6))
    J[:, 0] = np.stack([u * v, -(1.0 + u * u), v, -1.0 / z, 0.0 * z, u / z], axis=1)
    J[:, 1] = np.stack([1.0 + v * v, -u * v, -u, 0.0 * z, -1.0 / z, v / z], axis=1)
    J *= (f / sigmas_px[:, None])[:, :, None]
    L = np.zeros((len(rows), 2, 2))
    if landmarks.sigmas_m is not None:
        # C = across^2 I + (along^2 - across^2) n n': a point that moves is a camera that moves the other way.
        normals = landmarks.normals[rows].astype(np.float64) @ pose.rotation
        across, along = (landmarks.sigmas_m[rows].astype(np.float64) ** 2).T
        by_point = J[:, :, 3:]
        towards = np.einsum("nai,ni->na", by_point, normals)
        L = across[:, None, None] * by_point @ by_point.transpose(0, 2, 1)
        L += (along - across)[:, None, None] * towards[:, :, None] * towards[:, None, :]
    predicted = camera.project_ideal(points)
    return _Linearised(_cells(pixels, camera), 1.0 / sigmas_px, (predicted - pixels) / sigmas_px[:, None], J, L)


def _sum_in_cells(seen: _Linearised) -> _CellSums:
    count, cells = len(seen.weights), _COLUMNS * _ROWS
    Z = np.zeros((cells, count))
    Z[seen.cells, np.arange(count)] = seen.weights
    L = seen.kept_covariance()
    LJ = L @ seen.J
    ZLZ = np.zeros((cells, 2, cells, 2))
    ZLZ[np.arange(cells), :, np.arange(cells), :] = ((Z * Z) @ L.reshape(count, 4)).reshape(cells, 2, 2)
    return _CellSums(
        (Z @ seen.J.reshape(count, 12)).reshape(-1, 6),
        (Z @ seen.residuals).reshape(-1),
        np.repeat((Z * Z).sum(axis=1), 2),
        ZLZ.reshape(2 * cells, 2 * cells),
        (Z @ LJ.reshape(count, 12)).reshape(-1, 6),
        np.einsum("nai,naj->ij", seen.J, LJ),
        float(np.einsum("naa->", L)),
    )


def _correlations(camera: Camera) -> Array:
    """K (2 C, 2 C) between the cells' common errors; x and y are independent."""
    number = np.arange(_COLUMNS * _ROWS)
    x, y = number % _COLUMNS / _COLUMNS, number // _COLUMNS / _ROWS * camera.height_px / camera.width_px
    away = np.hypot(x[:, None] - x, y[:, None] - y)
    return np.asarray(np.kron(np.exp(-away / _CORRELATION_LENGTH), np.eye(2)))


def _cells(pixels: Array, camera: Camera) -> NDArray[np.int64]:
    column = np.clip(pixels[:, 0] * _COLUMNS / camera.width_px, 0, _COLUMNS - 1).astype(np.int64)
    row = np.clip(pixels[:, 1] * _ROWS / camera.height_px, 0, _ROWS - 1).astype(np.int64)
    return np.asarray(row * _COLUMNS + column)
