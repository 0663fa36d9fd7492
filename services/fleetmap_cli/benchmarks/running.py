"""Runs a benchmark's rows one after the other; what is measured stays, whatever happens later."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from fleetmap.errors import FleetmapError, InputError, StorageError
from fleetmap.files import refuse_existing
from fleetmap_cli.benchmarks.report import write_report
from fleetmap_cli.benchmarks.row import Benchmark, Figures, Outcome, Row, Status
from fleetmap_cli.benchmarks.workbench import CannotMeasureHereError, Workbench


def run_benchmark(
    benchmark: Benchmark,
    data: Path,
    output: Path,
    *,
    row_names: Sequence[str] = (),
    force: bool = False,
    tell: Callable[[str], None] = lambda line: None,
) -> list[Outcome]:
    """Measure the rows, all or those named, and write NAME.md, NAME.json and pictures into the output folder.

    Args:
        benchmark: the rows.
        data: the folder of recordings; rows whose data is not there are skipped.
        output: made if need be; the files of an earlier run are replaced only with ``force``.
        row_names: of the rows to measure; empty for all.
        force: see ``output``.
        tell: gets one line before, and one after each row.

    Raises:
        InputError: no such row, or results are there already.
        StorageError: the results cannot be written.
    """
    rows = _chosen(benchmark, row_names)
    for ending in (".md", ".json"):
        refuse_existing(output / f"{benchmark.name}{ending}", force)
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot write {output}: {error.strerror or error}") from error
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory(prefix=".work-", dir=output) as work:
        shared = Workbench(data.resolve(), Path(work), output.resolve()) if benchmark.shares_work else None
        for number, row in enumerate(rows, start=1):
            tell(f"[{number}/{len(rows)}] {row.name}: {row.about}")
            outcomes.append(_outcome(row, data, output, shared))
            tell(f"[{number}/{len(rows)}] {row.name}: {_summary(outcomes[-1])}")
            write_report(output, benchmark, outcomes)
    return outcomes


def _chosen(benchmark: Benchmark, names: Sequence[str]) -> list[Row]:
    known = {row.name: row for row in benchmark.rows}
    for name in names:
        if name not in known:
            raise InputError(f"benchmark {benchmark.name} has no row '{name}'; its rows are {', '.join(known)}")
    return [row for row in benchmark.rows if not names or row.name in names]


def _outcome(row: Row, data: Path, output: Path, shared: Workbench | None) -> Outcome:
    """What comes of one row; without a shared workbench its recordings and maps are removed again."""
    missing = [f"DATA/{place}" for place in row.needs if not (data / place).exists()]
    if missing:
        reason = f"needs {' and '.join(missing)}"
        return Outcome(row.name, row.about, "skipped", reason=reason, group=row.group, reach=row.reach)
    if shared is not None:
        return _measured(row, Workbench(shared.data, shared.folder, shared.output, finished=shared.finished))
    with tempfile.TemporaryDirectory(prefix=".work-", dir=output) as folder:
        return _measured(row, Workbench(data.resolve(), Path(folder), output.resolve()))


def _measured(row: Row, bench: Workbench) -> Outcome:
    started = time.perf_counter()
    figures: Figures = {}
    status: Status = "measured"
    reason = ""
    try:
        figures = row.measure(bench)
    except CannotMeasureHereError as error:
        status, reason = "skipped", str(error)
    except FleetmapError as error:
        status, reason = "failed", str(error)
    is_measured = status == "measured"
    return Outcome(
        row.name,
        row.about,
        status,
        commands=tuple(bench.commands),
        figures=figures,
        lines=bench.lines if is_measured else {},
        reason=reason,
        pictures=tuple(bench.pictures) if is_measured else (),
        duration_s=time.perf_counter() - started,
        group=row.group,
        reach=row.reach,
    )


def _summary(outcome: Outcome) -> str:
    if outcome.status == "measured":
        return f"measured in {outcome.duration_s:.0f} s"
    return f"{outcome.status}: {outcome.reason}"
