"""Plain SLAM beside its peers: no fix shapes the map, and one Sim(3) is fitted before it is judged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import median
from typing import Any

from fleetmap_cli.benchmarks.mapper_drives import KITTI_RAW, ODOMETRY_RTK_5S, Circuit, Recording
from fleetmap_cli.benchmarks.mapper_runs import judged, mapped, posed, rounded
from fleetmap_cli.benchmarks.row import Figures, Group, Row
from fleetmap_cli.benchmarks.workbench import Workbench

_SEEDS = range(5)
_MEAN, _WINDOWS, _SCALES = "mean m", "50 m windows: RMSE m", "largest / smallest window scale"

PLAIN = Group(
    "Plain SLAM",
    "`--gnss none`, one Sim(3) fitted to the reference; posed are those of the seed that posed fewest. *50 m "
    "windows*: the mean RMSE after a Sim(3) of its own for every window of 50 m of the road; the single Sim(3) "
    "judges by luck how drift bends a drive. Peers were measured on the same drives and the same kind of machine, "
    "three runs where they are not deterministic. ORB-SLAM3 and stella_vslam take no GNSS; COLMAP takes position "
    "priors, which left one camera 31 m off.",
    (_MEAN, _WINDOWS, _SCALES, "posed"),
)
_PEERS: dict[str, dict[str, Figures]] = {
    "odo": {
        "ORB-SLAM3": {_MEAN: "1.32 to 1.37", _WINDOWS: "0.12", _SCALES: "1.14", "posed": "299 of 300"},
        "stella_vslam": {
            _MEAN: "0.51 to 1.14",
            _WINDOWS: "0.12 to 0.14",
            _SCALES: "1.04 to 1.13",
            "posed": "290 of 300",
        },
        "COLMAP 4.2": {_MEAN: "2.56"},
    },
    "raw": {
        "ORB-SLAM3": {
            _MEAN: "0.36 to 0.62",
            _WINDOWS: "0.078 to 0.098",
            _SCALES: "1.03 to 1.07",
            "posed": "399 of 400",
        },
        "stella_vslam": {
            _MEAN: "0.25 to 0.36",
            _WINDOWS: "0.079 to 0.096",
            _SCALES: "1.02 to 1.10",
            "posed": "381 to 392 of 400",
        },
        "COLMAP 4.2": {_MEAN: "0.21"},
    },
    "circuit": {},
}


def plain_rows(circuit: Circuit) -> tuple[Row, ...]:
    """Both real drives with five seeds, and the circuit with one."""
    reach = "RMSE <= {} m, scales <= {}, every image posed"
    return (
        _row("odo", "KITTI odometry 00, median of 5 seeds", ODOMETRY_RTK_5S, _SEEDS, reach.format(0.11, 1.12)),
        _row("raw", "KITTI raw 14:05, median of 5 seeds", KITTI_RAW, _SEEDS, reach.format(0.08, 1.08)),
        _row("circuit", f"simulated city, {circuit.length_m:g} m", circuit.clean, range(1), "reported"),
    )


def _row(drive: str, about: str, recording: Recording, seeds: Sequence[int], reach: str) -> Row:
    return Row(f"{drive}-slam", about, _measure(recording, seeds, _PEERS[drive]), recording.needs, PLAIN, reach)


def _measure(
    recording: Recording, seeds: Sequence[int], peers: dict[str, Figures]
) -> Callable[[Workbench], Figures]:
    def measure(bench: Workbench) -> Figures:
        runs = [judged(bench, mapped(bench, recording, "none", s), "--align sim3")["reference"] for s in seeds]
        values = {name: [value_of(run) for run in runs] for name, value_of in _FIGURES.items()}
        if len(runs) > 1:
            bench.beside("smallest to largest of the seeds", {name: _range(each) for name, each in values.items()})
        for peer, theirs in peers.items():
            bench.beside(peer, theirs)
        fewest = min(runs, key=lambda run: int(run["matched"]))
        return {**{name: rounded(_median(each)) for name, each in values.items()}, "posed": posed(fewest)}

    return measure


def _window(judgement: dict[str, Any], key: str) -> float | None:
    """A figure of the windows; None where the drive is too short for one."""
    windows = judgement["windows"]
    return None if windows is None else float(windows[key])


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return median(known) if known else None


def _range(values: Sequence[float | None]) -> str | None:
    known = [value for value in values if value is not None]
    return f"{min(known):.3f} to {max(known):.3f}" if known else None


_FIGURES: dict[str, Callable[[dict[str, Any]], float | None]] = {
    _MEAN: lambda judgement: float(judgement["position_m"]["mean"]),
    _WINDOWS: lambda judgement: _window(judgement, "mean_rmse_m"),
    _SCALES: lambda judgement: _window(judgement, "scale_ratio"),
}
