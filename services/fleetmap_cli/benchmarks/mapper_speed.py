"""How fast drives are mapped, and where the time goes."""

from __future__ import annotations

import re

from fleetmap.errors import RunError
from fleetmap_cli.benchmarks.mapper_drives import ODOMETRY, ODOMETRY_RTK_5S
from fleetmap_cli.benchmarks.mapper_runs import mapped, rounded, run_of
from fleetmap_cli.benchmarks.row import Figures, Group, Row
from fleetmap_cli.benchmarks.workbench import Workbench

SPEED = Group(
    "Throughput",
    "1241x376, everything on (`--gnss full`), before the final joint adjustment; ORB-SLAM3 and stella_vslam do "
    "35 to 43 images/s. Shares of the time; features are found beside the rest, in a thread of their own.",
    ("images/s", "before the final adjustment s", "in all s"),
)
_TOLD = re.compile(r"(\d+) images in ([\d.]+) s, ([\d.]+) images/s before [^:]*: (.*)")
_STAGE = re.compile(r"([a-z][a-z ]*) ([\d.]+) s")


def speed_row() -> Row:
    """Images a second, and the share of each stage."""
    return Row("throughput", "KITTI odometry 00", _measure, (ODOMETRY,), SPEED, ">= 20 images/s")


def _measure(bench: Workbench) -> Figures:
    run = run_of(bench, mapped(bench, ODOMETRY_RTK_5S))
    return speed_figures(run.stderr) | {"in all s": rounded(run.duration_s, 1)}


def speed_figures(told: str) -> Figures:
    """What ``fleetmap map -v`` tells on stderr.

    Raises:
        RunError: it tells nothing of its speed.
    """
    found = _TOLD.search(told)
    if found is None:
        raise RunError("'fleetmap map -v' did not say how fast it was")
    _, seconds, rate, stages = found.groups()
    figures: Figures = {"images/s": float(rate), "before the final adjustment s": float(seconds)}
    for name, stage_s in _STAGE.findall(stages):
        figures[name.strip()] = f"{100 * float(stage_s) / float(seconds):.0f} %"
    return figures
