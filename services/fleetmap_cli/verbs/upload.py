"""``fleetmap upload``: send a survey drive to the map server, where workers make a map of it."""

from __future__ import annotations

import functools
from pathlib import Path

import click

from fleetmap.drives.opening import find_mcap
from fleetmap.manifest import check_map_id
from fleetmap.naming import drive_name, map_id_from
from fleetmap_cli.drive_upload import check_recording, sha256_of
from fleetmap_cli.job_following import follow_job
from fleetmap_cli.options import ServerAccess, server_options
from fleetmap_cli.patient_server import REQUEST_PATIENCE_S
from fleetmap_cli.progress import byte_bar
from fleetmap_cli.tables import megabytes


@click.command()
@click.argument("recording", type=click.Path(path_type=Path))
@server_options
@click.option("--map-id", metavar="ID", help="The id of the map to be made.  [default: the recording's name]")
@click.option("--no-map", is_flag=True, help="Only keep the drive: no map is made of it.")
@click.option("--force", is_flag=True, help="Send a recording that is not good enough to map, too.")
@click.option("--wait", is_flag=True, help="Wait until the map is published.")
def upload(
    recording: Path, server: ServerAccess, map_id: str | None, no_map: bool, force: bool, wait: bool
) -> None:
    """Send the survey drive RECORDING to the map server; a 'fleetmap worker' makes a map of it.

    RECORDING is an MCAP file, or a rosbag2 folder that holds one. It is checked as by 'fleetmap info' first. An
    upload that was cut goes on where it stopped when the command is run again, and the same drive is sent once.

    With --wait the exit code is 1 if no map came of it.

    \b
    Examples:
      fleetmap upload survey.mcap --map-id karlsruhe --server tcp/127.0.0.1:7447
      fleetmap upload survey.mcap --wait
    """
    if no_map and (map_id or wait):
        raise click.UsageError("--no-map makes no map: it goes with neither --map-id nor --wait")
    wanted = None if no_map else map_id or map_id_from(recording.resolve().stem)
    if wanted is not None:
        check_map_id(wanted)
    server.connect().close()  # whoever has no server need not wait for the check
    summary = check_recording(recording, force=force)
    with byte_bar("hash") as bar:
        sha256 = sha256_of(recording, bar)
    with server.connect() as client, byte_bar("upload") as bar:
        was_there = bool(client.drives(sha256))
        sent = client.upload_drive(
            find_mcap(recording), sha256, drive_name(recording), map_id=wanted, summary=summary, progress=bar
        )
    known = f" (the server had it already, as {sent.drive.name})" if was_there else ""
    click.echo(f"drive {sha256}  {megabytes(sent.drive.size_bytes)}{known}")
    if sent.job is None:
        return
    click.echo(f"job   {sent.job.job_id}  map {sent.job.map_id}, {sent.job.state}")
    if wait:
        job = follow_job(sent.job.job_id, functools.partial(server.connect, patience_s=REQUEST_PATIENCE_S))
        click.echo(f"map   {job.map_id}  version {(job.version or '')[:12]}")
