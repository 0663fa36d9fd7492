"""A recording replayed as fast as it was recorded, as a vehicle would meet it: what comes too late is dropped."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from fleetmap.drive import Frame


@dataclass(frozen=True)
class Latency:
    """How long after its due time an image's answer was there."""

    median_s: float
    p95_s: float
    max_s: float


class PacedFrames:
    """Frames when they are due. Those that came while another was being worked on are dropped, but for the latest.

    An image is due as long after the first as it was recorded after it, and answered when the next one is asked
    for. Let ``frames`` be read ahead by another thread: a camera's driver, too, decodes what is dropped, and not
    on the localizer's time.
    """

    def __init__(
        self,
        frames: Iterable[Frame],
        now_s: Callable[[], float] = time.monotonic,
        sleep_s: Callable[[float], None] = time.sleep,
    ) -> None:
        """Nothing is read, and no time counts, before the first frame is asked for."""
        self._frames, self._now_s, self._sleep_s = frames, now_s, sleep_s
        self._latencies_s: list[float] = []
        self.dropped_stamps_ns: list[int] = []

    def __iter__(self) -> Iterator[Frame]:
        coming = iter(self._frames)
        frame, following = next(coming, None), next(coming, None)
        if frame is None:
            return
        first_stamp_ns, started_s = frame.stamp_ns, self._now_s()

        def due_s(of: Frame) -> float:
            return started_s + (of.stamp_ns - first_stamp_ns) * 1e-9

        while frame is not None:
            while following is not None and due_s(following) <= self._now_s():
                self.dropped_stamps_ns.append(frame.stamp_ns)
                frame, following = following, next(coming, None)
            if (early_s := due_s(frame) - self._now_s()) > 0.0:
                self._sleep_s(early_s)
            yield frame
            self._latencies_s.append(self._now_s() - due_s(frame))
            frame, following = following, next(coming, None)

    @property
    def latency(self) -> Latency | None:
        """Of the images answered so far; None before there is one."""
        if not self._latencies_s:
            return None
        median_s, p95_s, max_s = np.percentile(self._latencies_s, [50.0, 95.0, 100.0])
        return Latency(float(median_s), float(p95_s), float(max_s))
