"""``fleetmap store``: look after what a map server keeps, also while it serves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from fleetmap_cli.progress import byte_bar
from fleetmap_server.backup import back_up, restore
from fleetmap_server.collection import collect
from fleetmap_server.object_store import ObjectStore
from fleetmap_server.settings import CATALOGUE_NAME, ServerSettings
from fleetmap_server.storage import open_storage
from fleetmap_server.verification import verify

_DAY_S = 86_400


def _place(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options that say which store."""
    store = click.option(
        "--store",
        default="maps",
        show_default=True,
        metavar="FOLDER|URL",
        help="The server's store: a folder, or s3://, gs://, az:// and a bucket.",
    )
    catalogue = click.option(
        "--catalogue",
        metavar="URL",
        help="Its catalogue: postgresql://USER:PASSWORD@HOST/DATABASE or sqlite:///FILE.  "
        "[default: catalogue.sqlite in the store's folder]",
    )
    return store(catalogue(command))


@click.group()
def store() -> None:
    """Verify, back up, restore and tidy a map server's store; servers may go on meanwhile."""


@store.command("verify")
@_place
@click.option("--give-up", is_flag=True, help="Give up what is damaged: publishing its map again sends it anew.")
def verify_(store: str, catalogue: str | None, give_up: bool) -> int:
    """Hash every blob anew and check every manifest anew.

    Prints one line for each problem; exit code 1 if there is any. With --give-up, sending a map or drive again
    afterwards repairs what is damaged of it; without, nothing is changed.

    \b
    Example:
      fleetmap store verify --store maps
    """
    settings = _refuse_no_store(ServerSettings(store, catalogue=catalogue))
    with open_storage(settings) as storage, byte_bar("verify") as progress:
        found = verify(storage, progress, give_up=give_up)
    for problem in found.problems:
        click.echo(problem)
    click.echo(
        f"{found.blobs} blobs ({found.size_bytes / 1e6:.1f} MB) and {found.versions} versions of maps: "
        + (f"{len(found.problems)} problems" if found.problems else "all well")
    )
    return 1 if found.problems else 0


@store.command("backup")
@click.argument("destination")
@_place
def backup_(destination: str, store: str, catalogue: str | None) -> None:
    """Copy everything published to DESTINATION, a folder or bucket, as it is at one moment.

    Nothing is collected meanwhile. Backing up into the same place again copies only what is new; an interrupted
    backup goes on when run again.

    \b
    Example:
      fleetmap store backup /mnt/backup/maps --store maps
    """
    settings = _refuse_no_store(ServerSettings(store, catalogue=catalogue))
    with open_storage(settings) as storage, byte_bar("backup") as progress:
        made = back_up(storage, _destination(destination), progress)
    click.echo(
        f"backed up {made.blobs} blobs ({made.size_bytes / 1e6:.1f} MB; {made.copied} were new) as {made.name}"
    )


@store.command("restore")
@click.argument("source")
@_place
def restore_(source: str, store: str, catalogue: str | None) -> None:
    """Fill an empty store, and an empty catalogue, with the latest backup in SOURCE.

    The catalogue may be of another kind than the one that was saved: this is also how a server moves from SQLite
    to PostgreSQL, and from a folder to a bucket. An interrupted restore goes on when run again.

    \b
    Example:
      fleetmap store restore /mnt/backup/maps --store s3://fleet/maps --catalogue postgresql://fleet@db/fleet
    """
    _refuse_absent(source)
    with open_storage(ServerSettings(store, catalogue=catalogue)) as storage, byte_bar("restore") as progress:
        made = restore(ObjectStore(source), storage, progress)
    click.echo(f"restored {made.blobs} blobs ({made.size_bytes / 1e6:.1f} MB) of {made.name}")


@store.command("collect")
@_place
@click.option(
    "--abandoned-days",
    type=click.FloatRange(min=0.0),
    default=7.0,
    show_default=True,
    help="Uploads that nobody went on with for so long are given up.",
)
def collect_(store: str, catalogue: str | None, abandoned_days: float) -> None:
    """Delete what nothing refers to any more: parts of retired versions, uploads that were given up.

    A running server does this every hour by itself.

    \b
    Example:
      fleetmap store collect --store maps
    """
    settings = _refuse_no_store(ServerSettings(store, catalogue=catalogue))
    with open_storage(settings) as storage:
        collected = collect(storage.database, storage.objects, abandoned_after_s=abandoned_days * _DAY_S)
    click.echo(f"deleted {collected.objects} objects ({collected.bytes / 1e6:.1f} MB)")


def _refuse_absent(place: str) -> None:
    """A folder that is not there is a slip of the pen, not an empty store."""
    if "://" not in place and not Path(place).is_dir():
        raise click.UsageError(f"there is no folder {place}")


def _refuse_no_store(settings: ServerSettings) -> ServerSettings:
    """Nor is a folder that no server ever used."""
    _refuse_absent(str(settings.store))
    if settings.catalogue is None and not (catalogue := Path(settings.store) / CATALOGUE_NAME).is_file():
        raise click.UsageError(f"{settings.store} is no map server's store: there is no {catalogue}")
    return settings


def _destination(place: str) -> ObjectStore:
    objects = ObjectStore(place)
    objects.check()
    return objects
