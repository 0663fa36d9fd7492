"""The normal equations of a bundle adjustment, solved by eliminating its points; compiled.

Source: Triggs et al., "Bundle adjustment - a modern synthesis", 2000, section 6.1.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def solve_damped(blocks, keyframe_index, starts, slots, damping):  # type: ignore[no-untyped-def]
    """One damped step: poses (F, 6) from the reduced camera system, points (P, 3) by back-substitution.

    Args:
        blocks: of J^T J and the gradients: poses U (F, 6, 6), gp (F, 6); points V (P, 3, 3), gl (P, 3); mixed
            W (M, 3, 6), one for each observation, point by pose.
        keyframe_index: (M,) of the observations, which are sorted by point.
        starts: (P + 1,) first observation of each point.
        slots: (K,) place of each keyframe among the free poses, -1 where it is fixed.
        damping: Levenberg-Marquardt's, relative to the diagonal.
    """
    U, _, V, gl, W = blocks
    free = len(U)
    V_inv = np.empty_like(V)
    for j in range(len(V)):
        _invert_3x3(V[j], damping, V_inv[j])
    S, b = _reduced_system(blocks, V_inv, keyframe_index, starts, slots, damping)
    dp = np.linalg.solve(S, b).reshape(free, 6) if free else np.zeros((0, 6))
    dl = np.zeros_like(gl)
    for j in range(len(V)):
        r0, r1, r2 = -gl[j, 0], -gl[j, 1], -gl[j, 2]
        for m in range(starts[j], starts[j + 1]):
            s = slots[keyframe_index[m]]
            if s >= 0:
                for c in range(6):
                    r0 -= W[m, 0, c] * dp[s, c]
                    r1 -= W[m, 1, c] * dp[s, c]
                    r2 -= W[m, 2, c] * dp[s, c]
        for c in range(3):
            dl[j, c] = V_inv[j, c, 0] * r0 + V_inv[j, c, 1] * r1 + V_inv[j, c, 2] * r2
    return dp, dl


@njit(cache=True, nogil=True, error_model="numpy")
def _reduced_system(blocks, V_inv, keyframe_index, starts, slots, damping):  # type: ignore[no-untyped-def]
    """The camera system (6 F, 6 F) and its right side once the points are eliminated."""
    U, gp, V, gl, W = blocks
    free = len(U)
    S, b = np.zeros((6 * free, 6 * free)), -gp.copy().reshape(6 * free)
    for s in range(free):
        for c in range(6):
            for d in range(6):
                S[6 * s + c, 6 * s + d] = U[s, c, d]
            S[6 * s + c, 6 * s + c] += damping * U[s, c, c] + 1e-9
    for j in range(len(V)):
        for m in range(starts[j], starts[j + 1]):
            s = slots[keyframe_index[m]]
            if s < 0:
                continue
            Y = _product(W[m], V_inv[j])
            for c in range(6):
                b[6 * s + c] += Y[c][0] * gl[j, 0] + Y[c][1] * gl[j, 1] + Y[c][2] * gl[j, 2]
            for n in range(starts[j], starts[j + 1]):
                q = slots[keyframe_index[n]]
                if q < s:  # the lower triangle is enough
                    continue
                for d in range(6):
                    w0, w1, w2 = W[n, 0, d], W[n, 1, d], W[n, 2, d]
                    for c in range(6):
                        S[6 * q + d, 6 * s + c] -= Y[c][0] * w0 + Y[c][1] * w1 + Y[c][2] * w2
    for row in range(6 * free):
        for column in range(row):
            S[column, row] = S[row, column]
    return S, b


@njit(cache=True, nogil=True, error_model="numpy")
def _product(W, V_inv):  # type: ignore[no-untyped-def]
    """W^T V^-1 (6, 3) as tuples, which stay in registers."""
    return (
        _product_row(W, V_inv, 0),
        _product_row(W, V_inv, 1),
        _product_row(W, V_inv, 2),
        _product_row(W, V_inv, 3),
        _product_row(W, V_inv, 4),
        _product_row(W, V_inv, 5),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _product_row(W, V_inv, c):  # type: ignore[no-untyped-def]
    w0, w1, w2 = W[0, c], W[1, c], W[2, c]
    return (
        w0 * V_inv[0, 0] + w1 * V_inv[1, 0] + w2 * V_inv[2, 0],
        w0 * V_inv[0, 1] + w1 * V_inv[1, 1] + w2 * V_inv[2, 1],
        w0 * V_inv[0, 2] + w1 * V_inv[1, 2] + w2 * V_inv[2, 2],
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _invert_3x3(A, damping, inverse):  # type: ignore[no-untyped-def]
    d = 1.0 + damping
    a00, a11, a22 = A[0, 0] * d + 1e-12, A[1, 1] * d + 1e-12, A[2, 2] * d + 1e-12
    a01, a02, a12 = A[0, 1], A[0, 2], A[1, 2]
    c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
    determinant = a00 * c00 + a01 * c01 + a02 * c02
    inverse[0, 0] = c00 / determinant
    inverse[1, 1] = (a00 * a22 - a02 * a02) / determinant
    inverse[2, 2] = (a00 * a11 - a01 * a01) / determinant
    inverse[0, 1] = inverse[1, 0] = c01 / determinant
    inverse[0, 2] = inverse[2, 0] = c02 / determinant
    inverse[1, 2] = inverse[2, 1] = (a01 * a02 - a00 * a12) / determinant
