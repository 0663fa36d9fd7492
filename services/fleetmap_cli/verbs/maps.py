"""``fleetmap maps``: what a map server has, and which version of it counts."""

from __future__ import annotations

import json
import sys

import click

from fleetmap.catalogue import NEAR_RADIUS_M, MapEntry
from fleetmap.errors import InputError, TransferError
from fleetmap.manifest import Manifest, manifest_version, parse_manifest
from fleetmap.transport import MapClient
from fleetmap_cli.options import LAT_LON, ServerAccess, server_options
from fleetmap_cli.search_options import AREA, TIME_SPAN, TimeSpan
from fleetmap_cli.tables import megabytes, rows_of_text, table, utc_text


@click.group()
def maps() -> None:
    """Ask a map server for its maps, and manage their versions."""


@maps.command("list")
@server_options
@click.option("--near", type=LAT_LON, help=f"Only maps within {NEAR_RADIUS_M:.0f} m of this place, nearest first.")
@click.option("--area", type=AREA, help="Only maps in this box of degrees; WEST > EAST crosses the antimeridian.")
@click.option(
    "--time", "span", type=TIME_SPAN, help="Only maps of drives in this time (ISO 8601, UTC, '..' is open)."
)
@click.option("--all-versions", is_flag=True, help="Every version that is not retired, not only the latest.")
@click.option("--json", "as_json", is_flag=True, help="All that the catalogue knows, as a JSON list.")
def list_(
    server: ServerAccess,
    near: tuple[float, float] | None,
    area: tuple[float, float, float, float] | None,
    span: TimeSpan | None,
    all_versions: bool,
    as_json: bool,
) -> None:
    """List the latest version of every map, newest first.

    \b
    Examples:
      fleetmap maps list --server tcp/127.0.0.1:7447 --near 49.011,8.4167
      fleetmap maps list --area 8.3,48.9,8.5,49.1 --time 2026-03-01/..
    """
    span = span or TimeSpan()
    with server.connect() as client:
        entries = client.list_maps(near, area_lonlat=area, from_ns=span.from_ns, until_ns=span.until_ns)
        if all_versions:
            entries = [entry for latest in entries for entry in _newest_first(client, latest.map_id)]
    if as_json:
        click.echo(json.dumps([entry.model_dump(mode="json") for entry in entries], indent=1))
    else:
        click.echo(table(_HEADINGS, [_row(entry) for entry in entries], "no maps"))


@maps.command()
@click.argument("map_id")
@server_options
@click.option("--version", help="Another than the latest: its number, or the beginning of its hash.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document instead of text.")
def show(map_id: str, server: ServerAccess, version: str | None, as_json: bool) -> None:
    """Show one map: its quality, its parts and its versions.

    \b
    Example:
      fleetmap maps show karlsruhe
    """
    with server.connect() as client:
        data = client.manifest(map_id, version)
        manifest = parse_manifest(data, f"map '{map_id}'")
        versions = _newest_first(client, map_id)
    entry = _shown(versions, manifest_version(data), version)
    if as_json:
        document = {
            **entry.model_dump(mode="json"),
            "quality": manifest.quality.model_dump(mode="json"),
            "parts": [part.model_dump(mode="json") for part in manifest.parts],
            "versions": [version.model_dump(mode="json") for version in versions],
        }
        click.echo(json.dumps(document, indent=1))
    else:
        click.echo(_description(entry, manifest, versions))


@maps.command()
@server_options
@click.option("--json", "as_json", is_flag=True, help="One JSON document a line, all that the catalogue knows.")
def follow(server: ServerAccess, as_json: bool) -> None:
    """Print the latest version of every map, and from then on each new one as it comes; Ctrl-C ends it.

    A server that is away is waited for; nothing that was published meanwhile is missed.

    \b
    Example:
      fleetmap maps follow --server tcp/127.0.0.1:7447
    """
    with server.connect() as client:
        announcements = client.announcements()
        while True:
            try:
                entry = next(announcements)
            except TransferError as error:
                click.echo(f"{error}; waiting for it", err=True)
                continue
            click.echo(entry.model_dump_json() if as_json else _news(entry))


@maps.command()
@click.argument("map_id")
@click.argument("version", required=False)
@server_options
def rollback(map_id: str, version: str | None, server: ServerAccess) -> None:
    """Make an older VERSION the latest again: its number, or the beginning of its hash.

    Without VERSION the one before the latest. Nothing is lost: the history gets one more entry with the old
    content, and a rollback can be rolled back.

    \b
    Examples:
      fleetmap maps rollback karlsruhe
      fleetmap maps rollback karlsruhe 3
    """
    with server.connect() as client:
        latest = _newest_first(client, map_id)[0]
        if version is None and latest.predecessor_number is None:
            raise InputError(f"map '{map_id}' has no version before number {latest.number}; nothing to go back to")
        entry = client.rollback(map_id, version or str(latest.predecessor_number), latest.version)
    click.echo(f"map {entry.map_id}: number {entry.number} is the latest now, version {entry.version[:12]}")


