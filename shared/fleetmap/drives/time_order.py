"""Samples in time order, out of a recording that is only nearly so."""

from __future__ import annotations

import heapq
import logging
from collections.abc import Iterable, Iterator
from typing import Protocol, TypeVar

_log = logging.getLogger(__name__)

_WINDOW = 1000  # samples held back: a second of a fast IMU


class _Stamped(Protocol):
    @property
    def stamp_ns(self) -> int: ...


S = TypeVar("S", bound=_Stamped)


def in_time_order(samples: Iterable[S], source: str) -> Iterator[S]:
    """Samples by their stamps, one of each; those that come very late are left out with a warning at the end.

    Recordings are in the order in which messages arrived; drivers send in batches, threads overtake each other.
    """
    held: list[tuple[int, int, S]] = []
    last_ns, late = -1, 0
    for number, sample in enumerate(samples):
        if sample.stamp_ns < last_ns:
            late += 1
            continue
        heapq.heappush(held, (sample.stamp_ns, number, sample))
        if len(held) > _WINDOW:
            stamp_ns, _, first = heapq.heappop(held)
            if stamp_ns > last_ns:
                last_ns = stamp_ns
                yield first
    for stamp_ns, _, first in sorted(held):
        if stamp_ns > last_ns:
            last_ns = stamp_ns
            yield first
    if late:
        _log.warning("%s: %d samples came far too late and are left out", source, late)
