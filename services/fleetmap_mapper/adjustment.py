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

Array = NDArray[np.float64]

HUBER_PX = 2.4477  # sqrt of the 95 % point of chi-square with 2 degrees of freedom
_POSE_DOF, _POINT_DOF = 6, 3


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
    camera = problem.camera
    at_start = squared_errors(problem, problem.rotations, problem.translations, problem.points)
    # What starts behind its camera takes no part: a step that brought it to the front would look like progress.
    weights = np.where(np.isfinite(at_start), 1.0 / problem.sigmas_px, 0.0)
    starts = np.searchsorted(problem.point_index, np.arange(len(problem.points) + 1)).astype(np.int64)
    rotations, translations, points, cost = _levenberg_marquardt(
        np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]),
        np.ascontiguousarray(problem.rotations, dtype=np.float64),
        np.ascontiguousarray(problem.translations, dtype=np.float64),
        np.ascontiguousarray(problem.fixed),
        np.ascontiguousarray(problem.points, dtype=np.float64),
        np.ascontiguousarray(problem.keyframe_index, dtype=np.int64),
        starts,
        np.ascontiguousarray(problem.pixels, dtype=np.float64),
        weights,
        iterations,
    )
    rotations = nearest_rotations(rotations)
    chi2 = squared_errors(problem, rotations, translations, points)
    return Adjusted(rotations, translations, points, chi2, cost)


def squared_errors(problem: AdjustmentProblem, rotations: Array, translations: Array, points: Array) -> Array:
    """Squared normalised reprojection error of every observation (M,); inf behind the camera."""
    k, p = problem.keyframe_index, problem.point_index
    points_in_cam = np.einsum("mij,mj->mi", rotations[k], points[p]) + translations[k]
    errors = problem.camera.project_ideal(points_in_cam) - problem.pixels
    chi2 = (errors**2).sum(axis=1) / problem.sigmas_px**2
    return np.where(np.isfinite(chi2), chi2, np.inf)


@njit(cache=True, nogil=True)
def _levenberg_marquardt(  # type: ignore[no-untyped-def]
    intrinsics, rotations, translations, fixed, points, keyframe_index, starts, pixels, weights, iterations
):
    slots = np.full(len(fixed), -1, np.int64)  # place of each free pose in the reduced system
    free = 0
    for k in range(len(fixed)):
        if not fixed[k]:
            slots[k] = free
            free += 1
    damping = 1e-4
    cost = _cost(intrinsics, rotations, translations, points, keyframe_index, starts, pixels, weights)
    for _ in range(iterations):
        U, gp, V, gl, W = _normal_equations(
            intrinsics, rotations, translations, points, keyframe_index, starts, pixels, weights, slots, free
        )
        improved = False
        decrease = 0.0
        for _ in range(6):
            dp, dl = _solve(U, gp, V, gl, W, keyframe_index, starts, slots, free, damping)
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
            if z < 1e-6:
                total += 1e6  # a step that takes a point behind its camera is never an improvement
                continue
            du = (fx * x / z + cx - pixels[m, 0]) * weights[m]
            dv = (fy * y / z + cy - pixels[m, 1]) * weights[m]
            error = np.sqrt(du * du + dv * dv)
            total += 0.5 * error * error if error <= HUBER_PX else HUBER_PX * (error - 0.5 * HUBER_PX)
    return total


@njit(cache=True, nogil=True)
def _normal_equations(  # type: ignore[no-untyped-def]
    intrinsics, rotations, translations, points, keyframe_index, starts, pixels, weights, slots, free
):
    """Blocks of J^T W J and the gradients: poses U (F,6,6), gp; points V (P,3,3), gl; mixed W (M,6,3)."""
    fx, fy, cx, cy = intrinsics
    U, gp = np.zeros((free, 6, 6)), np.zeros((free, 6))
    V, gl = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    W = np.zeros((len(keyframe_index), 6, 3))
    Jp, Jl, r = np.zeros((2, 6)), np.zeros((2, 3)), np.zeros(2)
    for j in range(len(points)):
        for m in range(starts[j], starts[j + 1]):
            if weights[m] == 0.0:
                continue
            k = keyframe_index[m]
            R, t = rotations[k], translations[k]
            x = R[0, 0] * points[j, 0] + R[0, 1] * points[j, 1] + R[0, 2] * points[j, 2] + t[0]
            y = R[1, 0] * points[j, 0] + R[1, 1] * points[j, 1] + R[1, 2] * points[j, 2] + t[1]
            z = R[2, 0] * points[j, 0] + R[2, 1] * points[j, 1] + R[2, 2] * points[j, 2] + t[2]
            if z < 1e-6:
                continue
            r[0] = (fx * x / z + cx - pixels[m, 0]) * weights[m]
            r[1] = (fy * y / z + cy - pixels[m, 1]) * weights[m]
            error = np.sqrt(r[0] * r[0] + r[1] * r[1])
            root = weights[m] * (1.0 if error <= HUBER_PX else np.sqrt(HUBER_PX / error))
            for c in range(2):
                r[c] *= root / weights[m]
            a, b = fx / z * root, fy / z * root
            ax, by = -a * x / z, -b * y / z
            # d pixel / d point_in_cam = [[a, 0, ax], [0, b, by]]; left perturbation of cam_from_world
            Jp[0, 0], Jp[0, 1], Jp[0, 2] = ax * y, a * z - ax * x, -a * y
            Jp[0, 3], Jp[0, 4], Jp[0, 5] = a, 0.0, ax
            Jp[1, 0], Jp[1, 1], Jp[1, 2] = by * y - b * z, -by * x, b * x
            Jp[1, 3], Jp[1, 4], Jp[1, 5] = 0.0, b, by
            for c in range(3):
                Jl[0, c] = a * R[0, c] + ax * R[2, c]
                Jl[1, c] = b * R[1, c] + by * R[2, c]
            for c in range(3):
                gl[j, c] += Jl[0, c] * r[0] + Jl[1, c] * r[1]
                for d in range(3):
                    V[j, c, d] += Jl[0, c] * Jl[0, d] + Jl[1, c] * Jl[1, d]
            s = slots[k]
            if s < 0:
                continue
            for c in range(6):
                gp[s, c] += Jp[0, c] * r[0] + Jp[1, c] * r[1]
                for d in range(6):
                    U[s, c, d] += Jp[0, c] * Jp[0, d] + Jp[1, c] * Jp[1, d]
                for d in range(3):
                    W[m, c, d] = Jp[0, c] * Jl[0, d] + Jp[1, c] * Jl[1, d]
    return U, gp, V, gl, W


