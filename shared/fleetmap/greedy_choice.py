"""The order in which landmarks help most: a lazy greedy choice, compiled.

Every keyframe that saw a landmark gains twice by it: its pose would be known better, by the determinant of the
information to expect (D-optimality), and a part of its image that has few landmarks gets one more. Both returns
diminish, so gains that were computed once are upper bounds ever after, and a heap of them finds the next landmark
without looking at all of them again.

Sources: L. Carlone, S. Karaman, "Attention and anticipation in fast visual-inertial navigation", T-RO 2019,
section IV (greedy choice of features by log det of the information); M. Minoux, "Accelerated greedy algorithms for
maximizing submodular set functions", 1978.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

_WEIGHT_OF_POSE = 2.0  # against that of a well-filled image
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
    gains = np.empty(total)
    for i in range(total):
        gains[i] = _gain(i, landmarks, views, state)
    heap = np.argsort(-gains, kind="mergesort")
    gains = gains[heap]
    order = np.empty(total, np.int64)
    chosen, size = 0, total
    while size > 0:
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
def _gain(i, landmarks, views, state):  # type: ignore[no-untyped-def]
    """What landmark i would add: twice log det(I + p J P J^T), and p / (1 + n) of a part of the image."""
    chances, costs = landmarks
    p = chances[i]
    starts, keyframes, parts, jacobians = views
    covariances, counts = state
    total = 0.0
    for m in range(starts[i], starts[i + 1]):
        a, b, c = 1.0, 0.0, 1.0
        P = covariances[keyframes[m]]
        for row in range(6):
            u, v = 0.0, 0.0
            for column in range(6):
                u += P[row, column] * jacobians[m, 0, column]
                v += P[row, column] * jacobians[m, 1, column]
            a += p * jacobians[m, 0, row] * u
            b += p * jacobians[m, 0, row] * v
            c += p * jacobians[m, 1, row] * v
        total += _WEIGHT_OF_POSE * np.log(a * c - b * b) + p / (1.0 + counts[parts[m]])
    return total / costs[i]


@njit(cache=True, nogil=True)
def _take(i, landmarks, views, state):  # type: ignore[no-untyped-def]
    """Landmark i is chosen: P becomes P - P J^T (I / p + J P J^T)^-1 J P."""
    p = landmarks[0][i]
    if p <= 0.0:
        return
    starts, keyframes, parts, jacobians = views
    covariances, counts = state
    K = np.empty((2, 6))
    for m in range(starts[i], starts[i + 1]):
        counts[parts[m]] += p
        P = covariances[keyframes[m]]
        for n in range(2):
            for row in range(6):
                K[n, row] = 0.0
                for column in range(6):
                    K[n, row] += P[row, column] * jacobians[m, n, column]
        a, b, c = 1.0 / p, 0.0, 1.0 / p
        for row in range(6):
            a += jacobians[m, 0, row] * K[0, row]
            b += jacobians[m, 0, row] * K[1, row]
            c += jacobians[m, 1, row] * K[1, row]
        scale = 1.0 / (a * c - b * b)
        for row in range(6):
            u = (c * K[0, row] - b * K[1, row]) * scale
            v = (a * K[1, row] - b * K[0, row]) * scale
            for column in range(6):
                P[row, column] -= u * K[0, column] + v * K[1, column]


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
