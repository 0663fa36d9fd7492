"""Where am I, among all streets there are? Simulated streets and both real maps, asked without a prior.

Twins are streets of one shape, a quarter of whose walls and pieces of road are the same to the last brick. Where
little of what differs is in view, "no pose" is the right answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.camera_file import write_camera
from fleetmap.trajectory import read_trajectory
from fleetmap_cli.benchmarks.localizer_queries import WRONG_M
from fleetmap_cli.benchmarks.mapper_drives import ODOMETRY, ODOMETRY_RTK_5S, RAW
from fleetmap_cli.benchmarks.mapper_runs import rounded
from fleetmap_cli.benchmarks.row import Figures, Group, Row
from fleetmap_cli.benchmarks.workbench import Workbench

COLD = Group(
    "Anywhere in the catalogue",
    "Every image is a query on its own, without any prior, in all maps at once: simulated streets of one drive "
    "each, images of another drive on another day with another camera, and both real maps. *Right*: the right "
    f"map, and within {WRONG_M:g} m (real drives: of the map's own pose at that instant). *Twins*: streets of a "
    "near-identical pair. *ms*: features, search and pose, in one thread. *Memory*: peak of the process, images "
    "and Python included.",
    (
        *("queries", "right", "right %", "wrong map", "wrong place", "twins right %", "others right %"),
        *("ms median", "ms p95", "memory MB", "km", "landmarks/m"),
    ),
)
_SURVEY_CAMERA = Camera(640, 256, 371.0, 371.0, 317.0, 126.0)
_SECOND_CAMERA = Camera(720, 320, 390.0, 391.0, 362.0, 157.0, (-0.08, 0.02, 0.0, 0.0, 0.0))
_REACH = ">= 97 % right, no wrong map; <= 400 MB"


@dataclass(frozen=True)
class Street:
    """A street of the catalogue."""

    kind: str
    world: int
    variant: int = 0

    @property
    def name(self) -> str:
        """Of its files, and of its map."""
        return f"{self.kind}-{self.world}-{self.variant}"

    @property
    def longest_m(self) -> float:
        """That a world of this kind can be."""
        return 500.0 if self.kind == "street" else 3200.0


CATALOGUE = (
    *(Street("city", world) for world in range(101, 113)),
    *(Street("facades", world) for world in (201, 202)),
    *(Street("street", world) for world in (301, 302)),
    Street("straight", 401),
    *(Street("city", 101, variant) for variant in (1, 2)),
    Street("facades", 201, 1),
)


@dataclass(frozen=True)
class Catalogue:
    """Streets, each of one length, with a site of its own; and whether the real maps are among them."""

    streets: tuple[Street, ...] = CATALOGUE
    length_m: float = 510.0
    with_real_drives: bool = True

    def is_twin(self, street: Street) -> bool:
        """Whether another street of the catalogue could be taken for it."""
        return sum((other.kind, other.world) == (street.kind, street.world) for other in self.streets) > 1

    @property
    def kilometres(self) -> float:
        """Of simulated streets."""
        return sum(min(self.length_m, street.longest_m) for street in self.streets) / 1e3

    def make(self, bench: Workbench) -> None:
        """Maps NAME-map, and recordings NAME-query.mcap."""
        write_camera(bench.folder / "catalogue-survey.yaml", _SURVEY_CAMERA, force=True)
        write_camera(bench.folder / "catalogue-second.yaml", _SECOND_CAMERA, force=True)
        for number, street in enumerate(self.streets):
            _make_street(bench, street, number, self.length_m)
        if self.with_real_drives:
            _make_real_drives(bench)


def _make_street(bench: Workbench, street: Street, number: int, length_m: float) -> None:
    """A survey at 12 m/s with four images a second, and every other second an image of a second drive."""
    site = f"--site {48.5 + 0.02 * number:.2f},{11.0 + 0.01 * number:.2f},{400 + 5 * number}"
    world = f"--kind {street.kind} --world {street.world} --world-variant {street.variant} {site}"
    drive = f"{world} --length-m {min(length_m, street.longest_m):g} --speed-mps 12"
    look = ("--look day", "--look overcast --lane-m 1.5")[number % 2]
    name = street.name
    bench.once(
        f"simulate {name}-query.mcap {drive} --drive {1000 + number} --rate-hz 0.5 {look} "
        "--camera catalogue-second.yaml --gnss none"
    )
    bench.once(f"simulate {name}.mcap {drive} --drive {1 + number} --rate-hz 4 --camera catalogue-survey.yaml")
    settings = "--set features.count=2000 --recorded-calibration"
    bench.once(f"map {name}.mcap --output {name}-map --trajectory {name}.tum {settings}", accepted_codes=(0, 3))


def _make_real_drives(bench: Workbench) -> None:
    """As other rows have them: camera 1 in camera 0's map, odd images in the map of the even ones."""
    bench.once(f"convert kitti-raw DATA/{RAW} survey.mcap --camera 0")
    bench.once(f"convert kitti-raw DATA/{RAW} second.mcap --camera 1 --no-gnss")
    ODOMETRY_RTK_5S.make(bench)
    for name, options in (("even", "--images even"), ("odd", "--images odd --half")):
        words = f"{ODOMETRY_RTK_5S.name}.mcap {name}.mcap {options}"
        bench.python_module("fleetmap_cli.benchmarks.perturbing", words)
    for name in ("survey", "even"):
        bench.once(f"map {name}.mcap --output {name}-map --trajectory {name}.tum", accepted_codes=(0, 3))


