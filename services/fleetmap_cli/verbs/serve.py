"""``fleetmap serve``: run the map server."""

from __future__ import annotations

from pathlib import Path

import click

from fleetmap.transport import DEFAULT_ENDPOINT
from fleetmap_server.server import run_server
from fleetmap_server.settings import DEFAULT_HTTP_HOST, DEFAULT_HTTP_PORT, ServerSettings


class _HostPort(click.ParamType[tuple[str, int]]):
    """``HOST:PORT``, the host of an IPv6 address in brackets."""

    name = "HOST:PORT"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, int]:
        """Host and port, or click's usage error (exit code 2)."""
        host, colon, port = str(value).rpartition(":")
        host = host.removeprefix("[").removesuffix("]")
        if not (colon and host and port.isascii() and port.isdigit() and int(port) < 65536):
            self.fail(f"'{value}' is not HOST:PORT, for instance 127.0.0.1:8000", param, ctx)
        return host, int(port)


@click.command()
@click.option(
    "--store",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("maps"),
    show_default=True,
    help="Folder that keeps the maps; made if it is not there.",
)
@click.option(
    "--zenoh",
    metavar="tcp/HOST:PORT",
    default=DEFAULT_ENDPOINT,
    show_default=True,
    help="Where vehicles and mappers connect.",
)
@click.option(
    "--http",
    type=_HostPort(),
    default=f"{DEFAULT_HTTP_HOST}:{DEFAULT_HTTP_PORT}",
    show_default=True,
    help="Where people and browsers connect; port 0 takes any free one.",
)
def serve(store: Path, zenoh: str, http: tuple[str, int]) -> None:
    """Run the map server: takes maps, lists them and hands them out, over Zenoh and HTTP.

    A line that begins with "serving" says that it is ready. Ctrl-C ends it; what it was given
    stays in the store.

    \b
    Example:
      fleetmap serve --store maps --zenoh tcp/0.0.0.0:7447 --http 0.0.0.0:8000
      curl http://127.0.0.1:8000/collections/maps/items
    """
    settings = ServerSettings(store=store, zenoh_endpoint=zenoh, http_host=http[0], http_port=http[1])
    run_server(settings, announce=click.echo)
