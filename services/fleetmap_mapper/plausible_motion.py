"""Images whose poses no vehicle could have had one after the other: better none than a wrong one.

An image spoilt by blur or glare may still match enough to be posed, but not well. Between the images before and
after it a vehicle can only be where accelerations that it survives take it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_MAX_ACCELERATION_M_S2 = 30.0  # three times gravity
_SLACK_M = 0.1  # what an honest pose may be off
_NEIGHBOURHOOD = 4  # images


def implausible_images(
    stamps_ns: NDArray[np.int64], positions_m: Array, may_go: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Which images (N,) stand where their neighbours in time do not let them.

    Args:
        stamps_ns: (N,) rising.
        positions_m: (N, 3) of the camera.
        may_go: (N,) images that may be named; others (keyframes) are part of the map.

    Where something is wrong the shortest run of images goes that makes it right; the first and the last image are
    not judged.
    """
    times_s = np.asarray((stamps_ns - stamps_ns[:1]) * 1e-9, dtype=np.float64)
    left = np.arange(len(stamps_ns))
    while len(suspects := np.flatnonzero((_excess_m(times_s[left], positions_m[left]) > 0.0) & may_go[left])):
        near = suspects[suspects <= suspects[0] + _NEIGHBOURHOOD]
        left = np.delete(left, _shortest_run(times_s[left], positions_m[left], may_go[left], near))
    implausible = np.ones(len(stamps_ns), np.bool_)
    implausible[left] = False
    return implausible


def _shortest_run(
    times_s: Array, positions_m: Array, may_go: NDArray[np.bool_], suspects: NDArray[np.intp]
) -> NDArray[np.intp]:
    """The fewest images in a row without which nothing is wrong around the suspects; else these themselves."""
    first, last = max(int(suspects[0]) - _NEIGHBOURHOOD, 0), int(suspects[-1]) + _NEIGHBOURHOOD
    around = np.arange(first, min(last + 1, len(times_s)))
    for length in range(1, len(suspects) + 1):
        for start in range(suspects[0], suspects[-1] + 1):
            run = np.arange(start, min(start + length, around[-1]))
            kept = np.setdiff1d(around, run)
            if may_go[run].all() and not _excess_m(times_s[kept], positions_m[kept]).any():
                return run
    return suspects


def _excess_m(times_s: Array, positions_m: Array) -> Array:
    """How much further each image (N,) lies from the line between its neighbours than a vehicle gets; zero at the
    ends."""
    excess_m = np.zeros(len(times_s))
    before_s, after_s = np.diff(times_s)[:-1], np.diff(times_s)[1:]
    share = (before_s / (before_s + after_s))[:, None]
    between_m = (1.0 - share) * positions_m[:-2] + share * positions_m[2:]
    reach_m = 0.5 * _MAX_ACCELERATION_M_S2 * before_s * after_s + _SLACK_M
    excess_m[1:-1] = np.linalg.norm(positions_m[1:-1] - between_m, axis=1) - reach_m
    return np.maximum(excess_m, 0.0)
