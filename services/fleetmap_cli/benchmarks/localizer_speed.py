"""How long a localizer takes for an image, and where the time goes."""

from __future__ import annotations

from typing import Any

from fleetmap_cli.benchmarks.localizer_drives import camera_1
from fleetmap_cli.benchmarks.mapper_drives import RAW
from fleetmap_cli.benchmarks.mapper_runs import rounded
from fleetmap_cli.benchmarks.row import Figures, Group, Row, Value
from fleetmap_cli.benchmarks.workbench import Workbench

SPEED = Group(
    "A localizer's time for an image",
    "Camera 1 of KITTI raw at its recorded size, 1392x512, in camera 0's map of 0.3 km: from the decoded image to "
    "the pose with its covariance, medians of all images. *ms*: one image after the other, by the wall clock; "
    "*CPU*: processor time of all threads; then the parts of the wall clock's. *Images/s*: the whole drive, the "
    "next image's features being found on the second core meanwhile.",
    (
        "ms",
        "p95 ms",
        "CPU ms",
        "features ms",
        "places ms",
        "matching ms",
        "pose ms",
        "other ms",
        "images/s",
        "posed",
    ),
)
_PEERS: dict[str, dict[str, dict[str, Value]]] = {
    "own": {"stella_vslam": {"ms": 42}, "COLMAP": {"ms": 1900}},
    "tracking": {"stella_vslam": {"ms": 21}, "ORB-SLAM3": {"ms": 28.5}},
}


def _own(bench: Workbench) -> Figures:
    return _figures(bench, "own", _times(bench))


def _tracking(bench: Workbench) -> Figures:
    times = _times(bench)
    return _figures(bench, "tracking", times) | {"images/s": rounded(times["images_per_s"], 1)}


def _figures(bench: Workbench, kind: str, times: Any) -> Figures:
    for peer, figures in _PEERS[kind].items():
        bench.beside(peer, dict(figures))
    of_kind = times[kind]
    return {
        "ms": rounded(of_kind["median_ms"], 1),
        "p95 ms": rounded(of_kind["p95_ms"], 1),
        "CPU ms": rounded(of_kind["cpu_ms"], 1),
        **{f"{stage} ms": rounded(value, 1) for stage, value in of_kind["stages_ms"].items()},
        "posed": f"{of_kind['posed']} of {times['images']}",
        "image": times["size"],
    }


def _times(bench: Workbench) -> Any:
    queries = camera_1(bench)
    arguments = f"{queries.name}.mcap {queries.survey}-map"
    return bench.python_module("fleetmap_cli.benchmarks.localizing", arguments).json()


ROWS = (
    Row("speed-own", "every image a query on its own", _own, (RAW,), SPEED, "<= 45 ms"),
    Row("speed-tracking", "one image after the other", _tracking, (RAW,), SPEED, ">= 48 images/s"),
)
