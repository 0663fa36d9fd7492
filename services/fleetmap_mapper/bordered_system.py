"""One Gauss-Newton step over poses, points and the calibration that all images share.

The normal equations of a bundle adjustment, with the calibration as a border around the reduced camera system:
points are eliminated first, poses next (a sparse system), and what is left is the calibration's own small one.

    [ S_pp  S_pc ] [dp]     [b_p]         H_c = S_cc - S_cp S_pp^-1 S_pc + prior
    [ S_cp  S_cc ] [dc] = - [b_c]

Source: Triggs et al., "Bundle adjustment - a modern synthesis", 2000, sections 6.1 and 6.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numba import njit
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class LinearisedImages:
    """Weighted residuals and derivatives of all observations, sorted by point."""

    residuals: Array  # (M, 2)
    by_pose: Array  # (M, 2, 6)
    by_point: Array  # (M, 2, 3)
    by_calibration: Array  # (M, 2, C)
    keyframe_index: IntArray  # (M,)
    starts: IntArray  # (P + 1,) first observation of each point
    keyframes: int
    shared_blocks: tuple[IntArray, IntArray]  # see the function of this name


@dataclass(frozen=True)
class LinearisedRest:
    """What else the graph holds on the poses, and on N - 6 K further variables after them."""

    jacobian: sp.csr_matrix  # (R, N)
    residuals: Array  # (R,)


@dataclass(frozen=True)
class BorderedStep:
    """A step to the joint optimum, and what it says about the calibration."""

    calibration: Array  # (C,) in prior sigmas
    poses: Array  # (N,) tangents of the poses, then the other variables'
    points: Array  # (P, 3)
    information: Array  # (C, C) of the calibration, with its prior, everything else free
    poses_by_calibration: Array  # (N, C) how the poses follow
    points_by_calibration: Array  # (P, 3, C) how the points follow


@dataclass(frozen=True)
class _WithoutPoints:
    """The system once the points are eliminated, and what brings them back."""

    S_pp: sp.csc_matrix  # (6 K, 6 K)
    S_pc: Array  # (6 K, C)
    b_p: Array  # (6 K,)
    S_cc: Array  # (C, C)
    b_c: Array  # (C,)
    V_inverse: Array  # (P, 3, 3)
    gl: Array  # (P, 3)
    W: Array  # (M, 6, 3) pose by point
    Wc: Array  # (P, C, 3) calibration by point


def solve_bordered(images: LinearisedImages, rest: LinearisedRest, change: Array, damping: float) -> BorderedStep:
    """One damped step; ``change`` (C,) is where the calibration stands, in sigmas of its prior."""
    reduced = _eliminate_points(images, damping)
    S_pc, by_pose = _lengthened(reduced.S_pc, rest), _lengthened(reduced.b_p, rest)
    b_p = by_pose + rest.jacobian.T @ rest.residuals
    S_pp = _enlarged(reduced.S_pp, len(b_p)) + rest.jacobian.T @ rest.jacobian
    S_pp = (S_pp + sp.diags(damping * S_pp.diagonal() + 1e-9)).tocsc()
    solver = splu(S_pp, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    solved = solver.solve(np.column_stack([S_pc, b_p]))
    poses_follow, alone = -solved[:, :-1], -solved[:, -1]

    information = reduced.S_cc + np.eye(len(change)) + S_pc.T @ poses_follow
    dc = np.linalg.solve(information, -(reduced.b_c + change + S_pc.T @ alone)).astype(np.float64)
    dp = alone + poses_follow @ dc
    of_poses = np.column_stack([poses_follow, dp])[: 6 * images.keyframes].reshape(images.keyframes, 6, -1)
    carried = _carried(reduced.W, np.ascontiguousarray(of_poses), images.keyframe_index, images.starts)
    points_follow = -reduced.V_inverse @ (reduced.Wc.transpose(0, 2, 1) + carried[:, :, :-1])
    dl = -reduced.V_inverse @ (reduced.gl + reduced.Wc.transpose(0, 2, 1) @ dc + carried[:, :, -1])[:, :, None]
    return BorderedStep(dc, dp, dl[:, :, 0], information, poses_follow, points_follow)


def _eliminate_points(images: LinearisedImages, damping: float) -> _WithoutPoints:
    places, slots = images.shared_blocks
    K, P, C = images.keyframes, len(images.starts) - 1, images.by_calibration.shape[2]
    M = len(images.residuals)
    blocks, U = np.zeros((len(places), 6, 6)), np.zeros((K, 6, 6))
    S_pc, b_p, S_cc, b_c = np.zeros((K, 6, C)), np.zeros((K, 6)), np.zeros((C, C)), np.zeros(C)
    V_inverse, gl = np.empty((P, 3, 3)), np.zeros((P, 3))
    W, Wc = np.zeros((M, 6, 3)), np.zeros((P, C, 3))
    _eliminate(
        np.ascontiguousarray(images.residuals),
        np.ascontiguousarray(images.by_pose),
        np.ascontiguousarray(images.by_point),
        np.ascontiguousarray(images.by_calibration),
        images.keyframe_index,
        images.starts,
        slots,
        damping,
        (blocks, U, S_pc, b_p, S_cc, b_c, V_inverse, gl, W, Wc),
    )
    S_pp = _pose_system(blocks, U, places)
    return _WithoutPoints(S_pp, S_pc.reshape(6 * K, C), b_p.ravel(), S_cc, b_c, V_inverse, gl, W, Wc)


def _lengthened(of_poses: Array, rest: LinearisedRest) -> Array:
    """With zeros for the variables after the poses."""
    more = rest.jacobian.shape[1] - len(of_poses)
    return np.concatenate([of_poses, np.zeros((more, *of_poses.shape[1:]))])


def shared_blocks(keyframe_index: IntArray, starts: IntArray, keyframes: int) -> tuple[IntArray, IntArray]:
    """Blocks of the upper triangle that share points, as row * K + column (B,), and the one that each pair of
    observations of a point fills (Q,)."""
    places, slots = np.unique(_places(keyframe_index, starts, keyframes), return_inverse=True)
    return places, np.asarray(slots, dtype=np.int64)


def _pose_system(blocks: Array, U: Array, places: IntArray) -> sp.csc_matrix:
    """The reduced camera system (6 K, 6 K), symmetric and sparse: keyframes that share no point have no block."""
    keyframes = len(U)
    rows, columns = places // keyframes, places % keyframes
    upper = rows < columns
    own = np.arange(keyframes)
    blocks = np.concatenate([blocks, blocks[upper].transpose(0, 2, 1), U])
    rows, columns = (
        np.concatenate([rows, columns[upper], own]),
        np.concatenate([columns, rows[upper], own]),
    )
    six = np.arange(6)
    i = np.broadcast_to(6 * rows[:, None, None] + six[:, None], blocks.shape)
    j = np.broadcast_to(6 * columns[:, None, None] + six, blocks.shape)
    side = 6 * keyframes
    return sp.csc_matrix((blocks.ravel(), (i.ravel(), j.ravel())), shape=(side, side))


def _enlarged(matrix: sp.csc_matrix, side: int) -> sp.csc_matrix:
    return sp.csc_matrix((matrix.data, matrix.indices, _padded(matrix.indptr, side + 1)), shape=(side, side))


def _padded(indptr: NDArray[np.int32], length: int) -> NDArray[np.int32]:
    return np.concatenate([indptr, np.full(length - len(indptr), indptr[-1], indptr.dtype)])


@njit(cache=True, nogil=True, error_model="numpy")
def _carried(W, of_poses, keyframe_index, starts):  # type: ignore[no-untyped-def]
    """Sum over each point's observations of W^T times the rows (6, C + 1) of its keyframe: (P, 3, C + 1)."""
    columns = of_poses.shape[2]
    carried = np.zeros((len(starts) - 1, 3, columns))
    for j in range(len(starts) - 1):
        for m in range(starts[j], starts[j + 1]):
            follow = of_poses[keyframe_index[m]]
            for c in range(3):
                for d in range(6):
                    for e in range(columns):
                        carried[j, c, e] += W[m, d, c] * follow[d, e]
    return carried


