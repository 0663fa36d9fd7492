"""``fleetmap locator``: say where images were taken, as a service."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import click

from fleetmap.camera import Camera
from fleetmap.transport import MapClient
from fleetmap_cli.options import ServerAccess, waiting_server_options
from fleetmap_cli.watching import stop_on_signals
from fleetmap_localizer.map_source import MapServer
from fleetmap_localizer.map_supply import MapSupply
from fleetmap_localizer.pose_service import PoseService
from fleetmap_localizer.settings import LocalizerSettings
from fleetmap_localizer.supplies import LatLon, Supplies
from fleetmap_localizer.tile_supply import map_supply_of

DEFAULT_LOCATOR_ENDPOINT = "tcp/127.0.0.1:7449"


@click.command()
@waiting_server_options
@click.option(
    "--zenoh",
    metavar="tcp/HOST:PORT",
    default=DEFAULT_LOCATOR_ENDPOINT,
    show_default=True,
    help="Where map servers and others ask.",
)
@click.option(
    "--cache",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Keep fetched map parts here.  [default: the user's cache]",
)
def locator(server: ServerAccess, zenoh: str, cache: Path | None) -> None:
    """Say where images were taken, to whoever may read on the map server, with that server's maps.

    A line that begins with "locating" says that it is ready; the map server need not be there yet. Give the
    endpoint to 'fleetmap serve --localizer', and the server's POST /localize hands its images on. Any number may
    run, on any machines. Ctrl-C and SIGTERM end it once the images under way are answered.

    \b
    Examples:
      fleetmap locator --server tcp/127.0.0.1:7447
      fleetmap serve --localizer tcp/127.0.0.1:7449
      curl -F image=@street.jpg -F camera=@camera.yaml -F near=49.0324,8.3429 http://127.0.0.1:8000/localize
    """
    settings = LocalizerSettings()

    def open_supply(camera: Camera, near: LatLon | None) -> MapSupply:
        origin = MapServer(server.endpoint, server.connect)
        return map_supply_of(origin, camera, settings, near_lat_lon_deg=near, cache=cache)

    def connect_as(token: str | None) -> MapClient:
        return MapClient(server.endpoint, token=token)

    with (
        stop_on_signals("stopping once what was asked is answered; once more to stop at once") as stop,
        closing(Supplies(open_supply)) as supplies,
        closing(PoseService(zenoh, connect_as, supplies, settings)),
    ):
        click.echo(f"locating in the maps of {server.endpoint}: Zenoh {zenoh}")
        stop.wait()
