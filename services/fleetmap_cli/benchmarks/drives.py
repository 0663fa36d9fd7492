"""``fleetmap benchmark drives``: recordings, the simulated world, and what the fixes alone would give."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import RunError
from fleetmap.vision.trackability import Trackability
from fleetmap_cli.benchmarks.large_recording import free_bytes, write_large_recording
from fleetmap_cli.benchmarks.row import Benchmark, Figures, Row
from fleetmap_cli.benchmarks.workbench import CannotMeasureHereError, Workbench
from fleetmap_cli.benchmarks.worlds import KITTI_CAMERA, image_of, trackability_of, write_kitti_camera
from fleetmap_cli.plotting import new_figure, save_figure

ODOMETRY = "drives/kitti_odo_00_first300"
RAW = "drives/kitti_raw_20110926_1405"
_IMAGE_COUNT = 60  # of each drive, for trackability
_LATE_S = 0.15  # the fixes' stamps, behind the camera's
_LARGE_BYTES = 4_200_000_000
_LARGE_NEEDS_BYTES = 6_000_000_000


def _fair_world(bench: Workbench) -> Figures:
    """Trackability of a simulated drive beside that of the two real ones."""
    bench.fleetmap(f"convert kitti-odometry DATA/{ODOMETRY} odometry.mcap")
    bench.fleetmap(f"convert kitti-raw DATA/{RAW} raw.mcap --camera 0")
    _simulate(bench, "simulated.mcap", length_m=100)
    bench.shown("fleetmap benchmark drives --rows fair-world")
    real = {name: trackability_of(bench.folder / f"{name}.mcap", _IMAGE_COUNT) for name in ("odometry", "raw")}
    simulated = trackability_of(bench.folder / "simulated.mcap", _IMAGE_COUNT)
    factors = {name: simulated.factor_to(measured) for name, measured in real.items()}
    figures: Figures = {"largest factor": round(max(max(each.values()) for each in factors.values()), 2)}
    for name, measured in {**real, "simulated": simulated}.items():
        figures |= _described(name, measured)
    for name, each in factors.items():
        figures |= {f"factor to {name}, {figure}": round(factor, 2) for figure, factor in each.items()}
    return figures


def _described(name: str, measured: Trackability) -> Figures:
    return {
        f"{name}: features per megapixel": round(measured.features_per_megapixel),
        f"{name}: match ratio": round(measured.match_ratio, 3),
        f"{name}: track length (images)": round(measured.track_length, 2),
    }


def _frames(bench: Workbench) -> Figures:
    """A real and a simulated image, one below the other."""
    bench.fleetmap(f"convert kitti-odometry DATA/{ODOMETRY} odometry.mcap")
    _simulate(bench, "simulated.mcap", length_m=60)
    real, simulated = (image_of(bench.folder / f"{name}.mcap", 30) for name in ("odometry", "simulated"))
    _draw_side_by_side(bench.picture("frames.png"), real, simulated)
    return {"real grey level": round(float(real.mean())), "simulated grey level": round(float(simulated.mean()))}


def _draw_side_by_side(path: Path, real: NDArray[np.uint8], simulated: NDArray[np.uint8]) -> None:
    figure = new_figure(width_in=12.4, height_in=8.4)
    titles = ["KITTI odometry 00 (Geiger et al., CVPR 2012; CC BY-NC-SA 3.0)", "fleetmap simulate"]
    for axes, image, title in zip(figure.subplots(2, 1), (real, simulated), titles, strict=True):
        axes.imshow(image, cmap="gray", vmin=0, vmax=255)
        axes.set_title(title, fontsize="small")
        axes.set_axis_off()
    save_figure(figure, path)


def _rendering_speed(bench: Workbench) -> Figures:
    """Images a second of a whole run of ``fleetmap simulate``, its start included."""
    run = _simulate(bench, "simulated.mcap", length_m=300)
    frames = _image_count(bench, "simulated.mcap")
    return {"images": frames, "size": "1241x376", "frames/s": round(frames / run.duration_s, 1)}


def _large_file(bench: Workbench) -> Figures:
    """A recording of more than 4 GB, read to its end."""
    free = free_bytes(bench.folder)
    if free < _LARGE_NEEDS_BYTES:
        raise CannotMeasureHereError(
            f"needs {_LARGE_NEEDS_BYTES / 1e9:g} GB of free disk; there are {free / 1e9:.1f}"
        )
    jpegs = [path.read_bytes() for path in sorted((bench.data / ODOMETRY / "cam0").glob("*.jpg"))]
    if not jpegs:
        raise CannotMeasureHereError(f"needs JPEG images in DATA/{ODOMETRY}/cam0")
    bench.shown("fleetmap benchmark drives --rows large-file")
    count = write_large_recording(bench.folder / "large.mcap", jpegs, KITTI_CAMERA, _LARGE_BYTES)
    read = bench.python_module("fleetmap_cli.benchmarks.reading", "large.mcap").json()
    if read["images"] != count:
        raise RunError(f"{read['images']} images were read of the {count} written")
    return {
        "size GB": round(read["size_bytes"] / 1e9, 2),
        "images": count,
        "reader memory MB": round(read["memory_bytes"] / 1e6),
        "read and decoded MB/s": round(read["size_bytes"] / read["duration_s"] / 1e6, 1),
        "images/s": round(count / read["duration_s"]),
    }


def _spline(gnss: str) -> Any:
    """What a smoothing spline through the fixes of one receiver gives on KITTI odometry 00."""

    def measure(bench: Workbench) -> Figures:
        bench.fleetmap(f"convert kitti-odometry DATA/{ODOMETRY} o00.mcap {gnss} --seed 7")
        judged = bench.fleetmap(
            "evaluate o00.reference.tum o00.reference.tum --spline-through o00.mcap --json"
        ).json()
        figures: Figures = {}
        for key, name in (("smoothing_spline", "smoothing spline"), ("spline", "cubic spline")):
            figures[f"{name} mean m"] = round(judged[key]["position_m"]["mean"], 3)
            figures[f"{name} max m"] = round(judged[key]["position_m"]["max"], 3)
        return figures

    return measure


def _clock_offset(bench: Workbench) -> Figures:
    """An offset between the clocks of camera and receiver, found again from the vehicle's motion."""
    _simulate(bench, "clocks.mcap", length_m=300, options=f"--gnss-interval-s 0.2 --gnss-clock-offset-s {_LATE_S}")
    found = bench.fleetmap("info clocks.mcap --json").json()
    if found["clock_offset_s"] is None:
        raise RunError(f"info did not see the offset: {found['clock_offset_reason']}")
    true_s = -_LATE_S  # info counts the camera's stamp minus the receiver's
    return {
        "true ms": round(1e3 * true_s),
        "found ms": round(1e3 * found["clock_offset_s"], 1),
        "sigma ms": round(1e3 * found["clock_offset_sigma_s"], 1),
        "error ms": round(1e3 * abs(found["clock_offset_s"] - true_s), 1),
    }


