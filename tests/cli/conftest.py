"""A map package, and a map server in another process."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

GOLDEN_PACKAGE = Path(__file__).parents[1] / "shared" / "golden" / "map_format_1"


@pytest.fixture
def map_package(tmp_path: Path) -> Path:
    """A map package of one's own."""
    return Path(shutil.copytree(GOLDEN_PACKAGE, tmp_path / "my_map"))


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def absent_server() -> str:
    return free_endpoint()


@pytest.fixture
def map_server(tmp_path: Path) -> Iterator[str]:
    """The endpoint of a ``fleetmap serve`` that runs in a process of its own."""
    with serving(tmp_path / "store") as endpoint:
        yield endpoint


@pytest.fixture(scope="session")
def shared_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """One server for all tests that do not mind what else it has."""
    with serving(tmp_path_factory.mktemp("server") / "store") as endpoint:
        yield endpoint


@pytest.fixture
def start_server() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts a ``fleetmap serve`` for a store at an endpoint; what still runs in the end is killed."""
    started: list[subprocess.Popen[str]] = []

    def start(store: Path, endpoint: str, *options: str) -> subprocess.Popen[str]:
        started.append(_serve(store, endpoint, *options))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate(timeout=10)


@contextmanager
def serving(store: Path) -> Iterator[str]:
    endpoint = free_endpoint()
    process = _serve(store, endpoint)
    yield endpoint
    os.kill(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert (process.returncode, err) == (0, "")


def _serve(store: Path, endpoint: str, *options: str) -> subprocess.Popen[str]:
    arguments = ["serve", "--store", str(store), "--zenoh", endpoint, "--http", "127.0.0.1:0", *options]
    command = [sys.executable, "-c", "from fleetmap_cli.main import main; main()", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline().startswith("serving ")
    return process
