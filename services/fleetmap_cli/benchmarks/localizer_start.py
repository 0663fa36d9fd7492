"""How long a vehicle that knows nothing waits for its first pose, from the start of its process on."""

from __future__ import annotations

import resource
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from fleetmap.drives import open_drive
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.errors import RunError
from fleetmap.map_package import open_package
from fleetmap_cli.benchmarks.localizer_drives import SimulatedDrives
from fleetmap_cli.benchmarks.mapper_drives import RAW
from fleetmap_cli.benchmarks.row import Figures, Group, Row
from fleetmap_cli.benchmarks.server_process import map_server
from fleetmap_cli.benchmarks.workbench import Workbench

START = Group(
    "The first pose after the start",
    "The wall clock of a whole `fleetmap localize` of one image in a process of its own: start, connecting, "
    "fetching, decoding, the pose, writing it, and the end. A `fleetmap serve` in a process of its own on the "
    "same machine; compiled code is warm. The median and the slowest of five runs, in turn with those of the "
    "other lines; *processor s*: what the run takes of all cores together, which a busy machine stretches less.",
    ("first pose s", "slowest s", "processor s"),
)
_RUNS = 5
_REACH = "<= 2 s, no map cached"
_IMAGE, _OUTPUT, _CACHE = "one.mcap", "one.csv", "start-cache"


def start_rows(simulated: SimulatedDrives) -> tuple[Row, ...]:
    """One on a real drive and one on a simulated."""
    return (
        Row("first-pose-raw", "camera 1 in camera 0's map of KITTI raw 14:05", _raw, (RAW,), START, _REACH),
        Row("first-pose-simulated", "the simulated second vehicle", _simulated(simulated), (), START, _REACH),
    )


def _raw(bench: Workbench) -> Figures:
    bench.once(f"convert kitti-raw DATA/{RAW} survey.mcap --camera 0")
    bench.once(f"convert kitti-raw DATA/{RAW} second.mcap --camera 1 --no-gnss")
    bench.once("map survey.mcap --output survey-map --trajectory survey.tum", accepted_codes=(0, 3))
    return _first_pose(bench, "second.mcap", "survey-map")


def _simulated(drives: SimulatedDrives) -> Callable[[Workbench], Figures]:
    def measure(bench: Workbench) -> Figures:
        drives.make(bench)
        return _first_pose(bench, "sim-second.mcap", "sim-survey-map")

    return measure


def _first_pose(bench: Workbench, recording: str, package: str) -> Figures:
    """Of an image amid a recording: with a prior and without, cached, and from the folder."""
    localize = f"localize {_IMAGE} --output {_OUTPUT}"
    near = _take_image_with_pose(bench, recording, package, f"{localize} --map {package}")
    with map_server(bench.folder) as server:
        bench.fleetmap(f"publish {package} --server {server.endpoint}")
        fetched = f"{localize} --server {server.endpoint} --cache {_CACHE}"
        ways = {
            "--near, nothing cached": (f"{fetched} --near {near}", True),
            "anywhere, nothing cached": (fetched, True),
            "--near, all cached": (f"{fetched} --near {near}", False),
            "the map in a folder": (f"{localize} --map {package}", False),
            "bare process: fleetmap --version": ("--version", False),
        }
        for command, _ in ways.values():
            bench.shown(f"fleetmap {command}")
        taken: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
        for _ in range(_RUNS):
            for name, (command, is_new) in ways.items():
                if is_new:
                    shutil.rmtree(bench.folder / _CACHE, ignore_errors=True)
                taken[name].append(_localized(bench, command))
    lines = {name: _figures(times_s) for name, times_s in taken.items()}
    first, *others = lines
    for name in others:
        bench.beside(name, lines[name])
    return lines[first]


def _localized(bench: Workbench, command: str) -> tuple[float, float]:
    """Run a command that must give a pose; its wall clock and processor seconds."""
    quiet = replace(bench, commands=[])  # the row shows each command once
    before_s = _children_s()
    duration_s = quiet.fleetmap(command).duration_s
    written = bench.folder / _OUTPUT
    if command != "--version" and "measured" not in written.read_text():
        raise RunError("the image has no pose; the row measures nothing")
    return duration_s, _children_s() - before_s


def _children_s() -> float:
    """Processor time of the processes that have ended; the server has not."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _figures(times_s: list[tuple[float, float]]) -> Figures:
    wall_s, processor_s = np.array(times_s).T
    return {
        "first pose s": round(float(np.median(wall_s)), 2),
        "slowest s": round(float(wall_s.max()), 2),
        "processor s": round(float(np.median(processor_s)), 2),
    }


def _take_image_with_pose(bench: Workbench, recording: str, package: str, command: str) -> str:
    """Write a recording of one image, the first from the middle on that has a pose; where the map has its middle.

    Trying it also compiles what nobody has compiled before.
    """
    drive = open_drive(bench.folder / recording)
    for frame in islice(drive.frames(), drive.frame_count // 2, None):
        with DriveWriter(bench.folder / _IMAGE, drive.camera, force=True) as writer:
            writer.write_image(frame.stamp_ns, frame.image, png=True)
        with suppress(RunError):
            _localized(bench, command)
            path_lonlat = open_package(Path(bench.folder / package)).manifest.trajectory_lonlat
            lon_deg, lat_deg = path_lonlat[len(path_lonlat) // 2]
            return f"{lat_deg:.6f},{lon_deg:.6f}"
    raise RunError("no image has a pose; the row measures nothing")


ROWS = start_rows(SimulatedDrives())
