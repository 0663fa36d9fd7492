"""The pose of one camera from pixels of known points: LO-RANSAC from nothing, robust least squares from a guess.

OpenCV-style solvers answer ``cam_from_map``; it is inverted here and never leaves this file.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import poselib
from numba import njit
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, nearest_rotations

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

CHI2_95_2DOF = 5.991
_MIN_DEPTH = 1e-3  # in the map's unit, which need not be the metre while a map is being made
_KERNEL_SCALES = np.array([16.0, 4.0, 1.0, 1.0, np.inf])  # of Cauchy's kernel, one per round; inf = plain squares
_STEPS_PER_ROUND = 10
_ROUND_OF_SPREAD = 1  # after this round, near the truth but not yet gated hard, the residuals' spread is taken
_MEDIAN_2DOF = 1.386  # of chi2 with two degrees of freedom
_MAX_SPREAD = 3.0


@dataclass(frozen=True)
class AbsolutePoseSettings:
    """When a pose is believed at all; callers with more context gate harder."""

    min_inliers: int = 10
    ransac_error_px: float = 5.0  # wide enough for coarse octaves; the refinement weighs each by its sigma
    ransac_max_iterations: int = 2000
    seed: int = 0


@dataclass(frozen=True)
class AbsolutePose:
    """A camera pose and what supports it."""

    map_from_cam: Pose
    inliers: BoolArray  # (N,) bool, of the given points
    # (6, 6) float64 of the tangent [rotation (rad), translation (m)] in the camera's frame: the true pose is
    # map_from_cam @ exp(xi), xi ~ N(0, covariance). Scaled by the residuals' own variance where that exceeds 1.
    covariance: Array

    @property
    def inlier_count(self) -> int:
        """Number of points that agree with the pose."""
        return int(np.count_nonzero(self.inliers))


def estimate_absolute_pose(
    pixels: Array,
    points_m: Array,
    sigmas_px: Array,
    camera: Camera,
    settings: AbsolutePoseSettings | None = None,
) -> AbsolutePose | None:
    """The pose that most of the points agree with, from nothing; None where too few agree.

    Args:
        pixels: (N, 2) undistorted; points_m: (N, 3) in map; sigmas_px: (N,) of the pixels.
        camera: whose K the pixels belong to.
        settings: see there.

    Source: Lebeda, Matas, Chum, "Fixing the locally optimized RANSAC", BMVC 2012, as PoseLib implements it.
    """
    settings = settings or AbsolutePoseSettings()
    if len(pixels) < max(settings.min_inliers, 4):
        return None
    centre = points_m.mean(axis=0)  # small numbers, wherever the map's anchor is
    camera_dict = {
        "model": "PINHOLE",
        "width": camera.width_px,
        "height": camera.height_px,
        "params": [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px],
    }
    ransac = {
        "max_reproj_error": settings.ransac_error_px,
        "max_iterations": settings.ransac_max_iterations,
        "min_iterations": min(100, settings.ransac_max_iterations),
        "seed": settings.seed,
    }
    cam_from_centred, report = poselib.estimate_absolute_pose(
        np.ascontiguousarray(pixels), np.ascontiguousarray(points_m - centre), camera_dict, ransac, {}
    )
    if report["num_inliers"] < settings.min_inliers:
        return None
    centred_from_cam = Pose(np.array(cam_from_centred.R), np.array(cam_from_centred.t)).inverse()
    initial = Pose(centred_from_cam.rotation, centred_from_cam.translation_m + centre)
    return refine_absolute_pose(pixels, points_m, sigmas_px, camera, initial, settings)


def refine_absolute_pose(
    pixels: Array,
    points_m: Array,
    sigmas_px: Array,
    camera: Camera,
    map_from_cam_initial: Pose,
    settings: AbsolutePoseSettings | None = None,
) -> AbsolutePose | None:
    """The least-squares pose near a guess, outliers told apart on the way; None where too few points agree.

    Levenberg-Marquardt with Cauchy's kernel, wide at first and narrower every round. After each round a point is
    an outlier when it lies behind the camera, or when its error exceeds the round's width, which ends at the
    95 % quantile of chi2 (5.99). Where the median residual says that the given sigmas are too small, they are
    enlarged for the last rounds, at most threefold. The last round is plain least squares over the inliers.
    Arguments as in estimate_absolute_pose.
    """
    settings = settings or AbsolutePoseSettings()
    if len(pixels) < max(settings.min_inliers, 4):
        return None
    rotation, centre, inliers, information, squares = _refine(
        np.ascontiguousarray(map_from_cam_initial.rotation, dtype=np.float64),
        np.ascontiguousarray(map_from_cam_initial.translation_m, dtype=np.float64),
        np.ascontiguousarray(pixels, dtype=np.float64),
        np.ascontiguousarray(points_m, dtype=np.float64),
        1.0 / np.asarray(sigmas_px, dtype=np.float64),
        np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]),
        _KERNEL_SCALES,
    )
    count = int(np.count_nonzero(inliers))
    if count < max(settings.min_inliers, 4):
        return None
    covariance = _inverse(information)
    if covariance is None:
        return None
    variance = squares / (2 * count - 6)
    # Steps multiply rotations, and a tracker hands the result on: without this, rounding errors pile up.
    return AbsolutePose(Pose(nearest_rotations(rotation), centre), inliers, covariance * max(1.0, variance))


def _inverse(information: Array) -> Array | None:
    """None where the points do not fix all six degrees of freedom."""
    scale = np.sqrt(np.diag(information))
    if not np.all(np.isfinite(information)) or np.any(scale <= 0.0):
        return None
    balanced = information / np.outer(scale, scale)
    if np.linalg.cond(balanced) > 1e12:
        return None
    return np.asarray(np.linalg.inv(balanced) / np.outer(scale, scale))


@njit(cache=True, nogil=True)
def _refine(rotation, centre, pixels, points, inverse_sigmas, intrinsics, kernel_scales):  # type: ignore[no-untyped-def]
    inliers = np.ones(len(points), np.bool_)
    information, gradient = np.zeros((6, 6)), np.zeros(6)
    squares = 0.0
    for number, scale in enumerate(kernel_scales):
        damping = 1e-6
        cost, squares = _linearise(
            rotation, centre, pixels, points, inverse_sigmas, intrinsics, inliers, scale, information, gradient
        )
        for _ in range(_STEPS_PER_ROUND):
            step = _damped_step(information, gradient, damping)
            new_rotation = rotation @ _exp(step[:3])
            new_centre = centre + rotation @ step[3:]
            new_information, new_gradient = np.zeros((6, 6)), np.zeros(6)
            new_cost, new_squares = _linearise(
                new_rotation,
                new_centre,
                pixels,
                points,
                inverse_sigmas,
                intrinsics,
                inliers,
                scale,
                new_information,
                new_gradient,
            )
            if not new_cost < cost:
                damping *= 10.0
                if damping > 1e3 or new_cost == cost:
                    break
                continue
            gain = cost - new_cost
            rotation, centre, cost, squares = new_rotation, new_centre, new_cost, new_squares
            information, gradient = new_information, new_gradient
            damping = max(damping * 0.1, 1e-9)
            if gain < 1e-6 * cost:
                break
        if np.isfinite(scale):
            errors = _squared_errors(rotation, centre, pixels, points, inverse_sigmas, intrinsics)
            inliers = errors <= CHI2_95_2DOF * scale * scale
            if number == _ROUND_OF_SPREAD and np.any(inliers):
                spread = np.sqrt(np.median(errors[inliers]) / _MEDIAN_2DOF)
                inverse_sigmas = inverse_sigmas / min(max(spread, 1.0), _MAX_SPREAD)
    return rotation, centre, inliers, information, squares


@njit(cache=True, nogil=True)
def _linearise(  # type: ignore[no-untyped-def]
    rotation, centre, pixels, points, inverse_sigmas, intrinsics, inliers, kernel_scale, information, gradient
):
    """Fill J^T W J (6, 6) and J^T W r (6,) over the inliers; returns the robust cost and the plain sum of squares.

    A right perturbation moves a point in the camera by p + p x w - t. A point behind the camera costs as much
    as one that lies at 95 % of chi2, so that no step gains by pushing points behind.
    """
    information[:] = 0.0
    gradient[:] = 0.0
    fx, fy, cx, cy = intrinsics
    kernel = CHI2_95_2DOF * kernel_scale * kernel_scale
    J = np.empty((2, 6))
    cost, squares = 0.0, 0.0
    for n in range(len(points)):
        if not inliers[n]:
            continue
        dx, dy, dz = points[n, 0] - centre[0], points[n, 1] - centre[1], points[n, 2] - centre[2]
        x = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
        y = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
        z = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
        if z < _MIN_DEPTH:
            cost += 4.0 * CHI2_95_2DOF * min(kernel_scale * kernel_scale, 1e6)
            continue
        u, v, w = x / z, y / z, inverse_sigmas[n]
        ru, rv = (fx * u + cx - pixels[n, 0]) * w, (fy * v + cy - pixels[n, 1]) * w
        square = ru * ru + rv * rv
        squares += square
        weight = 1.0
        if np.isfinite(kernel):
            weight = 1.0 / (1.0 + square / kernel)
            cost += kernel * np.log1p(square / kernel)
        else:
            cost += square
        gx, gy = fx * w, fy * w
        J[0, 0], J[0, 1], J[0, 2] = gx * u * v, -gx * (1.0 + u * u), gx * v
        J[0, 3], J[0, 4], J[0, 5] = -gx / z, 0.0, gx * u / z
        J[1, 0], J[1, 1], J[1, 2] = gy * (1.0 + v * v), -gy * u * v, -gy * u
        J[1, 3], J[1, 4], J[1, 5] = 0.0, -gy / z, gy * v / z
        for i in range(6):
            gradient[i] += weight * (J[0, i] * ru + J[1, i] * rv)
            for j in range(i + 1):
                information[i, j] += weight * (J[0, i] * J[0, j] + J[1, i] * J[1, j])
    for i in range(6):
        for j in range(i):
            information[j, i] = information[i, j]
    return cost, squares


@njit(cache=True, nogil=True)
def _squared_errors(rotation, centre, pixels, points, inverse_sigmas, intrinsics):  # type: ignore[no-untyped-def]
    """In sigmas, (N,); infinite behind the camera."""
    fx, fy, cx, cy = intrinsics
    errors = np.full(len(points), np.inf)
    for n in range(len(points)):
        dx, dy, dz = points[n, 0] - centre[0], points[n, 1] - centre[1], points[n, 2] - centre[2]
        z = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
        if z >= _MIN_DEPTH:
            x = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
            y = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
            ru = (fx * x / z + cx - pixels[n, 0]) * inverse_sigmas[n]
            rv = (fy * y / z + cy - pixels[n, 1]) * inverse_sigmas[n]
            errors[n] = ru * ru + rv * rv
    return errors


@njit(cache=True, nogil=True)
def _damped_step(information, gradient, damping):  # type: ignore[no-untyped-def]
    """Solve (H + damping diag(H)) x = -g by Cholesky; zero where H is not positive definite."""
    L = np.zeros((6, 6))
    for i in range(6):
        for j in range(i + 1):
            value = information[i, j]
            if i == j:
                value *= 1.0 + damping
            for k in range(j):
                value -= L[i, k] * L[j, k]
            if i == j:
                if not value > 0.0:
                    return np.zeros(6)
                L[i, i] = np.sqrt(value)
            else:
                L[i, j] = value / L[j, j]
    x = np.empty(6)
    for i in range(6):
        value = -gradient[i]
        for k in range(i):
            value -= L[i, k] * x[k]
        x[i] = value / L[i, i]
    for i in range(5, -1, -1):
        value = x[i]
        for k in range(i + 1, 6):
            value -= L[k, i] * x[k]
        x[i] = value / L[i, i]
    return x


@njit(cache=True, nogil=True)
def _exp(w):  # type: ignore[no-untyped-def]
    """Rodrigues' formula."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    angle = np.sqrt(angle2)
    if angle < 1e-5:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    K = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    return np.eye(3) + a * K + b * (K @ K)
