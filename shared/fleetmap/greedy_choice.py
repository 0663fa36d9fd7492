"""The order in which landmarks help most: a lazy greedy choice, compiled.

Every keyframe that saw a landmark gains twice by it: its position would be known better, by the determinant of its
covariance to expect (D_s-optimality), and a part of its image that has few landmarks gets one more. Not the whole
pose's determinant: there what is far away counts as much for its orientation as what is near does for its
position, but orientation a view has plenty of, and it is the metres that a map is asked for.

Returns diminish, so gains that were computed once serve as upper bounds, and a heap of them finds the next
landmark without looking at all of them again. Of a position alone that is not true to the letter: a landmark may
become worth more by another that holds the orientation. So now and then all gains are looked at again.

Sources: A. Atkinson, A. Donev, R. Tobias, "Optimum experimental designs, with SAS", 2007, section 10.3 (a part of
the parameters); L. Carlone, S. Karaman, "Attention and anticipation in fast visual-inertial navigation", T-RO
2019, section IV (greedy choice of features by log det of the information); M. Minoux, "Accelerated greedy
algorithms for maximizing submodular set functions", 1978.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

_WEIGHT_OF_POSITION = 10.0  # against that of a well-filled image
_LOOK_AGAIN = 1.25  # all gains are looked at again whenever so many times as many are chosen
_PRIOR_RAD, _PRIOR_M = 0.1, 1.0  # what a keyframe's pose is known to before any landmark is chosen


@dataclass(frozen=True)
class Views:
    """Who sees what, by landmark: rows starts[i] to starts[i + 1] are landmark i's."""

    starts: Ids  # (N + 1,)
    keyframes: Ids  # (M,)
    parts: Ids  # (M,) number of a part of a keyframe's image
    part_count: int
    keyframe_count: int
    jacobians: NDArray[np.float32]  # (M, 2, 6) of the pixel in its sigmas, by the pose [rotation, translation]


def order_of_use(chances: Array, costs: Array, views: Views) -> Ids:
    """All landmarks (N,), the one that helps most for its cost first.

    Args:
        chances: (N,) that a landmark is found again and of use, 0 to 1.
        costs: (N,) above 0; what counts is their ratio.
        views: who sees what.
    """
    prior = np.diag([_PRIOR_RAD**2] * 3 + [_PRIOR_M**2] * 3)
    covariances = np.tile(prior, (views.keyframe_count, 1, 1))
    counts = np.zeros(views.part_count)
    of_views = views.starts, views.keyframes, views.parts, views.jacobians
    order: Ids = _choose((chances, costs), of_views, (covariances, counts))
    return order


@njit(cache=True, nogil=True)
def _choose(landmarks, views, state):  # type: ignore[no-untyped-def]
    total = len(landmarks[0])
    heap, gains, order = np.arange(total), np.empty(total), np.empty(total, np.int64)
    chosen, size, next_look = 0, total, 0
    while size > 0:
        if chosen == next_look:
            _look_at_all(heap[:size], gains[:size], landmarks, views, state)
            next_look = max(chosen + 1, int(np.ceil(_LOOK_AGAIN * chosen)))
        top = heap[0]
        gain = _gain(top, landmarks, views, state)
        if gain < gains[0] * (1.0 - 1e-9):
            gains[0] = gain
        else:
            order[chosen] = top
            chosen += 1
            _take(top, landmarks, views, state)
            size -= 1
            heap[0], gains[0] = heap[size], gains[size]
        _sink(heap, gains, size)
    return order


@njit(cache=True, nogil=True)
def _look_at_all(heap, gains, landmarks, views, state):  # type: ignore[no-untyped-def]
    """The gains of all that is left; sorted, they are a heap."""
    for slot in range(len(heap)):
        gains[slot] = _gain(heap[slot], landmarks, views, state)
    by_gain = np.argsort(-gains, kind="mergesort")
    heap[:], gains[:] = heap[by_gain], gains[by_gain]


