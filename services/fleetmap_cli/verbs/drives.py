"""``fleetmap drives``: the survey drives that a map server keeps."""

from __future__ import annotations

import json
import re
from pathlib import Path

import click

from fleetmap.errors import InputError
from fleetmap.files import refuse_existing
from fleetmap.jobs import DriveEntry, JobEntry
from fleetmap.transport import MapClient
from fleetmap_cli.options import ServerAccess, server_options
from fleetmap_cli.progress import byte_bar
from fleetmap_cli.search_options import AREA, TIME_SPAN, TimeSpan
from fleetmap_cli.tables import megabytes, rows_of_text, table, utc_text


@click.group()
def drives() -> None:
    """Ask a map server for the survey drives that were uploaded to it."""


@drives.command("list")
@server_options
@click.option("--area", type=AREA, help="Only drives through this box of degrees.")
@click.option("--time", "span", type=TIME_SPAN, help="Only drives in this time (ISO 8601, UTC, '..' is open).")
@click.option("--json", "as_json", is_flag=True, help="All that the server knows, as a JSON list.")
def list_(
    server: ServerAccess,
    area: tuple[float, float, float, float] | None,
    span: TimeSpan | None,
    as_json: bool,
) -> None:
    """List the drives, last received first.

    \b
    Example:
      fleetmap drives list --server tcp/127.0.0.1:7447 --time 2026-03-01/..
    """
    span = span or TimeSpan()
    with server.connect() as client:
        found = client.drives(area_lonlat=area, from_ns=span.from_ns, until_ns=span.until_ns)
    if as_json:
        click.echo(json.dumps([_document(drive) for drive in found], indent=1))
    else:
        click.echo(table(_HEADINGS, [_row(drive) for drive in found], "no drives"))


@drives.command()
@click.argument("drive", metavar="DRIVE")
@server_options
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document instead of text.")
def show(drive: str, server: ServerAccess, as_json: bool) -> None:
    """Show one drive, what its check found, and the jobs that map it. DRIVE is the beginning of its hash.

    \b
    Example:
      fleetmap drives show 3f1c9a0b
    """
    with server.connect() as client:
        found = _find(client, drive)
        its_jobs = client.jobs(drive=found.sha256)
    if as_json:
        document = {**_document(found), "jobs": [job.model_dump(mode="json") for job in its_jobs]}
        click.echo(json.dumps(document, indent=1))
    else:
        click.echo(_description(found, its_jobs))


@drives.command()
@click.argument("drive", metavar="DRIVE")
@server_options
@click.option(
    "--output", type=click.Path(path_type=Path), help="Write it here.  [default: its name, in this folder]"
)
@click.option("--force", is_flag=True, help="Replace an existing file.")
def get(drive: str, server: ServerAccess, output: Path | None, force: bool) -> None:
    """Fetch the recording of a drive, verified. A fetch that was cut goes on where it stopped.

    \b
    Example:
      fleetmap drives get 3f1c9a0b --output survey.mcap
    """
    with server.connect() as client, byte_bar("fetch") as bar:
        found = _find(client, drive)
        target = output or Path(found.name)
        refuse_existing(target, force)
        client.download_drive(found, target, bar)
    click.echo(f"{target}  {megabytes(found.size_bytes)}")


def _find(client: MapClient, drive: str) -> DriveEntry:
    """The one drive whose hash begins so."""
    if not re.fullmatch(r"[0-9a-f]{8,64}", drive):
        raise InputError(
            f"'{drive}' is no drive: give 8 or more digits of the hash that 'fleetmap drives list' shows"
        )
    found = client.drives(drive=drive)
    if not found:
        raise InputError(f"the server has no drive {drive}; 'fleetmap drives list' names those it has")
    if len(found) > 1:
        raise InputError(f"{len(found)} drives begin with {drive}; give more digits")
    return found[0]


_HEADINGS = ("drive", "name", "size", "begun (UTC)", "length", "good enough", "received (UTC)")


def _row(drive: DriveEntry) -> tuple[str, ...]:
    summary = drive.summary
    return (
        drive.sha256[:12],
        drive.name,
        megabytes(drive.size_bytes),
        utc_text(drive.start_ns),
        f"{summary.length_m:.0f} m" if summary is not None and summary.length_m is not None else "",
        _verdict(drive),
        utc_text(drive.received_ns),
    )


def _verdict(drive: DriveEntry) -> str:
    """The sender's word until a worker has looked."""
    if drive.summary is None:
        return "not looked at"
    return drive.summary.verdict + ("" if drive.state == "checked" else " (says the sender)")


def _description(drive: DriveEntry, its_jobs: list[JobEntry]) -> str:
    rows = [
        ("drive", drive.sha256),
        ("name", drive.name),
        ("size", megabytes(drive.size_bytes)),
        ("received", f"{utc_text(drive.received_ns)} UTC"),
    ]
    if drive.start_ns is not None:
        rows.append(("driven", f"{utc_text(drive.start_ns)} to {utc_text(drive.end_ns)} UTC"))
    if drive.bbox_lonlat is not None:
        rows.append(("area", ",".join(f"{value:.5f}" for value in drive.bbox_lonlat)))
    if (summary := drive.summary) is not None:
        size_px = f"{summary.camera_width_px}x{summary.camera_height_px}" if summary.camera_width_px else "unknown"
        rate = f"{summary.image_rate_hz:.1f} Hz" if summary.image_rate_hz else "unknown rate"
        rows.append(("images", f"{summary.image_count}, {rate}, {size_px} pixels"))
        rows.append(("length", f"{summary.length_m:.0f} m" if summary.length_m is not None else "unknown"))
        rows.extend((finding.aspect, f"{finding.severity}: {finding.text}") for finding in summary.findings)
    rows.append(("good enough", _verdict(drive)))
    for job in its_jobs:
        state = f"{job.stage} {job.percent} %" if job.state == "running" and job.stage else job.reason
        rows.append(("job", f"{job.job_id} map '{job.map_id}' {job.state}" + (f": {state}" if state else "")))
    return rows_of_text(*rows)


def _document(drive: DriveEntry) -> dict[str, object]:
    document: dict[str, object] = drive.model_dump(mode="json")
    return document