@njit(cache=True, nogil=True)
def _places(keyframe_index, starts, keyframes):  # type: ignore[no-untyped-def]
    """For every pair of observations of one point, itself included: which block of the upper triangle it fills."""
    total = 0
    for j in range(len(starts) - 1):
        seen = starts[j + 1] - starts[j]
        total += seen * (seen + 1) // 2
    places = np.empty(total, np.int64)
    n = 0
    for j in range(len(starts) - 1):
        for a in range(starts[j], starts[j + 1]):
            for b in range(a, starts[j + 1]):
                k, q = keyframe_index[a], keyframe_index[b]
                places[n] = min(k, q) * keyframes + max(k, q)
                n += 1
    return places


@njit(cache=True, nogil=True, error_model="numpy")
def _add_products(target, a, b):  # type: ignore[no-untyped-def]
    """target += a^T b, for a (2, i) and b (2, j)."""
    for c in range(target.shape[0]):
        for d in range(target.shape[1]):
            target[c, d] += a[0, c] * b[0, d] + a[1, c] * b[1, d]


@njit(cache=True, nogil=True, error_model="numpy")
def _multiply(a, b, target):  # type: ignore[no-untyped-def]
    """target = a b, for a (n, 3) and b (3, 3)."""
    for c in range(a.shape[0]):
        for d in range(3):
            target[c, d] = a[c, 0] * b[0, d] + a[c, 1] * b[1, d] + a[c, 2] * b[2, d]


