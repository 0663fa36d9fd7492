"""``fleetmap worker``: map the drives that were uploaded to a server."""

from __future__ import annotations

import functools
from pathlib import Path

import click
import platformdirs

from fleetmap_cli.mapping_job import Workplace
from fleetmap_cli.mapping_worker import run_worker
from fleetmap_cli.options import ServerAccess, waiting_server_options
from fleetmap_cli.patient_server import REQUEST_PATIENCE_S
from fleetmap_cli.watching import stop_on_signals
from fleetmap_mapper.setting_assignments import with_assignments
from fleetmap_mapper.settings import MapperSettings


@click.command()
@waiting_server_options
@click.option(
    "--folder",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="WORK",
    help="Keep recordings and half-made maps here; each worker needs a folder of its own.  "
    "[default: in the user's cache]",
)
@click.option("--once", is_flag=True, help="Take one job, or none if there is none, and end.")
@click.option(
    "--set",
    "assignments",
    multiple=True,
    metavar="GROUP.NAME=VALUE",
    help="Change one setting of the mapper for all maps; may be given several times.",
)
def worker(server: ServerAccess, folder: Path | None, once: bool, assignments: tuple[str, ...]) -> None:
    """Take mapping jobs from the map server, one after the other: fetch the drive, check it, map it, publish.

    Any number of workers may run, on any machines. Ctrl-C or SIGTERM gives the job under way back at once; a
    worker that dies leaves its job to another one, after the server's lease.

    \b
    Examples:
      fleetmap worker --server tcp/127.0.0.1:7447
      fleetmap worker --once --folder /var/lib/fleetmap/worker
    """
    settings = with_assignments(MapperSettings(), assignments)
    connect = functools.partial(server.connect, patience_s=REQUEST_PATIENCE_S)
    place = Workplace(connect, folder or Path(platformdirs.user_cache_dir("fleetmap")) / "worker", settings)
    with stop_on_signals("stopping, a job under way is given back; once more to stop at once") as stop:
        run_worker(place, stop, once=once)
