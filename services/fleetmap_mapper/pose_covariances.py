"""How well the final graph determines each keyframe: the covariance of its pose, exact for the linearised UGBA.

Landmarks are eliminated one by one, each leaving its share in the reduced camera system (Triggs et al., "Bundle
adjustment - a modern synthesis", 2000, section 6.1), robust costs with the weights that they have at the optimum.
Keyframes far apart see nothing in common, so the system is block tridiagonal once they are ordered, and only the
diagonal blocks of its inverse are computed.

The tangent is GTSAM's: the true pose is ``map_from_cam @ exp([rotation (rad), translation (m)])``. What all fixes
err by together, such as the slow bias of one receiver, is in no covariance: one drive cannot see it.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import gtsam
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import csr_array

from fleetmap_mapper.adjustment import HUBER_PX
from fleetmap_mapper.block_tridiagonal import Levels, diagonal_of_inverse, levels_of
from fleetmap_mapper.global_adjustment import GlobalProblem, graph_without_images

Array = NDArray[np.float64]
_UNDETERMINED_M = 300.0  # a sigma beyond is no knowledge of a place
_WEAK_INFORMATION = [1e-2] * 3 + [1e-6] * 3  # 10 rad, 1 km


@dataclass(frozen=True)
class _Term:
    """What something other than an image says of some keyframes: J^T J over their tangents in a row."""

    keyframes: list[int]
    information: Array  # (6 n, 6 n)


def pose_covariances(problem: GlobalProblem) -> Array:
    """Covariances (K, 6, 6) float64 of the keyframes of a problem that stands at its optimum.

    NaN for keyframes that nothing ties to any fix.
    """
    terms = _terms_beside_images(problem)
    levels = levels_of(_neighbours(problem, terms))
    diagonal, lower = _reduced_camera_system(problem, levels)
    for term in terms:
        _add_term(term, levels, diagonal, lower)
    inverse = [np.full_like(block, np.nan) for block in diagonal]
    has_fix = np.zeros(len(levels.sizes), np.bool_)
    has_fix[levels.level_of[[fix.keyframe for fix in problem.fixes]]] = True
    for component in levels.components():
        if has_fix[component.start : component.stop].any():
            inverse[component.start : component.stop] = _inverse_blocks(
                [diagonal[i] for i in component], [lower[i] for i in component[:-1]]
            )
    covariances = np.array(
        [inverse[level][rows, rows] for level, rows in (_place(k, levels) for k in range(len(problem.poses)))]
    )
    sigmas_m = np.sqrt(covariances[:, [3, 4, 5], [3, 4, 5]])
    covariances[~(sigmas_m.max(axis=1) < _UNDETERMINED_M)] = np.nan
    return covariances


def _inverse_blocks(diagonal: list[Array], lower: list[Array]) -> list[Array]:
    """Of a component; where a keyframe hangs on too few landmarks, a prior too weak to matter elsewhere helps."""
    try:
        return diagonal_of_inverse(diagonal, lower)
    except np.linalg.LinAlgError:
        weak = [block + np.diag(np.tile(_WEAK_INFORMATION, len(block) // 6)) for block in diagonal]
    with suppress(np.linalg.LinAlgError):
        return diagonal_of_inverse(weak, lower)
    return [np.full_like(block, np.nan) for block in diagonal]


def _terms_beside_images(problem: GlobalProblem) -> list[_Term]:
    graph, values = graph_without_images(problem)
    linear = graph.linearize(values)
    factors = [linear.at(i) for i in range(linear.size())]
    return [_Term([gtsam.Symbol(key).index() for key in list(f.keys())], f.information()) for f in factors]


def _neighbours(problem: GlobalProblem, terms: Sequence[_Term]) -> csr_array:
    """Which keyframes (K, K) see a landmark in common, or have a term in common."""
    points = len(problem.points_m)
    rows = np.concatenate([problem.keyframe_index, *(term.keyframes for term in terms)]).astype(np.int64)
    of_terms = [np.full(len(term.keyframes), points + i) for i, term in enumerate(terms)]
    columns = np.concatenate([problem.point_index, *of_terms]).astype(np.int64)
    shape = len(problem.poses), points + len(terms)
    sees = csr_array((np.ones(len(rows), np.int32), (rows, columns)), shape=shape)
    return csr_array(sees @ sees.T)


def _add_term(term: _Term, levels: Levels, diagonal: Sequence[Array], lower: Sequence[Array]) -> None:
    for m, keyframe in enumerate(term.keyframes):
        level, columns = _place(keyframe, levels)
        for n, other in enumerate(term.keyframes):
            other_level, rows = _place(other, levels)
            share = term.information[6 * n : 6 * n + 6, 6 * m : 6 * m + 6]
            if other_level == level:
                diagonal[level][rows, columns] += share
            elif other_level == level + 1:
                lower[level][rows, columns] += share


def _place(keyframe: int, levels: Levels) -> tuple[int, slice]:
    """The level of a keyframe and its rows there."""
    first = 6 * int(levels.place_of[keyframe])
    return int(levels.level_of[keyframe]), slice(first, first + 6)


def _reduced_camera_system(problem: GlobalProblem, levels: Levels) -> tuple[list[Array], list[Array]]:
    """Diagonal blocks and those below, of the images alone; of the diagonal blocks only the lower triangles."""
    order = np.argsort(problem.point_index, kind="stable")
    starts = np.searchsorted(problem.point_index[order], np.arange(len(problem.points_m) + 1))
    widths = 6 * levels.sizes
    diagonal_at = np.concatenate([[0], np.cumsum(widths**2)])
    lower_at = np.concatenate([[0], np.cumsum(widths[1:] * widths[:-1])])
    diagonal, lower = np.zeros(diagonal_at[-1]), np.zeros(lower_at[-1])
    camera = problem.camera
    _eliminate_points(
        (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px),
        np.array([pose.rotation.T for pose in problem.poses]),
        np.array([pose.translation_m for pose in problem.poses]),
        np.ascontiguousarray(problem.points_m),
        problem.keyframe_index[order].astype(np.int64),
        starts.astype(np.int64),
        problem.pixels[order].astype(np.float64),
        1.0 / problem.sigmas_px[order],
        (levels.level_of, levels.place_of, widths),
        (diagonal, diagonal_at, lower, lower_at),
    )
    count = len(widths)
    return (
        [diagonal[diagonal_at[i] : diagonal_at[i + 1]].reshape(widths[i], widths[i]) for i in range(count)],
        [lower[lower_at[i] : lower_at[i + 1]].reshape(widths[i + 1], widths[i]) for i in range(count - 1)],
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _eliminate_points(  # type: ignore[no-untyped-def]
    intrinsics, rotations, centres, points, keyframe_index, starts, pixels, weights, levels, system
):
    longest = 0
    for j in range(len(points)):
        longest = max(longest, starts[j + 1] - starts[j])
    by_pose, by_point, B = np.empty((longest, 2, 6)), np.empty((longest, 2, 3)), np.empty((longest, 3, 6))
    for j in range(len(points)):
        V = np.zeros((3, 3))
        first, count = starts[j], starts[j + 1] - starts[j]
        for n in range(count):
            m = first + n
            k = keyframe_index[m]
            _linearise(
                intrinsics, rotations[k], centres[k], points[j], pixels[m], weights[m], by_pose[n], by_point[n]
            )
            for c in range(3):
                for d in range(c + 1):
                    V[c, d] += by_point[n, 0, c] * by_point[n, 0, d] + by_point[n, 1, c] * by_point[n, 1, d]
        _cholesky_3x3(V)
        for n in range(count):
            for c in range(6):
                w0, w1, w2 = 0.0, 0.0, 0.0
                for row in range(2):
                    w0 += by_point[n, row, 0] * by_pose[n, row, c]
                    w1 += by_point[n, row, 1] * by_pose[n, row, c]
                    w2 += by_point[n, row, 2] * by_pose[n, row, c]
                b0 = w0 * V[0, 0]
                b1 = (w1 - V[1, 0] * b0) * V[1, 1]
                B[n, 0, c], B[n, 1, c] = b0, b1
                B[n, 2, c] = (w2 - V[2, 0] * b0 - V[2, 1] * b1) * V[2, 2]
        _add_share(keyframe_index[first : first + count], by_pose, B, levels, system)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_share(keyframes, by_pose, B, levels, system):  # type: ignore[no-untyped-def]
    """Add one point's share J^T J - B^T B of the camera system, B = C^-1 W with C C^T = V."""
    level_of, place_of, widths = levels
    diagonal, diagonal_at, lower, lower_at = system
    for m in range(len(keyframes)):
        level, place = level_of[keyframes[m]], place_of[keyframes[m]]
        width = widths[level]
        at = diagonal_at[level] + 6 * place * (width + 1)
        for d in range(6):
            for c in range(6):
                diagonal[at + d * width + c] += (
                    by_pose[m, 0, d] * by_pose[m, 0, c] + by_pose[m, 1, d] * by_pose[m, 1, c]
                )
        for n in range(len(keyframes)):
            other, row = level_of[keyframes[n]], place_of[keyframes[n]]
            if other == level and row >= place:
                into, at = diagonal, diagonal_at[level] + 6 * row * width + 6 * place
            elif other == level + 1:
                into, at = lower, lower_at[level] + 6 * row * width + 6 * place
            else:
                continue
            for d in range(6):
                b0, b1, b2 = B[n, 0, d], B[n, 1, d], B[n, 2, d]
                for c in range(6):
                    into[at + d * width + c] -= b0 * B[m, 0, c] + b1 * B[m, 1, c] + b2 * B[m, 2, c]


