"""The sequence of fixes that steps along as the camera does, found by dynamic programming.

Outliers in runs agree with one another, so no fix can be judged by its neighbours alone. But whoever believes a
run has to explain the jump into it and out of it. A sequence costs its jumps, and a fixed price for every fix that
it leaves out; the cheapest sequence is found exactly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import so3_exp

Array = NDArray[np.float64]

_PRICE = 9.0  # of a fix left out, in chi-squares of a step: a step costs 3 on average
_LEAST_STEPS = 5
_LEAST_BASELINE_M, _BASELINE_SIGMAS = 10.0, 20.0  # of a step that tells of drift
_WINDOW_M = 100.0  # on either side: much longer than a run of outliers' ends, shorter than drift takes to turn
_TURNINGS, _REWEIGHTINGS = 2, 12
_RIDGE = 1e-3  # holds the turn about a straight road
_WINDOW = 1_500  # fixes that may be left out in one go


def consistent_sequence(path_m: Array, fixes_m: Array, variances_m2: Array, share: float) -> NDArray[np.bool_]:
    """Which fixes belong to the cheapest sequence.

    Args:
        path_m: (F, 3) the antenna at every fix by vision, in metres, turned into the fixes' frame.
        fixes_m: (F, 3) the fixes.
        variances_m2: (F,) of them, per axis.
        share: how much of a step vision may be wrong by, in length and direction.
    """
    count = len(path_m)
    misfits = fixes_m - path_m
    way = np.append(0.0, np.linalg.norm(np.diff(path_m, axis=0), axis=1).cumsum())
    cost, previous = np.empty(count), np.full(count, -1)
    for j in range(count):
        cost[j] = _PRICE * j
        first = max(0, j - _WINDOW)
        jumps = ((misfits[first:j] - misfits[j]) ** 2).sum(axis=1)
        sigmas2 = variances_m2[first:j] + variances_m2[j] + (share * (way[j] - way[first:j])) ** 2
        total = cost[first:j] + jumps / sigmas2 + _PRICE * np.arange(j - first - 1, -1, -1)
        best = int(total.argmin()) if j else -1
        if j and total[best] < cost[j]:
            cost[j], previous[j] = total[best], first + best
    row = int((cost + _PRICE * np.arange(count - 1, -1, -1)).argmin())
    believed = np.zeros(count, dtype=bool)
    while row >= 0:
        believed[row] = True
        row = int(previous[row])
    return believed


def step_chi2(path_m: Array, fixes_m: Array, variances_m2: Array, share: float) -> Array:
    """How well each step (F - 1,) from one fix to the next goes with the path, in chi-squares of 3 degrees."""
    misfits = np.diff(fixes_m - path_m, axis=0)
    wandered = share * np.linalg.norm(np.diff(path_m, axis=0), axis=1)
    return np.asarray((misfits**2).sum(axis=1) / (variances_m2[1:] + variances_m2[:-1] + wandered**2))


def follow_drift(path_m: Array, fixes_m: Array, variances_m2: Array) -> Array:
    """The path (F, 3) with its steps turned and stretched as the fixes' steps around them are, in the median.

    A run of fixes that is off as a whole spoils only the steps into it and out of it, so steps tell of drift where
    positions cannot. Local turn w and stretch e minimise the sum of |du - (dq + w x dq + e dq)| over a window.
    """
    steps = _steps_between(path_m, variances_m2)
    if len(steps) < _LEAST_STEPS:
        return path_m
    start, end = steps.T
    wanted = fixes_m[end] - fixes_m[start]
    spacing_m = float(np.linalg.norm(np.diff(path_m, axis=0), axis=1).mean())
    middle = (start + end) / 2.0
    for _ in range(_TURNINGS):
        local = _windowed_medians(path_m[end] - path_m[start], wanted, spacing_m)
        at_step = np.stack(
            [np.interp(np.arange(len(path_m) - 1) + 0.5, middle, column) for column in local.T], axis=1
        )
        moves = np.diff(path_m, axis=0)
        moves = np.einsum("nij,nj->ni", so3_exp(at_step[:, :3]), moves) * np.exp(at_step[:, 3:])
        path_m = np.vstack([path_m[:1], path_m[0] + moves.cumsum(axis=0)])
    return path_m


def _steps_between(path_m: Array, variances_m2: Array) -> NDArray[np.intp]:
    """Pairs (n, 2) of fixes far enough apart for their noise not to matter, one for every fix with a partner."""
    way = np.append(0.0, np.linalg.norm(np.diff(path_m, axis=0), axis=1).cumsum())
    baseline = max(_LEAST_BASELINE_M, _BASELINE_SIGMAS * float(np.sqrt(np.median(variances_m2))))
    partner = np.searchsorted(way, way + baseline)
    start = np.flatnonzero(partner < len(way))
    return np.stack([start, partner[start]], axis=1)


def _windowed_medians(motions: Array, wanted: Array, spacing_m: float) -> Array:
    """Turn and stretch (n, 4) around each of n steps, by iteratively reweighted least squares of window sums."""
    count = len(motions)
    way = np.linalg.norm(motions, axis=1)
    reach = max(_LEAST_STEPS, int(np.ceil(_WINDOW_M / max(spacing_m, 1e-3))))
    design = np.concatenate([-_cross(motions), motions[:, :, None]], axis=2)
    missing = wanted - motions
    weights = 1.0 / np.maximum(way, 1e-3)
    first = np.maximum(np.arange(count) - reach, 0)
    last = np.minimum(np.arange(count) + reach + 1, count)
    local = np.zeros((count, 4))
    for _ in range(_REWEIGHTINGS):
        weighted = np.swapaxes(design, 1, 2) * weights[:, None, None]
        left = np.concatenate([np.zeros((1, 4, 4)), (weighted @ design).cumsum(axis=0)])
        right = np.concatenate([np.zeros((1, 4)), np.einsum("nij,nj->ni", weighted, missing).cumsum(axis=0)])
        ridge = _RIDGE * np.trace(left[-1]) / count * np.eye(4)
        local = np.linalg.solve(left[last] - left[first] + ridge, (right[last] - right[first])[:, :, None])[
            :, :, 0
        ]
        errors = np.linalg.norm(missing - np.einsum("nij,nj->ni", design, local), axis=1)
        weights = 1.0 / np.maximum(errors, 0.02 * way)
    return local


def _cross(vectors: Array) -> Array:
    matrices = np.zeros((len(vectors), 3, 3))
    matrices[:, [2, 0, 1], [1, 2, 0]] = vectors
    matrices[:, [1, 2, 0], [2, 0, 1]] = -vectors
    return matrices
