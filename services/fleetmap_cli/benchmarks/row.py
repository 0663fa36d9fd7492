"""A row of a benchmark: what it measures, what data it needs, and what came of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from fleetmap_cli.benchmarks.workbench import Workbench

Value = float | int | str | None
Status = Literal["measured", "skipped", "failed"]
Figures = dict[str, Value]  # a figure's name, with its unit -> its value, rounded as it is to be shown


@dataclass(frozen=True)
class Row:
    """One row. ``measure`` returns its figures; without any it raises a CannotMeasureHereError
    or a FleetmapError."""

    name: str  # for --rows
    about: str
    measure: Callable[[Workbench], Figures]
    needs: tuple[str, ...] = ()  # under the data folder, such as "drives/kitti_odo_00_first300"


@dataclass(frozen=True)
class Benchmark:
    """A list of rows and the figures that get columns of their own; others share one."""

    name: str
    about: str
    rows: tuple[Row, ...]
    columns: tuple[str, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """What came of a row."""

    name: str
    about: str
    status: Status
    commands: tuple[str, ...] = ()
    figures: Figures = field(default_factory=dict)
    reason: str = ""  # why there are no figures
    pictures: tuple[str, ...] = ()
    duration_s: float = 0.0
