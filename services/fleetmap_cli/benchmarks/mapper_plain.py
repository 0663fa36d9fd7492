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
_DIGITS = {"mean m": 3, "50 m windows: RMSE m": 3, "largest / smallest window scale": 3}

PLAIN = Group(
    "Plain SLAM",
    "`--gnss none`, one Sim(3) fitted to the reference, all images. *50 m windows*: the mean RMSE after a "
    "Sim(3) of its own for every window of 50 m of the road; the single Sim(3) judges by luck how drift bends a"
    " drive. Peers were measured on the same drives and the same kind of machine, three runs where they are not"
    " deterministic. ORB-SLAM3 and stella_vslam take no GNSS; COLMAP takes position priors, which left one "
    "camera 31 m off.",
    (*_DIGITS, "posed"),
)
_WINDOWS, _SCALES = list(_DIGITS)[1:]
_PEERS: dict[str, dict[str, Figures]] = {
    "odo": {
        "ORB-SLAM3": {"mean m": "1.32 to 1.37", _WINDOWS: "0.12", _SCALES: "1.14", "posed": "299 of 300"},
        "stella_vslam": {
            "mean m": "0.51 to 1.14",
            _WINDOWS: "0.12 to 0.14",
            _SCALES: "1.04 to 1.13",
            "posed": "290 of 300",
        },
        "COLMAP 4.2": {"mean m": "2.56"},
    },
    "raw": {
        "ORB-SLAM3": {
            "mean m": "0.36 to 0.62",
            _WINDOWS: "0.078 to 0.098",
            _SCALES: "1.03 to 1.07",
            "posed": "399 of 400",
        },
        "stella_vslam": {
            "mean m": "0.25 to 0.36",
            _WINDOWS: "0.079 to 0.096",
            _SCALES: "1.02 to 1.10",
            "posed": "381 to 392 of 400",
        },
        "COLMAP 4.2": {"mean m": "0.21"},
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
        runs = [_judged_run(bench, recording, seed) for seed in seeds]
        figures: Figures = {name: rounded(median(run[name] for run in runs), _DIGITS[name]) for name in _DIGITS}
        if len(runs) > 1:
            spread: Figures = {name: _range([run[name] for run in runs], _DIGITS[name]) for name in _DIGITS}
            bench.beside("smallest to largest of the seeds", spread)
        for peer, theirs in peers.items():
            bench.beside(peer, theirs)
        return figures | {"posed": min((run["posed"] for run in runs), key=lambda text: int(text.split()[0]))}

    return measure


def _judged_run(bench: Workbench, recording: Recording, seed: int) -> dict[str, Any]:
    judgement = judged(bench, mapped(bench, recording, "none", seed), "--align sim3")["reference"]
    windows = judgement["windows"] or {}
    mean, rmse, scales = _DIGITS
    return {
        mean: judgement["position_m"]["mean"],
        rmse: windows.get("mean_rmse_m", float("nan")),
        scales: windows.get("scale_ratio", float("nan")),
        "posed": posed(judgement),
    }


def _range(values: Sequence[float], digits: int) -> str:
    return f"{min(values):.{digits}f} to {max(values):.{digits}f}"
