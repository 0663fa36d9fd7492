"""``fleetmap benchmark``: measure the product on real and simulated drives."""

from __future__ import annotations

import importlib
import tempfile
from pathlib import Path

import click

from fleetmap_cli.benchmarks.report import missing_line, tables
from fleetmap_cli.benchmarks.row import Benchmark
from fleetmap_cli.benchmarks.running import run_benchmark
from fleetmap_cli.demo_processes import interrupted_once

_NAMES = ("drives", "mapper", "localizer", "server")


@click.command()
@click.argument("name", type=click.Choice(_NAMES))
@click.option(
    "--data",
    type=click.Path(path_type=Path, file_okay=False),
    envvar="FLEETMAP_DATA",
    default=Path("../shared/data"),
    show_default=True,
    show_envvar=True,
    help="The folder of public recordings, shown as DATA in commands. Rows whose recordings are not there are "
    "skipped with a line.",
)
@click.option(
    "--output",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Write NAME.md, NAME.json and the pictures here.  [default: benchmark-NAME]",
)
@click.option("--rows", metavar="ROW,ROW,...", help="Measure these rows only.  [default: all]")
@click.option("--list", "list_rows", is_flag=True, help="Say what the rows measure and need, and measure nothing.")
@click.option(
    "--kills",
    type=click.IntRange(min=1),
    help="Of the server only: SIGKILL it so often, at any instant, and measure nothing else. Exit code 1 if a map "
    "is lost or half visible afterwards.",
)
@click.option("--force", is_flag=True, help="Replace the results of an earlier run.")
def benchmark(
    name: str,
    data: Path,
    output: Path | None,
    rows: str | None,
    list_rows: bool,
    kills: int | None,
    force: bool,
) -> int | None:
    """Measure NAME, and print its table, or tables, with the commands that make each row.

    \b
      drives      is the simulated world as hard to see as a real one; rendering speed; a recording of
                  4 GB in bounded memory; what a spline through the fixes alone gives; clock offsets
      mapper      maps of the real drives and of a simulated circuit: plain SLAM beside its peers, each
                  kind of GNSS beside splines through the same fixes, bad fixes, what each use of the
                  fixes gives, images a second; about an hour in all
      localizer   a second vehicle in the first one's map: another camera, dark, turned away, at half the
                  resolution, in the other lane at dusk; maps with and without GNSS; each row counts poses
                  that are wrong and do not say so
      server      maps published and fetched beside raw TCP, by a fleet, over slow and broken links, through
                  restarts; 100,000 maps in a catalogue; a map of a million landmarks

    The tables are also written as NAME.md, beside NAME.json and pictures, after every row: what is measured stays
    when a later row is interrupted. A row that fails says why, and the exit code is 1. Recordings and maps are
    made in the output folder and removed again; what several rows need is made once.

    \b
    Examples:
      fleetmap benchmark drives --data DATA --output results
      fleetmap benchmark mapper --rows odo-rtk-5s,odo-consumer
      fleetmap benchmark server --kills 200
    """
    chosen = _benchmark(name)
    if list_rows:
        for row in chosen.rows:
            needs = f" (needs {', '.join(f'DATA/{place}' for place in row.needs)})" if row.needs else ""
            click.echo(f"{row.name:<16} {row.about}{needs}")
        return None
    if kills is not None:
        return _kill(name, kills)
    names = [word for word in (rows or "").split(",") if word]
    folder = output or Path(f"benchmark-{name}")
    with interrupted_once():
        outcomes = run_benchmark(
            chosen, data, folder, row_names=names, force=force, tell=lambda line: click.echo(line, err=True)
        )
    if any(outcome.status != "skipped" for outcome in outcomes):
        click.echo(tables(chosen, outcomes))
    for outcome in outcomes:
        if outcome.status != "measured":
            click.echo(missing_line(outcome))
    return 1 if any(outcome.status == "failed" for outcome in outcomes) else None


def _kill(name: str, kills: int) -> int | None:
    """The check of crash safety; its verdict is the last line."""
    if name != "server":
        raise click.UsageError("--kills goes with 'fleetmap benchmark server'")
    from fleetmap_cli.benchmarks.server_kills import kill_servers

    with interrupted_once(), tempfile.TemporaryDirectory(prefix="fleetmap-kills-") as folder:
        report = kill_servers(kills, Path(folder), tell=lambda line: click.echo(line, err=True))
    for note in report.notes:
        click.echo(note)
    counts = ", ".join(f"{count} in {name}" for name, count in sorted(report.by_operation.items()))
    click.echo(f"killed {counts}")
    click.echo(str(report))
    return 1 if report.lost or report.half_visible else None


def _benchmark(name: str) -> Benchmark:
    module = importlib.import_module(f"fleetmap_cli.benchmarks.{name}")
    found: Benchmark = module.BENCHMARK
    return found