@njit(cache=True, nogil=True, error_model="numpy")
def _linearise(intrinsics, R, centre, point, pixel, weight, by_pose, by_point):  # type: ignore[no-untyped-def]
    """Jacobians of one observation by the pose (2, 6) and the point (2, 3), times the root of Huber's weight.

    R is cam_from_map. p_cam becomes p_cam - w x p_cam - v under T exp([w, v]); d pixel / d p_cam = [[a, 0, ax],
    [0, b, by]]. Nothing where the point lies behind the camera.
    """
    fx, fy, cx, cy = intrinsics
    dx, dy, dz = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
    x = R[0, 0] * dx + R[0, 1] * dy + R[0, 2] * dz
    y = R[1, 0] * dx + R[1, 1] * dy + R[1, 2] * dz
    z = R[2, 0] * dx + R[2, 1] * dy + R[2, 2] * dz
    by_pose[:], by_point[:] = 0.0, 0.0
    if not z > 0.0:
        return
    ru, rv = (fx * x / z + cx - pixel[0]) * weight, (fy * y / z + cy - pixel[1]) * weight
    error = np.sqrt(ru * ru + rv * rv)
    root = 1.0 if error <= HUBER_PX else np.sqrt(HUBER_PX / error)
    a, b = fx / z * weight * root, fy / z * weight * root
    ax, by = -a * x / z, -b * y / z
    by_pose[0, 0], by_pose[0, 1], by_pose[0, 2] = -ax * y, ax * x - a * z, a * y
    by_pose[0, 3], by_pose[0, 5] = -a, -ax
    by_pose[1, 0], by_pose[1, 1], by_pose[1, 2] = b * z - by * y, by * x, -b * x
    by_pose[1, 4], by_pose[1, 5] = -b, -by
    for c in range(3):
        by_point[0, c] = a * R[0, c] + ax * R[2, c]
        by_point[1, c] = b * R[1, c] + by * R[2, c]


@njit(cache=True, nogil=True, error_model="numpy")
def _cholesky_3x3(V):  # type: ignore[no-untyped-def]
    """The factor C of V in place, its diagonal inverted; 0 where the point is not determined at all."""
    for c in range(3):
        for d in range(c):
            for e in range(d):
                V[c, d] -= V[c, e] * V[d, e]
            V[c, d] *= V[d, d]
        pivot = V[c, c]
        for e in range(c):
            pivot -= V[c, e] * V[c, e]
        V[c, c] = 1.0 / np.sqrt(pivot) if pivot > 1e-14 * V[c, c] else 0.0
