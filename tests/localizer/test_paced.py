"""Replay at recorded speed, on a clock that goes on only when somebody works or sleeps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from fleetmap.drive import Frame
from fleetmap_localizer.paced import PacedFrames


class Clock:
    """Time as the test has it."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, duration_s: float) -> None:
        assert duration_s > 0.0
        self.now_s += duration_s


def frames(count: int, interval_s: float = 0.1) -> list[Frame]:
    return [Frame(10**18 + round(i * interval_s * 1e9), np.zeros((1, 1), np.uint8)) for i in range(count)]


def replay(count: int, work_s: list[float]) -> tuple[list[tuple[int, float]], PacedFrames]:
    """Frames handed out, as number and time since the start, to somebody who takes so long for each in turn."""
    clock = Clock()
    paced = PacedFrames(frames(count), clock, clock.sleep)
    seen = []
    works = iter(work_s)
    for frame in paced:
        seen.append((round((frame.stamp_ns - 10**18) / 1e8), clock.now_s - 1000.0))
        clock.now_s += next(works)
    return seen, paced


def test_a_fast_localizer_gets_every_image_when_it_is_due() -> None:
    seen, paced = replay(5, [0.03, 0.05, 0.02, 0.05, 0.01])
    assert [number for number, _ in seen] == [0, 1, 2, 3, 4]
    assert [at_s for _, at_s in seen] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert paced.dropped_stamps_ns == []
    assert paced.latency is not None
    assert paced.latency.median_s == pytest.approx(0.03)
    assert paced.latency.max_s == pytest.approx(0.05)


def test_what_came_meanwhile_is_dropped_but_for_the_latest() -> None:
    """Busy for 0.35 s with the first image: 1 and 2 are out of date when it is done, and 3 is 0.05 s old."""
    seen, paced = replay(6, [0.35, 0.03, 0.03, 0.03])
    assert [number for number, _ in seen] == [0, 3, 4, 5]
    assert [at_s for _, at_s in seen] == pytest.approx([0.0, 0.35, 0.4, 0.5])
    assert [(stamp_ns - 10**18) // 10**8 for stamp_ns in paced.dropped_stamps_ns] == [1, 2]
    assert paced.latency is not None
    assert paced.latency.max_s == pytest.approx(0.35)
    assert paced.latency.p95_s < 0.35


def test_latency_counts_from_when_an_image_was_due_not_from_when_it_was_taken_up() -> None:
    _, paced = replay(3, [0.18, 0.04, 0.01])
    # 0: 0.18; 1: taken up 0.08 late, done after 0.12; 2: due at 0.2, taken up at 0.22, done after 0.03
    assert paced.latency is not None
    assert paced.latency.max_s == pytest.approx(0.18)
    assert paced.latency.median_s == pytest.approx(0.12)


def test_the_backlog_of_a_slow_localizer_does_not_grow() -> None:
    seen, paced = replay(100, [0.25] * 100)
    assert 38 <= len(seen) <= 42
    assert len(seen) + len(paced.dropped_stamps_ns) == 100
    assert paced.latency is not None
    assert 0.25 <= paced.latency.max_s < 0.36  # one image in work, and less than one interval


def test_nothing_is_read_before_it_is_asked_for_and_no_frames_are_no_replay() -> None:
    def broken() -> Iterator[Frame]:
        raise AssertionError("read too early")
        yield from frames(1)

    PacedFrames(broken())
    paced = PacedFrames([])
    assert list(paced) == []
    assert paced.latency is None