@njit(cache=True, nogil=True)
def _gain(i, landmarks, views, state):  # type: ignore[no-untyped-def]
    """What landmark i would add: how much log det of the position's part of P falls, and p / (1 + n)."""
    chances, costs = landmarks
    p = chances[i]
    if p <= 0.0:
        return 0.0
    starts, keyframes, parts, jacobians = views
    covariances, counts = state
    JP, after = np.empty((2, 6)), np.empty((3, 3))
    total = 0.0
    for m in range(starts[i], starts[i + 1]):
        P = covariances[keyframes[m]]
        a, b, c = _inverse_innovation(P, jacobians[m], p, JP)
        for row in range(3):
            u, v = a * JP[0, 3 + row] + b * JP[1, 3 + row], b * JP[0, 3 + row] + c * JP[1, 3 + row]
            for column in range(3):
                after[row, column] = P[3 + row, 3 + column] - u * JP[0, 3 + column] - v * JP[1, 3 + column]
        total += _WEIGHT_OF_POSITION * np.log(_det(P[3:, 3:]) / _det(after)) + p / (1.0 + counts[parts[m]])
    return total / costs[i]


@njit(cache=True, nogil=True)
def _take(i, landmarks, views, state):  # type: ignore[no-untyped-def]
    """Landmark i is chosen: P becomes P - P J^T (I / p + J P J^T)^-1 J P."""
    p = landmarks[0][i]
    if p <= 0.0:
        return
    starts, keyframes, parts, jacobians = views
    covariances, counts = state
    JP = np.empty((2, 6))
    for m in range(starts[i], starts[i + 1]):
        counts[parts[m]] += p
        P = covariances[keyframes[m]]
        a, b, c = _inverse_innovation(P, jacobians[m], p, JP)
        for row in range(6):
            u, v = a * JP[0, row] + b * JP[1, row], b * JP[0, row] + c * JP[1, row]
            for column in range(6):
                P[row, column] -= u * JP[0, column] + v * JP[1, column]


@njit(cache=True, nogil=True)
def _inverse_innovation(P, J, p, JP):  # type: ignore[no-untyped-def]
    """The entries (a, b; b, c) of (I / p + J P J^T)^-1; fills J P (2, 6)."""
    a, b, c = 1.0 / p, 0.0, 1.0 / p
    for column in range(6):
        u, v = 0.0, 0.0
        for row in range(6):
            u += J[0, row] * P[row, column]
            v += J[1, row] * P[row, column]
        JP[0, column], JP[1, column] = u, v
        a += u * J[0, column]
        b += u * J[1, column]
        c += v * J[1, column]
    scale = 1.0 / (a * c - b * b)
    return c * scale, -b * scale, a * scale


@njit(cache=True, nogil=True)
def _det(M):  # type: ignore[no-untyped-def]
    """Of a matrix (3, 3)."""
    return (
        M[0, 0] * (M[1, 1] * M[2, 2] - M[1, 2] * M[2, 1])
        - M[0, 1] * (M[1, 0] * M[2, 2] - M[1, 2] * M[2, 0])
        + M[0, 2] * (M[1, 0] * M[2, 1] - M[1, 1] * M[2, 0])
    )


@njit(cache=True, nogil=True)
def _sink(heap, gains, size):  # type: ignore[no-untyped-def]
    """Restore the heap below its top: the largest gain first, of equal ones the lower landmark."""
    at = 0
    while True:
        child = 2 * at + 1
        if child >= size:
            return
        right = child + 1
        if right < size and (
            gains[right] > gains[child] or (gains[right] == gains[child] and heap[right] < heap[child])
        ):
            child = right
        if gains[at] > gains[child] or (gains[at] == gains[child] and heap[at] <= heap[child]):
            return
        heap[at], heap[child] = heap[child], heap[at]
        gains[at], gains[child] = gains[child], gains[at]
        at = child
