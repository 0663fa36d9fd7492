"""How small a map may be: what localizers fetch per kilometre, against how often and how exactly they find out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import Pose
from fleetmap.landmark_choice import choose_again
from fleetmap.map_package import open_package
from fleetmap_cli.benchmarks.localizer_drives import SimulatedDrives, against_camera_0, camera_1
from fleetmap_cli.benchmarks.localizer_queries import Queries, relative_to_truth
from fleetmap_cli.benchmarks.mapper_drives import RAW
from fleetmap_cli.benchmarks.mapper_runs import rounded
from fleetmap_cli.benchmarks.perturbing import cam_from_turned
from fleetmap_cli.benchmarks.row import Figures, Group, Row
from fleetmap_cli.benchmarks.workbench import Workbench

_BUDGETS_MB_PER_KM = (0.0, 2.0, 1.0, 0.7, 0.5, 0.35, 0.25, 0.15)
_PICTURE = "map-size.png"
_LOSS_OF_MEDIAN = 1.15
_EYES = {  # of the second camera -> options of the perturbing, degrees to the right, success asked for in %
    "plain": ("", 0.0, 98.0),
    "dark": ("--gamma 2.0 --noise 4", 0.0, 96.0),
    "yawed": ("--yaw-deg 8", 8.0, 96.0),
}

SIZE = Group(
    "Map size",
    "One map, of which landmarks and keyframes are chosen by `fleetmap map --budget-mb-per-km`; *MB/km*: all "
    "cells together, on the way driven: what a localizer fetches. Every query on its own; *%*: images with a "
    "pose that is not wrong, *m*: median error. Dark: gamma 2.0, noise 4; yawed: by 8 deg. In the simulation the "
    "second vehicle drives in the other lane, at dusk, with another camera.",
    ("MB/km", "landmarks/km", *(f"{eyes} {unit}" for eyes in (*_EYES, "tracking") for unit in ("%", "m"))),
)


@dataclass(frozen=True)
class _Point:
    """A map of some size, and what came of it."""

    mb_per_km: float
    figures: Figures

    def success(self, eyes: str) -> float:
        return float(self.figures[f"{eyes} %"] or 0.0)

    def median_m(self, eyes: str) -> float:
        return float(self.figures[f"{eyes} m"] or np.inf)


def size_rows(simulated: SimulatedDrives) -> tuple[Row, ...]:
    """The curve on the real pair of cameras, and on simulated drives."""
    reach = "at 0.5 MB/km >= 98 % plain, >= 96 % dark and yawed; plain median at most 15 % above the whole map's"
    return (
        Row("size-camera-1", "camera 1 in camera 0's map, of several sizes", _of_camera_1, (RAW,), SIZE, reach),
        Row("size-simulated", "the simulated second vehicle likewise", _of_simulated(simulated), (), SIZE),
    )


def _of_camera_1(bench: Workbench) -> Figures:
    camera_1(bench)
    names = {"plain": "second"} | {eyes: f"camera-1-{eyes}" for eyes in _EYES if eyes != "plain"}
    for eyes, (options, _, _) in _EYES.items():
        if options:
            bench.python_module("fleetmap_cli.benchmarks.perturbing", f"second.mcap {names[eyes]}.mcap {options}")

    def judge(package: str) -> Figures:
        figures: Figures = {}
        for eyes, (_, yaw_deg, _) in _EYES.items():
            queries = Queries(names[eyes], "survey", label=f"-{package}", package=package)
            turn = Pose(cam_from_turned(yaw_deg), np.zeros(3))
            figures |= _success_and_error(eyes, against_camera_0(bench, queries, turn))
        return figures

    points = _curve(bench, "survey", judge)
    _draw(bench, points, f"size-camera-1-{_PICTURE}", tuple(_EYES))
    whole = points[0]
    held = [
        point.mb_per_km
        for point in points
        if all(
            point.success(eyes) >= asked and point.median_m("plain") <= _LOSS_OF_MEDIAN * whole.median_m("plain")
            for eyes, (_, _, asked) in _EYES.items()
        )
    ]
    found = [
        point.mb_per_km
        for point in points
        if all(point.success(eyes) >= asked for eyes, (_, _, asked) in _EYES.items())
    ]
    return {"success holds down to MB/km": min(found, default=None), "and the error to": min(held, default=None)}


def _of_simulated(drives: SimulatedDrives) -> Callable[[Workbench], Figures]:
    def measure(bench: Workbench) -> Figures:
        drives.make(bench)

        def judge(package: str) -> Figures:
            figures: Figures = {}
            for eyes, options in (("plain", "--independent"), ("tracking", "")):
                queries = Queries("sim-second", "sim-survey", options, f"-{eyes}-{package}", package)
                figures |= _success_and_error(eyes, relative_to_truth(bench, queries))
            return figures

        points = _curve(bench, "sim-survey", judge)
        _draw(bench, points, f"size-simulated-{_PICTURE}", ("plain", "tracking"))
        return {}

    return measure


def _curve(bench: Workbench, survey: str, judge: Callable[[str], Figures]) -> list[_Point]:
    """The survey's map in all sizes, the whole of it first; each is a line of the row."""
    points = []
    for budget in _BUDGETS_MB_PER_KM:
        package = f"map-{budget:g}"
        manifest = choose_again(
            open_package(bench.folder / f"{survey}-map"), bench.folder / f"{survey}-{package}", budget, force=True
        )
        bench.shown(f"fleetmap map {survey}.mcap --output {survey}-{package} --budget-mb-per-km {budget:g}")
        assert manifest.localizable is not None
        length_km = manifest.quality.length_m / 1000.0
        mb_per_km = manifest.localizable.size_bytes / 1e6 / length_km
        size: Figures = {
            "MB/km": rounded(mb_per_km),
            "landmarks/km": round(manifest.localizable.landmarks / length_km),
        }
        points.append(_Point(round(mb_per_km, 3), size | judge(package)))
        bench.beside(f"budget {budget:g}" if budget else "the whole map", points[-1].figures)
    return points


def _success_and_error(eyes: str, figures: Figures) -> Figures:
    return {f"{eyes} %": figures["success %"], f"{eyes} m": figures["median m"]}


def _draw(bench: Workbench, points: list[_Point], name: str, all_eyes: tuple[str, ...]) -> None:
    """Success above and the median error below, over the size on a scale of powers."""
    from fleetmap_cli.plotting import new_figure, save_figure

    figure = new_figure(width_in=7.0, height_in=7.0)
    above, below = figure.subplots(2, 1, sharex=True)
    sizes = [point.mb_per_km for point in points]
    for eyes in all_eyes:
        above.plot(sizes, [point.success(eyes) for point in points], "o-", label=eyes, markersize=4)
        below.plot(sizes, [point.median_m(eyes) for point in points], "o-", label=eyes, markersize=4)
    above.set_ylabel("images localised (%)")
    below.set_ylabel("median error (m)")
    below.set_xlabel("cells (MB/km)")
    below.set_xscale("log")
    below.set_xticks(sizes, [f"{size:.2g}" for size in sizes])
    below.minorticks_off()
    below.set_ylim(bottom=0.0)
    for axes in (above, below):
        axes.grid(alpha=0.3)
        axes.legend()
    save_figure(figure, bench.picture(name))


ROWS = size_rows(SimulatedDrives())
