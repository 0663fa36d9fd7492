"""``fleetmap report``: draw how good a map is along its road."""

from __future__ import annotations

import json
from pathlib import Path

import click

from fleetmap_cli.map_report import document, lines, read_report
from fleetmap_cli.map_report_page import write_report

_PATH = click.Path(path_type=Path)


@click.command()
@click.argument("folder", metavar="MAP", type=_PATH)
@click.option(
    "--output", type=_PATH, metavar="FOLDER", help="Write report.html and report.png here.  [default: MAP_report]"
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document with all figures instead of text.")
def report(folder: Path, output: Path | None, as_json: bool) -> None:
    """Draw how good the map in the folder MAP is along its road, and print the figures.

    report.html holds everything and needs no other file; report.png is its picture: the road from above, coloured
    by how uncertain the position is, with the weak stretches marked; beside it, along the road, the uncertainty of
    position and height, the distance from the GNSS fixes, landmarks per metre, landmarks seen by an image, and
    reprojection errors. A report that is there already is replaced; the map itself stays as it is.

    A stretch is weak where one figure is beyond its limit. The limits are settings of 'fleetmap map', such as
    --set quality.weak_position_sigma_m=0.3. A map that was written before maps carried these figures can be
    reported, too; the report says what is missing.

    \b
    Examples:
      fleetmap report my_map
      fleetmap report my_map --output look --json
    """
    found = read_report(folder)
    target = output or folder.resolve().with_name(folder.resolve().name + "_report")
    written = write_report(found, target)
    if as_json:
        click.echo(json.dumps({**document(found), "written": [str(path) for path in written]}, indent=1))
        return
    for line in lines(found):
        click.echo(line)
    click.echo(f"{'written:':<16}{', '.join(str(path) for path in written)}")
