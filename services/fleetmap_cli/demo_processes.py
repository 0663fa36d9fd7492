"""Other verbs of ``fleetmap`` in processes of their own, none of which outlives its caller."""

from __future__ import annotations

import re
import shlex
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import click

from fleetmap.errors import RunError

_FLEETMAP = (sys.executable, "-P", "-c", "from fleetmap_cli.main import main; main()")
_PATIENCE_S = 10.0  # for a process that was asked to end


@dataclass(frozen=True)
class ServerAddress:
    """Where a running map server answers."""

    zenoh_endpoint: str
    http_url: str


def run_verb(arguments: Sequence[str], folder: Path) -> None:
    """Show a command, run it in ``folder`` and wait for its end; it prints where we do.

    Raises:
        RunError: it did not end well. It has said why on stderr.
    """
    _show(arguments)
    with _process(arguments, folder) as process:
        code = process.wait()
    if code != 0:
        raise RunError(f"'fleetmap {arguments[0]}' ended with exit code {code}; what it said stands above")


@contextmanager
def running_map_server(store: str, folder: Path) -> Iterator[ServerAddress]:
    """``fleetmap serve`` on free ports of this machine, ready to answer, for as long as the block runs.

    Raises:
        RunError: it did not start. It has said why on stderr.
    """
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    arguments = ["serve", "--store", store, "--zenoh", endpoint, "--http", "127.0.0.1:0"]
    _show(arguments)
    with _process(arguments, folder, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        announcement = process.stdout.readline()  # comes when the server is ready, or empty when it ends before
        address = re.match(r"serving .* HTTP (http://\S+)", announcement)
        if address is None:
            raise RunError(f"'fleetmap serve' did not start on {endpoint}; what it said stands above")
        click.echo(announcement.rstrip())
        yield ServerAddress(endpoint, address[1])


@contextmanager
def interrupted_once() -> Iterator[None]:
    """The first SIGINT, SIGTERM or SIGHUP raises KeyboardInterrupt, later ones do not disturb the tidying up.

    Signals that were ignored before stay ignored. Main thread only.
    """
    numbers = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    before = {number: handler for number in numbers if (handler := signal.getsignal(number)) != signal.SIG_IGN}

    def interrupt(number: int, frame: FrameType | None) -> None:
        for other in before:
            signal.signal(other, signal.SIG_IGN)
        raise KeyboardInterrupt

    for number in before:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _process(arguments: Sequence[str], folder: Path, stdout: int | None = None) -> Iterator[subprocess.Popen[str]]:
    """A verb that runs; it is asked to end, and after a while made to, when the block does.

    Its process group is its own: Ctrl-C reaches us alone, and one line tells of it.
    """
    sys.stdout.flush()
    process = subprocess.Popen(
        [*_FLEETMAP, *arguments], cwd=folder, stdin=subprocess.DEVNULL, stdout=stdout, text=True, process_group=0
    )
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()


def _show(arguments: Sequence[str]) -> None:
    click.echo(f"$ {shlex.join(['fleetmap', *arguments])}")


def free_port() -> int:
    """A TCP port of this machine that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
