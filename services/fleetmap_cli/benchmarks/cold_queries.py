"""Localises images, each on its own, in many maps at once; a process of its own, so that its memory is measurable.

Use it as ``python -m fleetmap_cli.benchmarks.cold_queries --maps FOLDER ... --queries RECORDING.mcap ...``; all
recordings are of one camera; ``--every N`` takes only every n-th image. It prints JSON.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from fleetmap.camera import Camera
from fleetmap.drives import open_drive
from fleetmap_cli.benchmarks.reading import memory_bytes
from fleetmap_localizer.localizer import Localizer
from fleetmap_localizer.map_source import read_map
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.pose_estimate import PoseEstimate
from fleetmap_localizer.settings import LocalizerSettings


def localize_cold(maps: list[Path], recordings: list[Path], every: int = 1) -> dict[str, Any]:
    """Every n-th image of the recordings in all maps: answer, duration, and the process' peak memory."""
    views = _views(maps, open_drive(recordings[0]).camera)
    answers = [answer for path in recordings for answer in _answers(views, path, every)]
    return {
        "answers": answers,
        "landmarks": sum(len(view.content.landmarks) for view in views),
        "memory_bytes": memory_bytes("VmHWM"),
    }


def _views(maps: list[Path], camera: Camera) -> list[MapView]:
    settings = LocalizerSettings()
    return [MapView(read_map(folder), camera, settings) for folder in maps]


def _answers(views: list[MapView], path: Path, every: int) -> Iterator[dict[str, Any]]:
    drive = open_drive(path)
    localizer = Localizer(drive.camera, views)
    for frame in islice(drive.frames(), 0, None, every):
        localizer.forget()
        started = time.perf_counter()
        answer = localizer.localize(frame)
        described: dict[str, Any] = {"recording": path.stem, "stamp_ns": frame.stamp_ns}
        described["duration_s"] = time.perf_counter() - started
        if isinstance(answer, PoseEstimate):
            described |= {"map": answer.map_id, "position_m": answer.utm_from_cam.translation_m.tolist()}
        else:
            described["reason"] = answer.reason
        yield described


def _main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--maps", nargs="+", type=Path, required=True)
    parser.add_argument("--queries", nargs="+", type=Path, required=True)
    parser.add_argument("--every", type=int, default=1)
    given = parser.parse_args()
    print(json.dumps(localize_cold(given.maps, given.queries, given.every)))


if __name__ == "__main__":
    _main()
