"""A drive's motion sensors, read along with its images: each sample once, in time order, one ahead."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from fleetmap.drive import ImuSample

Array = NDArray[np.float64]


class _Stamped(Protocol):
    @property
    def stamp_ns(self) -> int: ...


S = TypeVar("S", bound=_Stamped)


class SensorStream(Generic[S]):
    """Samples in time order, of which the next can be looked at."""

    def __init__(self, samples: Iterable[S]) -> None:
        self._samples = iter(samples)
        self.next: S | None = next(self._samples, None)

    def take_until(self, stamp_ns: int) -> S | None:
        """The next sample, if it is not later."""
        sample = self.next
        if sample is None or sample.stamp_ns > stamp_ns:
            return None
        self.next = next(self._samples, None)
        return sample

    def skip_until(self, stamp_ns: int) -> S | None:
        """Drop all samples that are not later; the last of them."""
        last = None
        while (sample := self.take_until(stamp_ns)) is not None:
            last = sample
        return last


class ImuStream:
    """What an IMU measured between any two moments, from samples that are joined by straight lines."""

    def __init__(self, samples: Iterable[ImuSample], longest_pause_s: float) -> None:
        self._stream = SensorStream(samples)
        self._before: ImuSample | None = None
        self._longest_pause_s = longest_pause_s

    def skip_until(self, stamp_ns: int) -> None:
        """Drop what was measured before."""
        self._before = self._stream.skip_until(stamp_ns) or self._before

    def between(self, start_ns: int, end_ns: int) -> Iterator[tuple[Array, Array, float] | None]:
        """Piece by piece: mean turn rate (3,) in rad/s and specific force (3,) in m/s2, and for how many seconds.

        None, once and at the end, where the IMU pauses for so long that nothing is known of the motion.
        """
        at_ns = start_ns
        while at_ns < end_ns:
            self.skip_until(at_ns)
            before, after = self._before, self._stream.next
            to_ns = end_ns if after is None else min(end_ns, after.stamp_ns)
            if before is None or self._is_pause(before, to_ns if after is None else after.stamp_ns):
                yield None
                return
            yield (
                *_mean(before, after, 0.5 * (at_ns - before.stamp_ns) + 0.5 * (to_ns - before.stamp_ns)),
                ((to_ns - at_ns) * 1e-9),
            )
            at_ns = to_ns

    def _is_pause(self, before: ImuSample, to_ns: int) -> bool:
        return (to_ns - before.stamp_ns) * 1e-9 > self._longest_pause_s


def _mean(before: ImuSample, after: ImuSample | None, since_before_ns: float) -> tuple[Array, Array]:
    """The measurements at a moment; the last one's when no other follows."""
    if after is None:
        return before.angular_velocity_rad_s, before.linear_acceleration_m_s2
    share = since_before_ns / (after.stamp_ns - before.stamp_ns)
    return (
        (1.0 - share) * before.angular_velocity_rad_s + share * after.angular_velocity_rad_s,
        (1.0 - share) * before.linear_acceleration_m_s2 + share * after.linear_acceleration_m_s2,
    )
