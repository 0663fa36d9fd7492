"""What each use of the fixes gives: none, while mapping only, at the end only, both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from fleetmap.evaluation import judge
from fleetmap.trajectory import read_trajectory
from fleetmap_cli.benchmarks.mapper_drives import KITTI_RAW, ODOMETRY_RTK_5S, Circuit, Recording
from fleetmap_cli.benchmarks.mapper_runs import (
    MapRun,
    beside_splines,
    judged,
    mapped,
    position_figures,
    rotation_figures,
    rounded,
)
from fleetmap_cli.benchmarks.row import Figures, Group, Row
from fleetmap_cli.benchmarks.workbench import Workbench

_PICTURE = "ablation.png"
_LOOKS = {  # of --gnss -> how it is called, and drawn
    "none": ("`none`: plain SLAM, placed on the fixes by one Sim(3)", "C3"),
    "mapping": ("`mapping`: alignment while mapping only", "C1"),
    "final": ("`final`: joint adjustment at the end only", "C4"),
    "full": ("`full`: both", "C0"),
}
MODES = tuple(_LOOKS)

ABLATION = Group(
    "Ablation",
    "How fixes shape the map: `--gnss none`, `mapping`, `final`, `full`; never aligned to the reference. "
    "Printed of ORB-SLAM3 with GNSS on its authors' own data: mean 0.20, RMSE 0.35 m, 12 and 8 times below "
    "plain SLAM.",
    (
        "mean m",
        "RMSE m",
        "p95 m",
        "max m",
        "mean, times below none",
        "RMSE, times below none",
        "rotation deg",
        "constant deg",
        "rest deg",
    ),
)


@dataclass(frozen=True)
class _Case:
    name: str
    about: str
    recording: Recording


def ablation_rows(circuit: Circuit, modes: Sequence[str] = MODES) -> tuple[Row, ...]:
    """Both real drives and the circuit; all modes are held against the first of them, and the last is "full"."""
    cases = (
        _Case("ablation-odo", "KITTI odometry 00, RTK every 5 s", ODOMETRY_RTK_5S),
        _Case("ablation-raw", "KITTI raw 14:05, its own receiver", KITTI_RAW),
        _Case("ablation-circuit", "simulated circuit, RTK 1 Hz", circuit.clean),
    )
    return tuple(_row(case, cases, modes) for case in cases)


def _row(case: _Case, cases: Sequence[_Case], modes: Sequence[str]) -> Row:
    def measure(bench: Workbench) -> Figures:
        runs = {mode: mapped(bench, case.recording, mode) for mode in modes}
        together = beside_splines(bench, runs["full"])
        judgements = {mode: judged(bench, run)["reference"] for mode, run in runs.items() if mode != "full"}
        judgements["full"] = together["reference"]
        without = judgements[modes[0]]["position_m"]
        for mode, judgement in judgements.items():
            bench.beside(_LOOKS[mode][0], _figures(judgement, without) | rotation_figures(judgement))
        bench.beside("smoothing spline through the fixes alone", _figures(together["smoothing_spline"], without))
        bench.shown(f"fleetmap benchmark mapper --rows {','.join(each.name for each in cases)}")
        _draw(bench, cases, modes)
        return {}

    return Row(case.name, case.about, measure, case.recording.needs, ABLATION, "full <= final <= none")


def _figures(judgement: dict[str, Any], without: dict[str, float]) -> Figures:
    position_m = judgement["position_m"]
    return position_figures(judgement) | {
        "RMSE m": rounded(position_m["rmse"]),
        "mean, times below none": rounded(without["mean"] / position_m["mean"], 1),
        "RMSE, times below none": rounded(without["rmse"] / position_m["rmse"], 1),
    }


def _draw(bench: Workbench, cases: Sequence[_Case], modes: Sequence[str]) -> None:
    """One picture of all the drives that are measured by now."""
    from fleetmap_cli.plotting import ErrorLine, Sheet, Track, plot_sheets

    sheets = []
    for case in cases:
        runs = {mode: MapRun(case.recording, mode, 0, bench.folder) for mode in modes}
        if not all(run.trajectory.exists() for run in runs.values()):
            continue
        tracks = [
            Track(mode, read_trajectory(run.trajectory).positions_m, f"{_LOOKS[mode][1]}-")
            for mode, run in runs.items()
        ]
        reference = Track("reference", runs["full"].reference.positions_m, "k--")
        lines = [ErrorLine(mode, judge(run.errors), _LOOKS[mode][1]) for mode, run in runs.items()]
        sheets.append(Sheet(case.about, [*tracks, reference], lines))
    plot_sheets(bench.picture(_PICTURE), sheets)
