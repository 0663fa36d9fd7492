"""``fleetmap maps``: what a map server has."""

from __future__ import annotations

import json
from datetime import UTC, datetime

import click

from fleetmap.catalogue import NEAR_RADIUS_M, MapEntry
from fleetmap.transport import DEFAULT_ENDPOINT, MapClient
from fleetmap_cli.options import LAT_LON


@click.group()
def maps() -> None:
    """Ask a map server for its maps."""


@maps.command("list")
@click.option(
    "--server", metavar="tcp/HOST:PORT", default=DEFAULT_ENDPOINT, show_default=True, help="The map server."
)
@click.option("--near", type=LAT_LON, help=f"Only maps within {NEAR_RADIUS_M:.0f} m of this place, nearest first.")
@click.option("--json", "as_json", is_flag=True, help="All that the catalogue knows, as a JSON list.")
def list_(server: str, near: tuple[float, float] | None, as_json: bool) -> None:
    """List the latest version of every map, newest first.

    \b
    Example:
      fleetmap maps list --server tcp/127.0.0.1:7447 --near 49.011,8.4167
    """
    with MapClient(server) as client:
        entries = client.list_maps(near)
    if as_json:
        click.echo(json.dumps([entry.model_dump(mode="json") for entry in entries], indent=1))
    else:
        click.echo(_table(entries))


_HEADINGS = ("map", "version", "EPSG", "length", "keyframes", "landmarks", "size", "published (UTC)", "")


def _table(entries: list[MapEntry]) -> str:
    if not entries:
        return "no maps"
    rows: list[tuple[str, ...]] = [
        ("map", "version", "EPSG", "length", "keyframes", "landmarks", "size", "published (UTC)", "")
    ]
    rows += [_row(entry) for entry in entries]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def _row(entry: MapEntry) -> tuple[str, ...]:
    published = datetime.fromtimestamp(entry.published_ns // 1_000_000_000, UTC)
    return (
        entry.map_id,
        entry.version[:12],
        str(entry.epsg),
        f"{entry.length_m:.0f} m",
        str(entry.keyframes),
        str(entry.landmarks),
        f"{entry.size_bytes / 1e6:.2f} MB",
        f"{published:%Y-%m-%d %H:%M:%S}",
        "" if entry.publishable else "not fit to publish",
    )
