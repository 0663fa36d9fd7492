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
    point_index: IntArray  # (M,)


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
    of_poses = _by_observation(np.column_stack([poses_follow, dp]), images)  # (M, 6, C + 1)
    carried = sum_rows(_products(reduced.W, of_poses), reduced.point_index, len(reduced.gl))
    points_follow = -reduced.V_inverse @ (reduced.Wc.transpose(0, 2, 1) + carried[:, :, :-1])
    dl = -reduced.V_inverse @ (reduced.gl + reduced.Wc.transpose(0, 2, 1) @ dc + carried[:, :, -1])[:, :, None]
    return BorderedStep(dc, dp, dl[:, :, 0], information, poses_follow, points_follow)


def _eliminate_points(images: LinearisedImages, damping: float) -> _WithoutPoints:
    by_pose, by_point, by_calibration = images.by_pose, images.by_point, images.by_calibration
    r, K, P = images.residuals[:, :, None], images.keyframes, len(images.starts) - 1
    point_index, k = np.repeat(np.arange(P), np.diff(images.starts)), images.keyframe_index
    V = sum_rows(_products(by_point, by_point), point_index, P)
    V += np.eye(3) * (damping * V + 1e-12)
    V_inverse = np.asarray(np.linalg.inv(V), dtype=np.float64)
    gl = sum_rows(_products(by_point, r), point_index, P)
    W = _products(by_pose, by_point)
    Wc = sum_rows(_products(by_calibration, by_point), point_index, P)
    WV, WcV = W @ V_inverse[point_index], Wc @ V_inverse
    S_pc = _products(by_pose, by_calibration) - WV @ Wc.transpose(0, 2, 1)[point_index]
    b_p = _products(by_pose, r) - WV @ gl[point_index]
    flat = by_calibration.reshape(-1, by_calibration.shape[2])
    U = sum_rows(_products(by_pose, by_pose), k, K)
    return _WithoutPoints(
        _pose_system(U, W, WV, images),
        sum_rows(S_pc, k, K).reshape(6 * K, -1),
        sum_rows(b_p, k, K).ravel(),
        flat.T @ flat - (WcV @ Wc.transpose(0, 2, 1)).sum(axis=0),
        flat.T @ images.residuals.ravel() - (WcV @ gl).sum(axis=0)[:, 0],
        V_inverse,
        gl[:, :, 0],
        W,
        Wc,
        point_index,
    )


def _products(a: Array, b: Array) -> Array:
    """a^T b of every row: (M, i, j) from (M, n, i) and (M, n, j)."""
    return np.asarray(a.transpose(0, 2, 1) @ b)


def _by_observation(of_poses: Array, images: LinearisedImages) -> Array:
    """Rows (N, C) of the poses' tangents as (M, 6, C), those of each observation's keyframe."""
    per_keyframe = of_poses[: 6 * images.keyframes].reshape(images.keyframes, 6, -1)
    return np.asarray(per_keyframe[images.keyframe_index])


def _lengthened(of_poses: Array, rest: LinearisedRest) -> Array:
    """With zeros for the variables after the poses."""
    more = rest.jacobian.shape[1] - len(of_poses)
    return np.concatenate([of_poses, np.zeros((more, *of_poses.shape[1:]))])


def sum_rows(values: Array, index: IntArray, count: int) -> Array:
    """Sums (count, ...) of the rows of ``values`` (M, ...) by their index."""
    flat = values.reshape(len(values), -1)
    picker = sp.csr_matrix((np.ones(len(index)), (index, np.arange(len(index)))), shape=(count, len(index)))
    return np.asarray(picker @ flat).reshape(count, *values.shape[1:])


def _pose_system(U: Array, W: Array, WV: Array, images: LinearisedImages) -> sp.csc_matrix:
    """The reduced camera system (6 K, 6 K), symmetric and sparse: keyframes that share no point have no block."""
    places, slots = np.unique(_places(images.keyframe_index, images.starts, images.keyframes), return_inverse=True)
    blocks = np.zeros((len(places), 6, 6))
    _subtract_products(blocks, slots, W, WV, images.keyframe_index, images.starts)
    rows, columns = places // images.keyframes, places % images.keyframes
    upper = rows < columns
    own = np.arange(images.keyframes)
    blocks = np.concatenate([blocks, blocks[upper].transpose(0, 2, 1), U])
    rows, columns = (
        np.concatenate([rows, columns[upper], own]),
        np.concatenate([columns, rows[upper], own]),
    )
    six = np.arange(6)
    i = np.broadcast_to(6 * rows[:, None, None] + six[:, None], blocks.shape)
    j = np.broadcast_to(6 * columns[:, None, None] + six, blocks.shape)
    side = 6 * images.keyframes
    return sp.csc_matrix((blocks.ravel(), (i.ravel(), j.ravel())), shape=(side, side))


def _enlarged(matrix: sp.csc_matrix, side: int) -> sp.csc_matrix:
    return sp.csc_matrix((matrix.data, matrix.indices, _padded(matrix.indptr, side + 1)), shape=(side, side))


def _padded(indptr: NDArray[np.int32], length: int) -> NDArray[np.int32]:
    return np.concatenate([indptr, np.full(length - len(indptr), indptr[-1], indptr.dtype)])


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
def _subtract_products(blocks, slots, W, WV, keyframe_index, starts):  # type: ignore[no-untyped-def]
    """blocks[slot of (a, b)] -= W_a V^-1 W_b^T, in the order of :func:`_places`."""
    n = 0
    for j in range(len(starts) - 1):
        for a in range(starts[j], starts[j + 1]):
            for b in range(a, starts[j + 1]):
                s = slots[n]
                n += 1
                k, q = keyframe_index[a], keyframe_index[b]
                for c in range(6):
                    for d in range(6):
                        value = WV[a, c, 0] * W[b, d, 0] + WV[a, c, 1] * W[b, d, 1] + WV[a, c, 2] * W[b, d, 2]
                        if k <= q:
                            blocks[s, c, d] -= value
                        if k > q or (k == q and a != b):  # the other order of the pair is this one transposed
                            blocks[s, d, c] -= value