def _simulate(bench: Workbench, name: str, *, length_m: int, options: str = "--gnss rtk") -> Any:
    camera = write_kitti_camera(bench)
    return bench.fleetmap(
        f"simulate {name} --world 1 --drive 1 --length-m {length_m} --speed-mps 8 --camera {camera} {options}"
    )


def _image_count(bench: Workbench, name: str) -> int:
    images = bench.fleetmap(f"info {name} --quick --json").json()["images"]
    return int(images["count"])


BENCHMARK = Benchmark(
    "drives",
    "recordings, the simulated world, and what GNSS fixes alone would give",
    (
        Row("fair-world", "a simulated drive is as hard to track as a real one", _fair_world, (ODOMETRY, RAW)),
        Row("frames", "a real and a simulated image", _frames, (ODOMETRY,)),
        Row("rendering-speed", "images rendered a second", _rendering_speed),
        Row("large-file", "a recording of 4.2 GB is read in bounded memory", _large_file, (ODOMETRY,)),
        Row("spline-rtk", "fixes of 5 cm at 10 Hz alone", _spline("--gnss-error rtk"), (ODOMETRY,)),
        Row(
            "spline-rtk-5s",
            "fixes of 5 cm every 5 s alone",
            _spline("--gnss-error rtk --gnss-interval-s 5"),
            (ODOMETRY,),
        ),
        Row("spline-consumer", "consumer fixes at 10 Hz alone", _spline("--gnss-error consumer"), (ODOMETRY,)),
        Row("clock-offset", "fixes stamped 150 ms late, found by motion", _clock_offset),
    ),
)