@maps.command()
@click.argument("map_id")
@server_options
@click.option(
    "--version", help="Only this one: its number, or the beginning of its hash. It must not be the latest."
)
@click.option("--yes", is_flag=True, help="Do not ask before the whole map is retired.")
def retire(map_id: str, server: ServerAccess, version: str | None, yes: bool) -> None:
    """Take a map, or one old version of it, out of service: neither listed nor served any more.

    Its data is deleted by the next collection ('fleetmap store collect').

    \b
    Examples:
      fleetmap maps retire karlsruhe --version 2
      fleetmap maps retire karlsruhe --yes
    """
    if version is None and not yes:
        if not sys.stdin.isatty():
            raise click.UsageError(f"retiring the whole map '{map_id}' needs --yes")
        click.confirm(f"Retire map '{map_id}' with all its versions?", abort=True, err=True)
    with server.connect() as client:
        client.retire(map_id, version)
    click.echo(f"retired map {map_id}" + (f", version {version}" if version else ""))


def _newest_first(client: MapClient, map_id: str) -> list[MapEntry]:
    found = sorted(client.versions(map_id), key=lambda entry: entry.number, reverse=True)
    if not found:
        raise InputError(f"the server has no map '{map_id}'; 'fleetmap maps list' names those it has")
    return found


def _shown(versions: list[MapEntry], version: str, asked: str | None) -> MapEntry:
    """The entry of a content, which after a rollback has two: the one asked for by its number, else the newest."""
    same = [entry for entry in versions if entry.version == version]
    return next((entry for entry in same if str(entry.number) == asked), same[0])


def _news(entry: MapEntry) -> str:
    return f"{entry.map_id}  number {entry.number}  version {entry.version[:12]}  {utc_text(entry.published_ns)}"


_HEADINGS = ("map", "version", "number", "EPSG", "length", "keyframes", "landmarks", "size", "published (UTC)", "")


def _row(entry: MapEntry) -> tuple[str, ...]:
    return (
        entry.map_id,
        entry.version[:12],
        str(entry.number),
        str(entry.epsg),
        f"{entry.length_m:.0f} m",
        str(entry.keyframes),
        str(entry.landmarks),
        megabytes(entry.size_bytes),
        utc_text(entry.published_ns),
        "" if entry.publishable else "not fit to publish",
    )


def _description(entry: MapEntry, manifest: Manifest, versions: list[MapEntry]) -> str:
    quality = manifest.quality
    west, south, east, north = entry.bbox_lonlat
    cells = [part for part in manifest.parts if part.cell is not None]
    others = [f"{part.kind} {megabytes(part.size_bytes)}" for part in manifest.parts if part.cell is None]
    text = rows_of_text(
        ("map", f"{entry.map_id}, number {entry.number}" + (" (the latest)" if entry.is_latest else "")),
        ("version", entry.version),
        ("published", f"{utc_text(entry.published_ns)} UTC" + (", by a rollback" if _is_rollback(entry) else "")),
        ("drive", f"{entry.drive}, {utc_text(entry.start_ns)} to {utc_text(entry.end_ns)} UTC"),
        (
            "area",
            f"{west:.5f},{south:.5f},{east:.5f},{north:.5f} (EPSG:{entry.epsg}), {entry.length_m:.0f} m of road",
        ),
        ("size", megabytes(entry.size_bytes)),
        ("parts", ", ".join([f"{len(cells)} cells {megabytes(sum(part.size_bytes for part in cells))}", *others])),
        ("images", f"{quality.frames_posed} of {quality.frames_total} posed, {quality.keyframes} keyframes"),
        ("landmarks", f"{quality.landmarks}, reprojection {quality.reprojection_rms_px:.2f} px RMS"),
        ("GNSS", _metres(quality.gnss_residual_rms_m, "residual RMS")),
        ("position", _metres(quality.position_sigma_m, "horizontal, 1 sigma, median")),
        ("weak", f"{quality.weak_length_m or 0.0:.0f} m in {len(quality.weak_stretches)} stretches"),
        *(("warning", line) for line in (*quality.warnings, *quality.remarks)),
    )
    history = table(_HISTORY, [_history_row(version) for version in versions], "")
    return f"{text}\n\n{history}"


_HISTORY = ("number", "version", "published (UTC)", "length", "size", "landmarks", "")


def _history_row(entry: MapEntry) -> tuple[str, ...]:
    notes = [
        note
        for note, applies in (
            ("latest", entry.is_latest),
            ("rollback", _is_rollback(entry)),
            ("not fit to publish", not entry.publishable),
        )
        if applies
    ]
    return (
        str(entry.number),
        entry.version[:12],
        utc_text(entry.published_ns),
        f"{entry.length_m:.0f} m",
        megabytes(entry.size_bytes),
        str(entry.landmarks),
        ", ".join(notes),
    )


def _is_rollback(entry: MapEntry) -> bool:
    return entry.origin == "rollback"


def _metres(value_m: float | None, of_what: str) -> str:
    return "unknown" if value_m is None else f"{value_m:.3f} m ({of_what})"
