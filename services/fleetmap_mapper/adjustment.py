"""Bundle adjustment over a window of keyframes: Levenberg-Marquardt on the Schur complement, compiled.

Minimises sum over observations of rho(|z_ij - pi(T_i, X_j)|^2 / sigma_ij^2) with Huber's rho, over the poses
that are free and all points. Points are eliminated block by block (Triggs et al., "Bundle adjustment - a
modern synthesis", 2000, section 6.1); the reduced camera system is dense and small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import nearest_rotations
from fleetmap_mapper.schur_complement import solve_damped

Array = NDArray[np.float64]

HUBER_PX = 2.4477  # sqrt of the 95 % point of chi-square with 2 degrees of freedom
_MIN_DEPTH = 1e-6


@dataclass(frozen=True)
class AdjustmentProblem:
    """What is seen from where. Observations are sorted by point."""

    camera: Camera
    rotations: Array  # (K, 3, 3) float64 cam_from_world
    translations: Array  # (K, 3) float64 cam_from_world
    fixed: NDArray[np.bool_]  # (K,) poses that stay
    points: Array  # (P, 3) float64 in world
    keyframe_index: NDArray[np.int32]  # (M,) int32
    point_index: NDArray[np.int32]  # (M,) int32, sorted
    pixels: Array  # (M, 2) float64 undistorted
    sigmas_px: Array  # (M,) float64


@dataclass(frozen=True)
class Adjusted:
    """The optimum, in the order of the problem."""

    rotations: Array  # (K, 3, 3) float64 cam_from_world
    translations: Array  # (K, 3) float64 cam_from_world
    points: Array  # (P, 3) float64
    chi2: Array  # (M,) squared normalised reprojection errors at the optimum; inf behind the camera
    cost: float  # half the sum of rho


def adjust(problem: AdjustmentProblem, iterations: int = 10) -> Adjusted:
    """Move the free poses and all points to the (local) optimum."""
    at_start = squared_errors(problem, problem.rotations, problem.translations, problem.points)
    # What starts behind its camera takes no part: a step that brought it to the front would look like progress.
    weights = np.where(np.isfinite(at_start), 1.0 / problem.sigmas_px, 0.0)
    starts = np.searchsorted(problem.point_index, np.arange(len(problem.points) + 1)).astype(np.int64)
    slots = np.where(problem.fixed, -1, np.cumsum(~problem.fixed) - 1)  # place among the free poses
    rotations, translations, points, cost = _levenberg_marquardt(
        _intrinsics(problem.camera),
        np.ascontiguousarray(problem.rotations, dtype=np.float64),
        np.ascontiguousarray(problem.translations, dtype=np.float64),
        slots,
        np.ascontiguousarray(problem.points, dtype=np.float64),
        np.ascontiguousarray(problem.keyframe_index, dtype=np.int64),
        starts,
        np.ascontiguousarray(problem.pixels, dtype=np.float64),
        weights,
        _empty_blocks(len(problem.pixels), len(problem.points), int(np.count_nonzero(slots >= 0))),
        iterations,
    )
    rotations = nearest_rotations(rotations)
    chi2 = squared_errors(problem, rotations, translations, points)
    return Adjusted(rotations, translations, points, chi2, cost)


def _empty_blocks(observations: int, points: int, poses: int) -> tuple[Array, ...]:
    """Room for J^T J and the gradients: poses U, gp; points V, gl; mixed W, transposed."""
    U, gp = np.zeros((poses, 6, 6)), np.zeros((poses, 6))
    V, gl = np.zeros((points, 3, 3)), np.zeros((points, 3))
    return U, gp, V, gl, np.empty((observations, 3, 6))


def squared_errors(problem: AdjustmentProblem, rotations: Array, translations: Array, points: Array) -> Array:
    """Squared normalised reprojection error of every observation (M,); inf behind the camera."""
    chi2: Array = _squared_errors(
        _intrinsics(problem.camera),
        np.ascontiguousarray(rotations, dtype=np.float64),
        np.ascontiguousarray(translations, dtype=np.float64),
        np.ascontiguousarray(points, dtype=np.float64),
        problem.keyframe_index,
        problem.point_index,
        problem.pixels,
        problem.sigmas_px,
    )
    return chi2


def _intrinsics(camera: Camera) -> tuple[float, float, float, float]:
    return camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px


@njit(cache=True, nogil=True, error_model="numpy")
def _squared_errors(intrinsics, rotations, translations, points, keyframe_index, point_index, pixels, sigmas):  # type: ignore[no-untyped-def]
    fx, fy, cx, cy = intrinsics
    chi2 = np.full(len(pixels), np.inf)
    for m in range(len(pixels)):
        k, j = keyframe_index[m], point_index[m]
        x, y, z = points[j, 0], points[j, 1], points[j, 2]
        depth = rotations[k, 2, 0] * x + rotations[k, 2, 1] * y + rotations[k, 2, 2] * z + translations[k, 2]
        if not depth > _MIN_DEPTH:
            continue
        across = rotations[k, 0, 0] * x + rotations[k, 0, 1] * y + rotations[k, 0, 2] * z + translations[k, 0]
        down = rotations[k, 1, 0] * x + rotations[k, 1, 1] * y + rotations[k, 1, 2] * z + translations[k, 1]
        du, dv = across / depth * fx + cx - pixels[m, 0], down / depth * fy + cy - pixels[m, 1]
        square = (du * du + dv * dv) / (sigmas[m] * sigmas[m])
        if np.isfinite(square):
            chi2[m] = square
    return chi2


@njit(cache=True, nogil=True)
def _levenberg_marquardt(  # type: ignore[no-untyped-def]
    intrinsics, rotations, translations, slots, points, keyframe_index, starts, pixels, weights, blocks, iterations
):
    damping = 1e-4
    cost = _cost(intrinsics, rotations, translations, points, keyframe_index, starts, pixels, weights)
    for _ in range(iterations):
        _fill_normal_equations(
            blocks, intrinsics, rotations, translations, points, keyframe_index, starts, pixels, weights, slots
        )
        improved = False
        decrease = 0.0
        for _ in range(6):
            dp, dl = solve_damped(blocks, keyframe_index, starts, slots, damping)
            new_rotations, new_translations = _moved(rotations, translations, slots, dp)
            new_points = points + dl
            new_cost = _cost(
                intrinsics, new_rotations, new_translations, new_points, keyframe_index, starts, pixels, weights
            )
            if new_cost < cost:
                decrease = cost - new_cost
                rotations, translations, points, cost = new_rotations, new_translations, new_points, new_cost
                damping = max(damping / 10.0, 1e-10)
                improved = True
                break
            damping *= 10.0
        if not improved or decrease < 1e-6 * cost:
            break
    return rotations, translations, points, cost


@njit(cache=True, nogil=True)
def _cost(intrinsics, rotations, translations, points, keyframe_index, starts, pixels, weights):  # type: ignore[no-untyped-def]
    fx, fy, cx, cy = intrinsics
    total = 0.0
    for j in range(len(points)):
        for m in range(starts[j], starts[j + 1]):
            if weights[m] == 0.0:
                continue
            R, t = rotations[keyframe_index[m]], translations[keyframe_index[m]]
            x = R[0, 0] * points[j, 0] + R[0, 1] * points[j, 1] + R[0, 2] * points[j, 2] + t[0]
            y = R[1, 0] * points[j, 0] + R[1, 1] * points[j, 1] + R[1, 2] * points[j, 2] + t[1]
            z = R[2, 0] * points[j, 0] + R[2, 1] * points[j, 1] + R[2, 2] * points[j, 2] + t[2]
            if z < _MIN_DEPTH:
                total += 1e6  # a step that takes a point behind its camera is never an improvement
                continue
            du = (fx * x / z + cx - pixels[m, 0]) * weights[m]
            dv = (fy * y / z + cy - pixels[m, 1]) * weights[m]
            error = np.sqrt(du * du + dv * dv)
            total += 0.5 * error * error if error <= HUBER_PX else HUBER_PX * (error - 0.5 * HUBER_PX)
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_normal_equations(  # type: ignore[no-untyped-def]
    blocks, intrinsics, rotations, translations, points, keyframe_index, starts, pixels, weights, slots
):
    U, gp, V, gl, W = blocks
    U[:], gp[:], V[:], gl[:] = 0.0, 0.0, 0.0, 0.0
    for j in range(len(points)):
        point = (points[j, 0], points[j, 1], points[j, 2])
        for m in range(starts[j], starts[j + 1]):
            k = keyframe_index[m]
            depth, ru, rv, u_by_pose, v_by_pose, u_by_point, v_by_point = _linearised(
                intrinsics, rotations[k], translations[k], point, (pixels[m, 0], pixels[m, 1]), weights[m]
            )
            if weights[m] == 0.0 or depth < _MIN_DEPTH:
                W[m] = 0.0
                continue
            for c in range(3):
                gl[j, c] += u_by_point[c] * ru + v_by_point[c] * rv
                for d in range(3):
                    V[j, c, d] += u_by_point[c] * u_by_point[d] + v_by_point[c] * v_by_point[d]
            s = slots[k]
            if s < 0:
                continue
            for c in range(6):
                gp[s, c] += u_by_pose[c] * ru + v_by_pose[c] * rv
                for d in range(6):
                    U[s, c, d] += u_by_pose[c] * u_by_pose[d] + v_by_pose[c] * v_by_pose[d]
                for d in range(3):
                    W[m, d, c] = u_by_pose[c] * u_by_point[d] + v_by_pose[c] * v_by_point[d]


@njit(cache=True, nogil=True, error_model="numpy")
def _linearised(intrinsics, R, t, point, pixel, weight):  # type: ignore[no-untyped-def]
    """Depth, residuals and Jacobians of one observation, weighted by its sigma and Huber's root.

    d pixel / d point_in_cam = [[a, 0, ax], [0, b, by]]; left perturbation of cam_from_world.
    """
    fx, fy, cx, cy = intrinsics
    x = R[0, 0] * point[0] + R[0, 1] * point[1] + R[0, 2] * point[2] + t[0]
    y = R[1, 0] * point[0] + R[1, 1] * point[1] + R[1, 2] * point[2] + t[1]
    z = R[2, 0] * point[0] + R[2, 1] * point[1] + R[2, 2] * point[2] + t[2]
    ru, rv = (fx * x / z + cx - pixel[0]) * weight, (fy * y / z + cy - pixel[1]) * weight
    error = np.sqrt(ru * ru + rv * rv)
    root = 1.0 if error <= HUBER_PX else np.sqrt(HUBER_PX / error)
    a, b = fx / z * (weight * root), fy / z * (weight * root)
    ax, by = -a * x / z, -b * y / z
    u_by_pose = (ax * y, a * z - ax * x, -a * y, a, 0.0, ax)
    v_by_pose = (by * y - b * z, -by * x, b * x, 0.0, b, by)
    u_by_point = (a * R[0, 0] + ax * R[2, 0], a * R[0, 1] + ax * R[2, 1], a * R[0, 2] + ax * R[2, 2])
    v_by_point = (b * R[1, 0] + by * R[2, 0], b * R[1, 1] + by * R[2, 1], b * R[1, 2] + by * R[2, 2])
    return z, root * ru, root * rv, u_by_pose, v_by_pose, u_by_point, v_by_point


@njit(cache=True, nogil=True)
def _moved(rotations, translations, slots, dp):  # type: ignore[no-untyped-def]
    """Poses after a left perturbation exp([rotation, translation]) to first order in the coupling."""
    new_rotations, new_translations = rotations.copy(), translations.copy()
    for k in range(len(slots)):
        s = slots[k]
        if s < 0:
            continue
        E = _rotation_of(dp[s, 0], dp[s, 1], dp[s, 2])
        new_rotations[k] = E @ rotations[k]
        new_translations[k] = E @ translations[k] + dp[s, 3:6]
    return new_rotations, new_translations


@njit(cache=True, nogil=True)
def _rotation_of(wx, wy, wz):  # type: ignore[no-untyped-def]
    """Rodrigues' formula."""
    angle = np.sqrt(wx * wx + wy * wy + wz * wz)
    a = 1.0 - angle * angle / 6.0 if angle < 1e-6 else np.sin(angle) / angle
    b = 0.5 - angle * angle / 24.0 if angle < 1e-6 else (1.0 - np.cos(angle)) / (angle * angle)
    K = np.array([[0.0, -wz, wy], [wz, 0.0, -wx], [-wy, wx, 0.0]])
    return np.eye(3) + a * K + b * (K @ K)
