"""Times of stages add up, also where a stage fails."""

from __future__ import annotations

import time

import pytest

from fleetmap_mapper.stage_times import StageTimes


def work(seconds: float) -> None:
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        pass


def test_every_visit_to_a_stage_counts():
    times = StageTimes()
    for _ in range(2):
        with times.stage("tracking"):
            work(0.01)
    with pytest.raises(ZeroDivisionError), times.stage("fusing"):
        work(1.0 / 0.0)
    assert 0.02 <= times.seconds["tracking"] < 1.0
    assert 0.0 < times.seconds["fusing"] < 1.0
    assert str(StageTimes()) == ""
    times.seconds["fusing"] = 1.25
    times.seconds["tracking"] = 12.0
    assert str(times) == "tracking 12.0 s, fusing 1.2 s"
