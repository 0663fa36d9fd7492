"""``fleetmap publish``: send a map to the server."""

from __future__ import annotations

from pathlib import Path

import click
from tqdm import tqdm

from fleetmap.catalogue import MapEntry
from fleetmap.errors import ConflictError
from fleetmap.map_package import MapPackage, open_package, verify_package
from fleetmap_cli.options import ServerAccess, server_options


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@server_options
def publish(folder: Path, server: ServerAccess) -> None:
    """Send the map in FOLDER to the map server, where it becomes the latest of its id.

    Every part is checked first. An upload that was cut goes on where it stopped when the command is
    run again; what the server already has is not sent. If somebody else published a version of the same
    map meanwhile, nothing is published: run the command again if yours is to come after it.

    \b
    Example:
      fleetmap publish my_map --server tcp/127.0.0.1:7447
    """
    package = open_package(folder)
    verify_package(package)
    if not package.manifest.quality.publishable:
        reasons = "; ".join(package.manifest.quality.warnings) or "its quality check says so"
        click.echo(f"warning: map '{package.manifest.map_id}' should not be published: {reasons}", err=True)
    entry = publish_package(package, server)
    if not entry.is_latest:
        raise ConflictError(
            f"map '{entry.map_id}' had this content before, as version {entry.number}, and has a newer one; "
            f"'fleetmap maps rollback {entry.map_id} {entry.number}' makes it the latest again"
        )
    click.echo(f"published {entry.map_id}  version {entry.version[:12]}  {entry.size_bytes / 1e6:.2f} MB")


def publish_package(package: MapPackage, server: ServerAccess) -> MapEntry:
    """Send a package to a server, with a progress bar; raises as ``MapClient.publish``."""
    with (
        server.connect() as client,
        tqdm(desc="publish", unit="B", unit_scale=True, unit_divisor=1000, leave=False, disable=None) as bar,
    ):

        def show(done_bytes: int, total_bytes: int) -> None:
            bar.total = total_bytes
            bar.update(done_bytes - bar.n)

        return client.publish(package.manifest_bytes, package.part_bytes, show)
