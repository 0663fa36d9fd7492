"""Localises the images of a recording and says where the time goes; a process of its own, to be measurable.

Use it as ``python -m fleetmap_cli.benchmarks.localizing RECORDING.mcap MAP_FOLDER``. All times are of the wall
clock, on decoded images, compiled code warm; beside them the processor's, which a busy machine does not stretch as
much. What a stage took is what its functions took, one within another counted once; *other* is what is left.
"""

from __future__ import annotations

import functools
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.drives import open_drive
from fleetmap.vision.features import FeatureExtractor
from fleetmap_localizer import fitting, relocalization
from fleetmap_localizer.feature_stream import with_features
from fleetmap_localizer.local_map import LocalMap
from fleetmap_localizer.localizer import Localizer
from fleetmap_localizer.map_source import read_map
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.pose_estimate import PoseEstimate
from fleetmap_localizer.settings import LocalizerSettings

_WARM_UP_IMAGES = 5
_STAGES: tuple[tuple[str, Any, str], ...] = (
    ("features", FeatureExtractor, "pyramid"),
    ("features", FeatureExtractor, "extract_from"),
    ("places", relocalization, "PlaceSearch"),
    ("matching", relocalization, "match_descriptors"),
    ("matching", fitting, "match_by_projection"),
    ("matching", fitting, "match_along"),
    ("matching", LocalMap, "landmarks_around"),
    ("matching", LocalMap, "predict"),
    ("likeness", relocalization, "likeness_at"),
    ("pose", relocalization, "estimate_absolute_pose"),
    ("pose", fitting, "refine_absolute_pose"),
    ("pose", fitting, "relative_covariance"),
)


def time_queries(frames: Sequence[Frame], camera: Camera, views: Sequence[MapView]) -> dict[str, Any]:
    """Each image as a query on its own, then the drive tracked; then as fast as it goes, on two threads."""
    settings = LocalizerSettings()
    localizer = Localizer(camera, views, settings)
    for independent in (True, False):
        _localize(localizer, frames[:_WARM_UP_IMAGES], independent=independent)
    times = {
        name: _localize(localizer, frames, independent=independent)
        for name, independent in (("own", True), ("tracking", False))
    }
    localizer.forget()
    started_s = time.perf_counter()
    for image in with_features(frames, camera, settings.features):
        localizer.localize_image(image)
    return {
        "size": f"{camera.width_px}x{camera.height_px}",
        "images": len(frames),
        **times,
        "images_per_s": len(frames) / (time.perf_counter() - started_s),
    }


def _localize(localizer: Localizer, frames: Sequence[Frame], *, independent: bool) -> dict[str, Any]:
    """How long images take, and how many get a pose."""
    localizer.forget()
    durations_ms, cpu_ms, stages_ms, posed = [], [], [], 0
    with _stage_clock() as stage_s:
        for frame in frames:
            if independent:
                localizer.forget()
            stage_s.update(dict.fromkeys(stage_s, 0.0))
            started_s, started_cpu_s = time.perf_counter(), time.process_time()
            answer = localizer.localize(frame)
            durations_ms.append(1e3 * (time.perf_counter() - started_s))
            cpu_ms.append(1e3 * (time.process_time() - started_cpu_s))
            stages_ms.append([1e3 * seconds for seconds in stage_s.values()])
            posed += isinstance(answer, PoseEstimate)
        names = list(stage_s)
    median_ms = float(np.median(durations_ms))
    by_stage = dict(zip(names, np.median(stages_ms, axis=0).tolist(), strict=True))
    return {
        "posed": posed,
        "median_ms": median_ms,
        "p95_ms": float(np.percentile(durations_ms, 95.0)),
        "cpu_ms": float(np.median(cpu_ms)),
        "stages_ms": by_stage | {"other": median_ms - sum(by_stage.values())},
    }


@contextmanager
def _stage_clock() -> Iterator[dict[str, float]]:
    """Seconds spent in each stage while inside, to be set back at will."""
    seconds = {stage: 0.0 for stage, _, _ in _STAGES}
    originals = [getattr(owner, name) for _, owner, name in _STAGES]
    for (stage, owner, name), original in zip(_STAGES, originals, strict=True):
        setattr(owner, name, _timed(original, stage, seconds))
    try:
        yield seconds
    finally:
        for (_, owner, name), original in zip(_STAGES, originals, strict=True):
            setattr(owner, name, original)


def _timed(function: Callable[..., Any], stage: str, seconds: dict[str, float]) -> Callable[..., Any]:
    @functools.wraps(function)
    def timed(*arguments: Any, **options: Any) -> Any:
        before_s, started_s = sum(seconds.values()), time.perf_counter()
        try:
            return function(*arguments, **options)
        finally:
            within_s = sum(seconds.values()) - before_s
            seconds[stage] += time.perf_counter() - started_s - within_s

    return timed


def main(recording: Path, map_folder: Path) -> None:
    """Print the times as JSON."""
    drive = open_drive(recording)
    view = MapView(read_map(map_folder), drive.camera, LocalizerSettings())
    print(json.dumps(time_queries(list(islice(drive.frames(), 400)), drive.camera, [view])))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
