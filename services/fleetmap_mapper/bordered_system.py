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
    gradient: Array  # (C,) of the cost once everything else is free
    poses_by_calibration: Array  # (N, C) how the poses follow
    points_by_calibration: Array  # (P, 3, C) how the points follow


def solve_bordered(
    images: LinearisedImages, rest: LinearisedRest, change: Array, damping: float
) -> BorderedStep:
    """One damped step; ``change`` (C,) is where the calibration stands, in sigmas of its prior."""
    by_pose, by_point, by_calibration = images.by_pose, images.by_point, images.by_calibration
    count = len(change)
    k, r = images.keyframe_index, images.residuals
    points = len(images.starts) - 1
    point_index = np.repeat(np.arange(points), np.diff(images.starts))
    V = _summed(np.einsum("mri,mrj->mij", by_point, by_point), point_index, points)
    diagonal = np.einsum("pii->pi", V)
    diagonal *= 1.0 + damping
    diagonal += 1e-12
    V_inverse = np.linalg.inv(V)
    gl = _summed(np.einsum("mri,mr->mi", by_point, r), point_index, points)
    W = np.einsum("mri,mrj->mij", by_pose, by_point)  # (M, 6, 3)
    Wc = _summed(np.einsum("mri,mrj->mij", by_calibration, by_point), point_index, points)  # (P, C, 3)
    U = _summed(np.einsum("mri,mrj->mij", by_pose, by_pose), k, images.keyframes)
    E = _summed(np.einsum("mri,mrj->mij", by_pose, by_calibration), k, images.keyframes)  # (K, 6, C)
    gp = _summed(np.einsum("mri,mr->mi", by_pose, r), k, images.keyframes)
    C = np.einsum("mri,mrj->ij", by_calibration, by_calibration)
    gc = np.einsum("mri,mr->i", by_calibration, r) + change

    WV = np.einsum("mij,mjk->mik", W, V_inverse[point_index])  # (M, 6, 3)
    S_pc = E - _summed(np.einsum("mij,mcj->mic", WV, Wc[point_index]), k, images.keyframes)
    b_p = gp - _summed(np.einsum("mij,mj->mi", WV, gl[point_index]), k, images.keyframes)
    WcV = np.einsum("pcj,pjk->pck", Wc, V_inverse)
    S_cc = C - np.einsum("pcj,pdj->cd", WcV, Wc) + np.eye(count)
    b_c = gc - np.einsum("pcj,pj->c", WcV, gl)

    S_pp = _pose_system(U, W, WV, images, damping) if images.keyframes else sp.csc_matrix((0, 0))
    size = rest.jacobian.shape[1]
    S_pp = _enlarged(S_pp, size) + rest.jacobian.T @ rest.jacobian
    S_pp = (S_pp + sp.diags(damping * S_pp.diagonal() + 1e-9)).tocsc()
    right = np.zeros((size, count + 1))
    right[: 6 * images.keyframes, :count] = S_pc.reshape(-1, count)
    right[: 6 * images.keyframes, count] = b_p.ravel()
    right[:, count] += rest.jacobian.T @ rest.residuals
    solver = splu(S_pp, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    solved = solver.solve(right)
    follow, alone = solved[:, :count], solved[:, count]
    information = S_cc - right[:, :count].T @ follow
    gradient = b_c - right[:, :count].T @ alone
    dc = -np.linalg.solve(information, gradient)
    dp = -alone - follow @ dc

    per_keyframe = follow[: 6 * images.keyframes].reshape(-1, 6, count)
    point_by_pose = _summed(np.einsum("mij,mic->mjc", W, per_keyframe[k]), point_index, points)
    points_follow = np.einsum("pij,pjc->pic", V_inverse, Wc.transpose(0, 2, 1) - point_by_pose)
    moved = _summed(
        np.einsum("mij,mi->mj", W, dp[: 6 * images.keyframes].reshape(-1, 6)[k]), point_index, points
    )
    dl = -np.einsum("pij,pj->pi", V_inverse, gl + moved + np.einsum("pcj,c->pj", Wc, dc))
    return BorderedStep(dc, dp, dl, information, gradient, -follow, -points_follow)


def _summed(values: Array, index: IntArray, count: int) -> Array:
    """Sums (count, ...) of the rows of ``values`` (M, ...) by their index."""
    flat = values.reshape(len(values), -1)
    picker = sp.csr_matrix((np.ones(len(index)), (index, np.arange(len(index)))), shape=(count, len(index)))
    return np.asarray(picker @ flat).reshape(count, *values.shape[1:])


def _pose_system(U: Array, W: Array, WV: Array, images: LinearisedImages, damping: float) -> sp.csc_matrix:
    """The reduced camera system (6 K, 6 K), symmetric and sparse: keyframes that share no point have no block."""
    first, second = _pairs(images.keyframe_index, images.starts)
    places, slots = np.unique(first * images.keyframes + second, return_inverse=True)
    blocks = np.zeros((len(places), 6, 6))
    _subtract_products(blocks, slots, W, WV, images.starts)
    rows, columns = places // images.keyframes, places % images.keyframes
    diagonal = np.arange(images.keyframes)
    blocks = np.concatenate([blocks, U])
    rows, columns = np.concatenate([rows, diagonal]), np.concatenate([columns, diagonal])
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
def _pairs(keyframe_index, starts):  # type: ignore[no-untyped-def]
    """Keyframes of all ordered pairs of observations of one point."""
    total = 0
    for j in range(len(starts) - 1):
        seen = starts[j + 1] - starts[j]
        total += seen * seen
    first, second = np.empty(total, np.int64), np.empty(total, np.int64)
    n = 0
    for j in range(len(starts) - 1):
        for a in range(starts[j], starts[j + 1]):
            for b in range(starts[j], starts[j + 1]):
                first[n], second[n] = keyframe_index[a], keyframe_index[b]
                n += 1
    return first, second


@njit(cache=True, nogil=True, error_model="numpy")
def _subtract_products(blocks, slots, W, WV, starts):  # type: ignore[no-untyped-def]
    """blocks[slot of (a, b)] -= W_a V^-1 W_b^T, in the order of :func:`_pairs`."""
    n = 0
    for j in range(len(starts) - 1):
        for a in range(starts[j], starts[j + 1]):
            for b in range(starts[j], starts[j + 1]):
                s = slots[n]
                n += 1
                for c in range(6):
                    for d in range(6):
                        blocks[s, c, d] -= (
                            WV[a, c, 0] * W[b, d, 0] + WV[a, c, 1] * W[b, d, 1] + WV[a, c, 2] * W[b, d, 2]
                        )
