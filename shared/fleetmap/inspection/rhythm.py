"""How regularly stamps follow each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_GAP_STEPS = 2.5  # a step longer than this many usual ones is a gap


@dataclass(frozen=True)
class Rhythm:
    """Of two stamps or more."""

    rate_hz: float  # between gaps: of the median step
    longest_gap_s: float
    gap_count: int
    missing_share: float  # of the samples that an unbroken recording of the same length would hold
    late_count: int  # not later than the one before


def rhythm_of(stamps_ns: Sequence[int] | NDArray[np.int64]) -> Rhythm | None:
    """The rhythm of stamps in the order of the recording; None where there are fewer than two different ones."""
    given = np.asarray(stamps_ns, dtype=np.int64)
    ordered = np.unique(given)
    if len(ordered) < 2:
        return None
    steps_s = np.diff(ordered) * 1e-9
    usual_s = float(np.median(steps_s))
    gaps_s = steps_s[steps_s > _GAP_STEPS * usual_s]
    missing = float(np.sum(gaps_s / usual_s - 1.0))
    return Rhythm(
        rate_hz=1.0 / usual_s,
        longest_gap_s=float(steps_s.max()),
        gap_count=len(gaps_s),
        missing_share=missing / (missing + len(ordered)),
        late_count=int(np.count_nonzero(np.diff(given) <= 0)),
    )
