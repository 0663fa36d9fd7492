"""Errors are alike along a track, since a patch that is seen a little wrong in one image is seen so in the next.

n observations whose errors correlate by rho from one to the next weigh as much as n / f independent ones, with

    f(n) = 1 + 2 sum_{k=1}^{n-1} (1 - k/n) rho^k

Source: M. S. Bartlett, "On the theoretical specification and sampling properties of autocorrelated time-series",
1946: the variance of a mean under first-order autoregression.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_LONG_TRACK = 8  # observations; shorter tracks say little about correlation
_MIN_OBSERVATIONS = 100
_MAX_CORRELATION = 0.9
_MAX_SIGMAS = 3.0  # errors beyond are cut off where correlation is measured


def track_lengths(point_index: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
    """For each observation (M,) how many its point has."""
    return np.asarray(np.bincount(point_index)[point_index] if len(point_index) else [], dtype=np.int64)


def variance_inflation(lengths: NDArray[np.int64], correlation: float) -> Array:
    """f(n) of the module's formula, for the lengths n (M,) of tracks."""
    table = np.ones(int(lengths.max(initial=0)) + 1)
    for n in range(2, len(table)):
        k = np.arange(1, n)
        table[n] = 1.0 + 2.0 * float(((1.0 - k / n) * correlation**k).sum())
    return np.asarray(table[lengths])


def track_correlation(
    errors: Array, keyframe_index: NDArray[np.integer[Any]], point_index: NDArray[np.integer[Any]]
) -> float:
    """Of errors (M, 2), in sigmas, from one observation of a track to the next, over long tracks; 0 to 0.9."""
    order = np.lexsort((keyframe_index, point_index))
    cut = np.clip(np.nan_to_num(errors[order]), -_MAX_SIGMAS, _MAX_SIGMAS)
    tracks, lengths = point_index[order], track_lengths(point_index)[order]
    is_long = lengths >= _LONG_TRACK
    follows = (tracks[1:] == tracks[:-1]) & is_long[1:]
    if np.count_nonzero(follows) < _MIN_OBSERVATIONS:
        return 0.0
    measured = (cut[1:] * cut[:-1])[follows].mean() / (cut[is_long] ** 2).mean()
    # The point's fit takes 1.5 degrees of freedom from each coordinate's n errors: white noise measures -1.5 / n.
    return float(np.clip(measured + 1.5 / lengths[is_long].mean(), 0.0, _MAX_CORRELATION))