def cold_row(catalogue: Catalogue) -> Row:
    """The whole catalogue, asked for every image of every second drive."""

    def measure(bench: Workbench) -> Figures:
        catalogue.make(bench)
        maps = [f"{street.name}-map" for street in catalogue.streets]
        queries = [([f"{street.name}-query" for street in catalogue.streets], 1)]
        right_maps = {f"{street.name}-query": f"{street.name}-map" for street in catalogue.streets}
        if catalogue.with_real_drives:
            maps, queries = [*maps, "survey-map", "even-map"], [*queries, (["second"], 5), (["odd"], 5)]
            right_maps |= {"second": "survey-map", "odd": "even-map"}
        runs = [_ask(bench, maps, names, every) for names, every in queries]
        answers = [answer for run in runs for answer in run["answers"]]
        verdicts = [verdict_of(bench, answer, right_maps[answer["recording"]]) for answer in answers]
        twins = {f"{street.name}-query" for street in catalogue.streets if catalogue.is_twin(street)}
        is_twin = [answer["recording"] in twins for answer in answers]
        km = (sum(_length_m(bench, name) for name in maps)) / 1e3
        return counted(verdicts, is_twin) | {
            "ms median": rounded(1e3 * float(np.median([answer["duration_s"] for answer in answers])), 1),
            "ms p95": rounded(1e3 * float(np.percentile([answer["duration_s"] for answer in answers], 95)), 1),
            "memory MB": round(max(run["memory_bytes"] for run in runs) / 1e6),
            "km": rounded(km, 2),
            "landmarks/m": rounded(runs[0]["landmarks"] / km / 1e3, 1),
        }

    streets = f"{len(catalogue.streets)} simulated streets, {catalogue.kilometres:.1f} km"
    about = f"{streets}, and both real maps; takes 25 minutes"
    needs = (RAW, ODOMETRY) if catalogue.with_real_drives else ()
    return Row("cold-10km", about, measure, needs, COLD, _REACH)


def _ask(bench: Workbench, maps: Sequence[str], queries: Sequence[str], every: int) -> Any:
    recordings = " ".join(f"{name}.mcap" for name in queries)
    words = f"--maps {' '.join(maps)} --queries {recordings} --every {every}"
    return bench.python_module("fleetmap_cli.benchmarks.cold_queries", words).json()


def verdict_of(bench: Workbench, answer: dict[str, Any], right_map: str) -> str:
    """One of "right", "wrong map", "wrong place" and "none"."""
    if "map" not in answer:
        return "none"
    if answer["map"] != right_map:
        return "wrong map"
    away_m = np.linalg.norm(np.array(answer["position_m"]) - _true_position_m(bench, answer, right_map))
    return "right" if away_m <= WRONG_M else "wrong place"


def _true_position_m(bench: Workbench, answer: dict[str, Any], right_map: str) -> Any:
    """Of simulated drives the truth; of real ones the map's own pose at that instant."""
    simulated = bench.folder / f"{answer['recording']}.reference.tum"
    path = simulated if answer["recording"].endswith("-query") else bench.folder / f"{right_map[:-4]}.tum"
    truth = read_trajectory(path)
    stamps = truth.stamps_ns.astype(np.float64)
    return np.array([np.interp(answer["stamp_ns"], stamps, axis) for axis in truth.positions_m.T])


def counted(verdicts: Sequence[str], is_twin: Sequence[bool]) -> Figures:
    """How many queries of which verdict; of those in streets of a pair, and of the others."""
    right = np.array([verdict == "right" for verdict in verdicts])
    twins = np.array(is_twin)
    return {
        "queries": len(verdicts),
        "right": int(right.sum()),
        "right %": _percent(right),
        "wrong map": verdicts.count("wrong map"),
        "wrong place": verdicts.count("wrong place"),
        "twins right %": _percent(right[twins]),
        "others right %": _percent(right[~twins]),
    }


def _percent(flags: NDArray[np.bool_]) -> float | None:
    return round(100.0 * float(flags.mean()), 1) if len(flags) else None


def _length_m(bench: Workbench, name: str) -> float:
    """How far the survey drove."""
    positions_m = read_trajectory(bench.folder / f"{name[:-4]}.tum").positions_m
    return float(np.linalg.norm(np.diff(positions_m, axis=0), axis=1).sum())


ROWS = (cold_row(Catalogue()),)
