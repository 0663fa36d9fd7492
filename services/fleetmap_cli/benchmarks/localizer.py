"""``fleetmap benchmark localizer``: a second camera in the map of the first."""

from __future__ import annotations

from fleetmap_cli.benchmarks.row import Benchmark, Figures, Row
from fleetmap_cli.benchmarks.workbench import Workbench

RAW = "drives/kitti_raw_20110926_1405"
_CAMERA_OFFSET = "0.5371,0.0053,-0.0040"  # of camera 1 in camera 0, from KITTI's calibration


def _second_camera(bench: Workbench) -> Figures:
    """Camera 1 of KITTI raw in the map of camera 0."""
    bench.fleetmap(f"convert kitti-raw DATA/{RAW} survey.mcap --camera 0")
    bench.fleetmap(f"convert kitti-raw DATA/{RAW} second.mcap --camera 1 --no-gnss")
    bench.fleetmap("map survey.mcap --output survey_map --trajectory survey.tum")
    run = bench.fleetmap("localize second.mcap --map survey_map --trajectory second.tum")
    against = f"--against-map survey.tum --camera-offset {_CAMERA_OFFSET}"
    judged = bench.fleetmap(f"evaluate second.tum second.reference.tum {against} --json").json()
    posed = sum(1 for line in (bench.folder / "second.tum").read_text().splitlines() if not line.startswith("#"))
    images = bench.fleetmap("info second.mcap --quick --json").json()["images"]["count"]
    relative = judged["against_map"]["position_m"]
    return {
        "posed": f"{posed} of {images}",
        "median to the map m": round(relative["median"], 3),
        "p95 to the map m": round(relative["p95"], 3),
        "max to the map m": round(relative["max"], 3),
        "mean to the reference m": round(judged["reference"]["position_m"]["mean"], 3),
        "ms an image, start included": round(1e3 * run.duration_s / images),
    }


BENCHMARK = Benchmark(
    "localizer",
    "images of one vehicle in the map of another",
    (Row("second-camera", "camera 1 in the map of camera 0", _second_camera, (RAW,)),),
)
