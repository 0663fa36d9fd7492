"""A row of a benchmark: what it measures, what data it needs, and what came of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from fleetmap_cli.benchmarks.workbench import Workbench

Value = float | int | str | None
Status = Literal["measured", "skipped", "failed"]
Figures = dict[str, Value]  # a figure's name, with its unit -> its value, rounded as it is to be shown


@dataclass(frozen=True)
class Group:
    """Rows that share a table, which has columns of its own."""

    title: str
    about: str  # what to know before reading it
    columns: tuple[str, ...]  # figures that get columns; others share one


@dataclass(frozen=True)
class Row:
    """One row. ``measure`` returns its figures; without any it raises a CannotMeasureHereError
    or a FleetmapError. Further lines, such as others' figures to compare with, it gives to the workbench."""

    name: str  # for --rows
    about: str
    measure: Callable[[Workbench], Figures]
    needs: tuple[str, ...] = ()  # under the data folder, such as "drives/kitti_odo_00_first300"
    group: Group | None = None
    reach: str = ""  # what is asked of the figures


@dataclass(frozen=True)
class Benchmark:
    """A list of rows; for those without a group, the figures that get columns of their own."""

    name: str
    about: str
    rows: tuple[Row, ...]
    columns: tuple[str, ...] = ()
    shares_work: bool = False  # all rows work in one folder, so that one's recordings and maps serve the next


@dataclass(frozen=True)
class Outcome:
    """What came of a row."""

    name: str
    about: str
    status: Status
    commands: tuple[str, ...] = ()
    figures: Figures = field(default_factory=dict)
    lines: dict[str, Figures] = field(default_factory=dict)  # beside its figures, each under a label
    reason: str = ""  # why there are no figures
    pictures: tuple[str, ...] = ()
    duration_s: float = 0.0
    group: Group | None = None
    reach: str = ""