@njit(cache=True, nogil=True)
def _solve(U, gp, V, gl, W, keyframe_index, starts, slots, free, damping):  # type: ignore[no-untyped-def]
    """One damped step: poses from the reduced camera system, points by back-substitution."""
    S, b = np.zeros((6 * free, 6 * free)), np.zeros(6 * free)
    for s in range(free):
        for c in range(6):
            b[6 * s + c] = -gp[s, c]
            for d in range(6):
                S[6 * s + c, 6 * s + d] = U[s, c, d]
            S[6 * s + c, 6 * s + c] += damping * U[s, c, c] + 1e-9
    V_inv = np.zeros_like(V)
    Y = np.zeros((6, 3))
    for j in range(len(V)):
        V_inv[j] = _inverse_3x3(V[j], damping)
        for m in range(starts[j], starts[j + 1]):
            s = slots[keyframe_index[m]]
            if s < 0:
                continue
            for c in range(6):
                for d in range(3):
                    Y[c, d] = (
                        W[m, c, 0] * V_inv[j, 0, d] + W[m, c, 1] * V_inv[j, 1, d] + W[m, c, 2] * V_inv[j, 2, d]
                    )
                b[6 * s + c] += Y[c, 0] * gl[j, 0] + Y[c, 1] * gl[j, 1] + Y[c, 2] * gl[j, 2]
            for n in range(starts[j], starts[j + 1]):
                q = slots[keyframe_index[n]]
                if q < s:  # the upper triangle is enough
                    continue
                for c in range(6):
                    for d in range(6):
                        S[6 * s + c, 6 * q + d] -= (
                            Y[c, 0] * W[n, d, 0] + Y[c, 1] * W[n, d, 1] + Y[c, 2] * W[n, d, 2]
                        )
    for c in range(6 * free):
        for d in range(c):
            S[c, d] = S[d, c]
    dp = np.linalg.solve(S, b).reshape(free, 6) if free else np.zeros((0, 6))
    dl = np.zeros_like(gl)
    rhs = np.zeros(3)
    for j in range(len(V)):
        for d in range(3):
            rhs[d] = -gl[j, d]
        for m in range(starts[j], starts[j + 1]):
            s = slots[keyframe_index[m]]
            if s >= 0:
                for d in range(3):
                    for c in range(6):
                        rhs[d] -= W[m, c, d] * dp[s, c]
        for c in range(3):
            dl[j, c] = V_inv[j, c, 0] * rhs[0] + V_inv[j, c, 1] * rhs[1] + V_inv[j, c, 2] * rhs[2]
    return dp, dl


@njit(cache=True, nogil=True)
def _inverse_3x3(A, damping):  # type: ignore[no-untyped-def]
    d = 1.0 + damping
    a00, a11, a22 = A[0, 0] * d + 1e-12, A[1, 1] * d + 1e-12, A[2, 2] * d + 1e-12
    a01, a02, a12 = A[0, 1], A[0, 2], A[1, 2]
    c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
    determinant = a00 * c00 + a01 * c01 + a02 * c02
    inverse = np.empty((3, 3))
    inverse[0, 0], inverse[0, 1], inverse[0, 2] = c00, c01, c02
    inverse[1, 0], inverse[1, 1], inverse[1, 2] = c01, a00 * a22 - a02 * a02, a01 * a02 - a00 * a12
    inverse[2, 0], inverse[2, 1], inverse[2, 2] = c02, inverse[1, 2], a00 * a11 - a01 * a01
    return inverse / determinant


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
