"""``fleetmap serve``: run the map server."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from fleetmap.transport import DEFAULT_ENDPOINT
from fleetmap_server.server import run_server
from fleetmap_server.settings import (
    DEFAULT_DRAIN_S,
    DEFAULT_HTTP_HOST,
    DEFAULT_HTTP_PORT,
    DEFAULT_LEASE_S,
    ServerSettings,
)


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
    metavar="FOLDER|URL",
    default="maps",
    show_default=True,
    help="What keeps maps and drives: a folder, made if it is not there, or s3://BUCKET/PREFIX, gs://.., az://.. "
    "with credentials from the environment.",
)
@click.option(
    "--catalogue",
    metavar="URL",
    help="What remembers them: postgresql://USER:PASSWORD@HOST/DATABASE (several servers may share it) "
    "or sqlite:///FILE.  [default: an SQLite file in the store's folder]",
)
@click.option(
    "--zenoh",
    metavar="tcp/HOST:PORT",
    default=DEFAULT_ENDPOINT,
    show_default=True,
    help="Where vehicles, mappers and workers connect.",
)
@click.option(
    "--peer",
    "peers",
    metavar="tcp/HOST:PORT",
    multiple=True,
    help="Another server or Zenoh router to form a mesh with; it need not be there yet. May be given repeatedly.",
)
@click.option(
    "--localizer",
    "localizers",
    metavar="tcp/HOST:PORT",
    multiple=True,
    help="A 'fleetmap locator' that images sent to POST /localize are handed on to, with the sender's token; it "
    "need not be there yet. May be given repeatedly.",
)
@click.option(
    "--http",
    type=_HostPort(),
    default=f"{DEFAULT_HTTP_HOST}:{DEFAULT_HTTP_PORT}",
    show_default=True,
    help="Where people and browsers connect; port 0 takes any free one.",
)
@click.option(
    "--access",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Who may read and write: lines ROLE NAME SHA256_OF_TOKEN, roles none, read, write; 'read *' is for those "
    "without a token.  [default: everyone may write]",
)
@click.option(
    "--keep-versions",
    type=click.IntRange(min=1),
    metavar="N",
    help="Retire all but the newest N versions of each map, once an hour.  [default: keep all]",
)
@click.option(
    "--drain-s",
    type=click.FloatRange(min=0.0),
    default=DEFAULT_DRAIN_S,
    show_default=True,
    help="How long transfers under way may go on after SIGTERM or Ctrl-C; a second signal stops at once.",
)
@click.option(
    "--lease-s",
    type=click.FloatRange(min=0.1),
    default=DEFAULT_LEASE_S,
    show_default=True,
    help="How long a worker may be silent before its job is given to another.",
)
@click.option(
    "--log-format",
    type=click.Choice(["text", "json"]),
    help="Write one line for each request to stderr.  [default: only what goes wrong]",
)
def serve(http: tuple[str, int], zenoh: str, access: Path | None, **more: Any) -> None:
    """Run the map server: takes maps and survey drives, lists them and hands them out, over Zenoh and HTTP.

    A line that begins with "serving" says that it is ready. Ctrl-C and SIGTERM end it once transfers under way
    are finished; what it was given stays in the store.

    \b
    Examples:
      fleetmap serve --store maps --zenoh tcp/0.0.0.0:7447 --http 0.0.0.0:8000
      curl http://127.0.0.1:8000/collections/maps/items
      fleetmap serve --store s3://bucket/maps --catalogue postgresql://fleetmap@db/fleetmap --log-format json
      printf 'write mapper %s\\nread *\\n' "$(printf %s "$TOKEN" | sha256sum | cut -d' ' -f1)" > access
      fleetmap serve --access access
    """
    settings = ServerSettings(
        zenoh_endpoint=zenoh, http_host=http[0], http_port=http[1], access_file=access, **more
    )
    run_server(settings, announce=click.echo)
