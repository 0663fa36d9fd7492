"""The ``fleetmap`` command: finds the verb, imports it lazily, and turns errors into one line and an exit code.

Exit codes: 0 done; 1 failed while running; 2 bad input or usage; 3 a map was written, but not fit to publish;
4 an image was looked at, but it shows no place for sure.
"""

from __future__ import annotations

import importlib
import logging
import sys
from collections.abc import Sequence

import click

from fleetmap import __version__
from fleetmap.errors import FleetmapError

# verb -> (module:command, one line for `fleetmap --help`, the extra that installs what it needs)
VERBS: dict[str, tuple[str, str, str]] = {
    "demo": ("demo:demo", "Simulate, map, serve, localise and judge one short street.", "all"),
    "convert": (
        "convert:convert",
        "Turn a folder of images and measurements into an MCAP recording.",
        "recordings",
    ),
    "simulate": ("simulate:simulate", "Simulate a drive with the truth known.", "simulation"),
    "info": ("info:info", "Say what a recording holds and whether it is good enough to map.", "recordings"),
    "map": ("map:map_", "Turn a survey drive into a map anchored in UTM.", "mapper"),
    "report": ("report:report", "Draw how good a map is along its road.", "all"),
    "serve": ("serve:serve", "Run the map server (Zenoh and HTTP).", "server"),
    "publish": ("publish:publish", "Send a map to the server.", "server"),
    "maps": ("maps:maps", "List the maps of a server, roll back or retire versions.", "server"),
    "upload": ("upload:upload", "Send a survey drive to the server, where a map is made of it.", "recordings"),
    "drives": ("drives:drives", "List and fetch the survey drives of a server.", "server"),
    "jobs": ("jobs:jobs", "List, cancel and repeat the mapping of uploaded drives.", "server"),
    "worker": ("worker:worker", "Map the drives that were uploaded to a server.", "mapper"),
    "store": ("store:store", "Verify, back up, restore and tidy a map server's store.", "server"),
    "localize": (
        "localize:localize",
        "Read a vehicle's UTM pose from its camera, frame by frame.",
        "localizer",
    ),
    "locate": ("locate:locate", "Say where single images were taken.", "localizer"),
    "locator": ("locator:locator", "Say where images were taken, as a service.", "localizer"),
    "evaluate": ("evaluate:evaluate", "Judge a trajectory against a reference or a map.", "all"),
    "benchmark": ("benchmark:benchmark", "Measure a part and write table, figures and pictures.", "all"),
}

_EPILOG = (
    "Exit codes: 0 done; 1 failed while running; 2 bad input or usage; 3 map written, but not fit to publish; "
    "4 no pose for an image (locate)."
)


class _LazyVerbs(click.Group):
    """Imports a verb's module only when it is called: a vehicle does not have the server's packages."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(VERBS)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Verbs"):
            formatter.write_dl([(verb, line) for verb, (_, line, _) in VERBS.items()])

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in VERBS:
            return None
        place, _, extra = VERBS[cmd_name]
        module_name, command_name = place.split(":")
        try:
            module = importlib.import_module(f"fleetmap_cli.verbs.{module_name}")
        except ModuleNotFoundError as error:
            raise click.ClickException(
                f"'fleetmap {cmd_name}' needs the package '{error.name}': pip install 'fleetmap[{extra}]'"
            ) from error
        command: click.Command = getattr(module, command_name)
        return command


@click.command(cls=_LazyVerbs, epilog=_EPILOG, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="fleetmap")
def cli() -> None:
    """Visual maps anchored in UTM, shared by a fleet: one survey drive, everybody's pose."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s", stream=sys.stderr)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one verb and exit with its code."""
    try:
        code = cli.main(
            args=None if arguments is None else list(arguments), prog_name="fleetmap", standalone_mode=False
        )
    except FleetmapError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(error.exit_code)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        sys.exit(2)
    except click.ClickException as error:
        click.echo(f"error: {_one_line(error)}", err=True)
        sys.exit(2)
    except OSError as error:  # a disk or a permission where no room expects one, such as a compiler's cache
        where = f"{error.filename}: " if error.filename else ""
        click.echo(
            f"error: {where}{error.strerror or error}; is there room on the disk, and permission?", err=True
        )
        sys.exit(1)
    except click.Abort:
        click.echo("interrupted", err=True)
        sys.exit(130)
    sys.exit(code if isinstance(code, int) else 0)


def _one_line(error: click.ClickException) -> str:
    """What was wrong, and for wrong usage where to read how it is meant."""
    message = " ".join(error.format_message().split())
    if isinstance(error, click.UsageError) and error.ctx is not None:
        return f"{message.rstrip('.')}; '{error.ctx.command_path} --help' shows how"
    return message
