"""How far a figure would scatter had the drive been another of the same kind: bootstrap intervals over segments.

Errors of neighbouring poses are alike, so poses must not be drawn one by one: that would fake certainty. Whole
segments of the road are drawn instead, with replacement, and every figure is computed again from each draw.

Sources: B. Efron, R. J. Tibshirani, "An Introduction to the Bootstrap", 1993, chapter 13 (percentile intervals);
H. R. Kuensch, "The jackknife and the bootstrap for general stationary observations", Annals of Statistics 17(3),
1989 (blocks); T. Hesterberg, "What teachers should know about the bootstrap", The American Statistician 69(4),
2015, section 5.3 (percentiles widened by Student's t, since few segments scatter less than the road does).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Interval = tuple[float, float]

CONFIDENCE = 0.95
# Longer than the way between two fixes and than a localizer's track of one landmark: what is alike stays together.
SEGMENT_M = 50.0
DRAWS = 2000
_CHUNK = 100  # draws at a time: a long drive's weights need not fit in memory at once


@dataclass(frozen=True)
class SegmentBootstrap:
    """Draws of a road's segments, the same for every figure of one drive."""

    segment_of: Indices  # (M,) segment that each pose of the road lies in
    segment_m: float  # length of each
    draws: NDArray[np.int64]  # (D, S) how often each draw holds each segment

    @staticmethod
    def along(road_m: Array, segment_m: float = SEGMENT_M, seed: int = 0) -> SegmentBootstrap:
        """Cut a road into as many equal segments of at least ``segment_m`` as fit; one, where not even two do.

        ``road_m`` (M,), M >= 1, is the way driven up to each pose. The same seed gives the same draws.
        """
        length_m = float(road_m[-1] - road_m[0])
        count = max(int((length_m + 1e-9) // segment_m), 1)
        shares = (road_m - road_m[0]) / max(length_m, 1e-9)
        segment_of = np.minimum((shares * count).astype(np.intp), count - 1)
        draws = np.random.default_rng(seed).multinomial(count, np.full(count, 1.0 / count), size=DRAWS)
        return SegmentBootstrap(segment_of, length_m / count, draws)

    @property
    def segments(self) -> int:
        """How many segments the road has."""
        return int(self.draws.shape[1])

    def statistics(self, errors: Array, segment_of: Indices) -> dict[str, Interval | None]:
        """Intervals of mean, median, RMSE and 95th percentile of errors (N,) in the given segments (N,)."""
        squares = self._means(errors**2, segment_of)
        median, p95 = self._quantiles(errors, segment_of, (0.5, 0.95))
        replicates = {
            "mean": self._means(errors, segment_of),
            "median": median,
            "rmse": np.sqrt(squares),
            "p95": p95,
        }
        return {name: self._interval(values, segment_of) for name, values in replicates.items()}

    def mean(self, values: Array, segment_of: Indices) -> Interval | None:
        """Interval of the mean of values (N,) in the given segments (N,); None where they fill only one."""
        return self._interval(self._means(values, segment_of), segment_of)

    def _means(self, values: Array, segment_of: Indices) -> Array:
        """The mean (D,) of each draw; NaN where a draw holds no value."""
        sums = np.bincount(segment_of, values, minlength=self.segments)
        counts = np.bincount(segment_of, minlength=self.segments)
        drawn = self.draws @ counts
        return np.where(drawn > 0, self.draws @ sums / np.maximum(drawn, 1), np.nan)

    def _quantiles(self, values: Array, segment_of: Indices, shares: tuple[float, ...]) -> Array:
        """Quantiles (Q, D) of each draw, between neighbours as numpy's; NaN where a draw holds no value."""
        order = np.argsort(values)
        chunks = [
            _repeated_quantiles(values[order], np.cumsum(draws[:, segment_of[order]], axis=1), shares)
            for draws in self._chunks()
        ]
        return np.concatenate(chunks, axis=1)

    def _chunks(self) -> Iterator[NDArray[np.int64]]:
        for start in range(0, len(self.draws), _CHUNK):
            yield self.draws[start : start + _CHUNK]

    def _interval(self, replicates: Array, segment_of: Indices) -> Interval | None:
        filled = len(np.unique(segment_of))
        if filled < 2:
            return None
        wide = -np.sqrt(filled / (filled - 1)) * stdtrit(filled - 1, 0.5 + 0.5 * CONFIDENCE)
        outside = float(ndtr(wide))
        low, high = np.nanquantile(replicates, [outside, 1.0 - outside])
        return float(low), float(high)


def _repeated_quantiles(ordered: Array, up_to: NDArray[np.int64], shares: tuple[float, ...]) -> Array:
    """Quantiles (Q, D) of ordered values (N,), repeated so that ``up_to`` (D, N) counts all up to each."""
    total = up_to[:, -1]
    quantiles = np.full((len(shares), len(up_to)), np.nan)
    for row, share in zip(quantiles, shares, strict=True):
        place = share * np.maximum(total - 1, 0)
        below = np.floor(place).astype(np.int64)
        first, second = (
            ordered[np.minimum((up_to <= rank[:, None]).sum(axis=1), len(ordered) - 1)]
            for rank in (below, np.minimum(below + 1, total - 1))
        )
        row[total > 0] = (first + (place - below) * (second - first))[total > 0]
    return quantiles
