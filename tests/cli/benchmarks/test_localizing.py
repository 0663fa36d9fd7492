"""The times of a localizer's stages add up, and measuring leaves the localizer as it was."""

from __future__ import annotations

import time

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap_cli.benchmarks import localizing
from fleetmap_cli.benchmarks.localizing import time_queries

CAMERA = Camera(200, 120, 150.0, 150.0, 99.5, 59.5)


def test_stages_and_the_rest_are_the_whole_and_nothing_stays_wrapped() -> None:
    rng = np.random.default_rng(0)
    frames = [Frame(10**8 * i, rng.integers(0, 256, (120, 200)).astype(np.uint8)) for i in range(6)]
    before = [getattr(owner, name) for _, owner, name in localizing._STAGES]
    times = time_queries(frames, CAMERA, [])
    assert [getattr(owner, name) for _, owner, name in localizing._STAGES] == before
    assert (times["size"], times["images"]) == ("200x120", 6)
    assert 1.0 < times["images_per_s"] < 1e5
    for kind in ("own", "tracking"):
        of_kind = times[kind]
        assert of_kind["posed"] == 0  # without any map
        assert sum(of_kind["stages_ms"].values()) == pytest.approx(of_kind["median_ms"])
        assert 0.0 < of_kind["stages_ms"]["features"] <= of_kind["median_ms"] <= of_kind["p95_ms"]
        assert of_kind["stages_ms"]["pose"] == 0.0


def test_a_stage_within_a_stage_is_counted_once() -> None:
    seconds = {"outer": 0.0, "inner": 0.0}

    def spend(duration_s: float) -> None:
        end_s = time.perf_counter() + duration_s
        while time.perf_counter() < end_s:
            pass

    inner = localizing._timed(spend, "inner", seconds)

    def work() -> str:
        spend(0.002)
        inner(0.004)
        return "done"

    started_s = time.perf_counter()
    assert localizing._timed(work, "outer", seconds)() == "done"
    assert seconds["inner"] >= 0.004
    assert seconds["outer"] >= 0.002
    assert sum(seconds.values()) <= time.perf_counter() - started_s