@njit(cache=True, nogil=True, error_model="numpy")
def _subtract_outer(target, a, b):  # type: ignore[no-untyped-def]
    """target -= a b^T, for a (n, 3) and b (m, 3)."""
    for c in range(a.shape[0]):
        for d in range(b.shape[0]):
            target[c, d] -= a[c, 0] * b[d, 0] + a[c, 1] * b[d, 1] + a[c, 2] * b[d, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def _invert(V, inverse):  # type: ignore[no-untyped-def]
    """Of a symmetric matrix (3, 3), by cofactors."""
    a, b, c, d, e, f = V[0, 0], V[0, 1], V[0, 2], V[1, 1], V[1, 2], V[2, 2]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * A + b * B + c * C
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = (
        A / determinant,
        (a * f - c * c) / determinant,
        (a * d - b * b) / determinant,
    )
    inverse[0, 1] = inverse[1, 0] = B / determinant
    inverse[0, 2] = inverse[2, 0] = C / determinant
    inverse[1, 2] = inverse[2, 1] = (b * c - a * e) / determinant


@njit(cache=True, nogil=True, error_model="numpy")
def _eliminate(residuals, by_pose, by_point, by_calibration, keyframe_index, starts, slots, damping, out):  # type: ignore[no-untyped-def]
    """The sums of _WithoutPoints, point by point; ``slots`` (Q,) is in the order of :func:`_places`."""
    blocks, U, S_pc, b_p, S_cc, b_c, V_inverse, gl, W, Wc = out
    WV, WcV, V = np.empty((6, 3)), np.empty((len(b_c), 3)), np.empty((3, 3))
    pair = 0
    for j in range(len(starts) - 1):
        V[:] = 0.0
        for m in range(starts[j], starts[j + 1]):
            k, r = keyframe_index[m], residuals[m]
            _add_products(V, by_point[m], by_point[m])
            _add_products(U[k], by_pose[m], by_pose[m])
            _add_products(W[m], by_pose[m], by_point[m])
            _add_products(Wc[j], by_calibration[m], by_point[m])
            _add_products(S_pc[k], by_pose[m], by_calibration[m])
            _add_products(S_cc, by_calibration[m], by_calibration[m])
            for c in range(3):
                gl[j, c] += by_point[m, 0, c] * r[0] + by_point[m, 1, c] * r[1]
            for c in range(6):
                b_p[k, c] += by_pose[m, 0, c] * r[0] + by_pose[m, 1, c] * r[1]
            for c in range(len(b_c)):
                b_c[c] += by_calibration[m, 0, c] * r[0] + by_calibration[m, 1, c] * r[1]
        for c in range(3):
            V[c, c] += damping * V[c, c] + 1e-12
        _invert(V, V_inverse[j])
        _multiply(Wc[j], V_inverse[j], WcV)
        _subtract_outer(S_cc, WcV, Wc[j])
        for c in range(len(b_c)):
            b_c[c] -= WcV[c, 0] * gl[j, 0] + WcV[c, 1] * gl[j, 1] + WcV[c, 2] * gl[j, 2]
        for a in range(starts[j], starts[j + 1]):
            k = keyframe_index[a]
            _multiply(W[a], V_inverse[j], WV)
            _subtract_outer(S_pc[k], WV, Wc[j])
            for c in range(6):
                b_p[k, c] -= WV[c, 0] * gl[j, 0] + WV[c, 1] * gl[j, 1] + WV[c, 2] * gl[j, 2]
            for b in range(a, starts[j + 1]):
                block, q = blocks[slots[pair]], keyframe_index[b]
                pair += 1
                if k <= q:
                    _subtract_outer(block, WV, W[b])
                if k > q or (k == q and a != b):  # the other order of the pair is this one transposed
                    for c in range(6):
                        for d in range(6):
                            block[d, c] -= WV[c, 0] * W[b, d, 0] + WV[c, 1] * W[b, d, 1] + WV[c, 2] * W[b, d, 2]
