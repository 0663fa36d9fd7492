"""A map package, and a map server in another process."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
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
    endpoint = free_endpoint()
    arguments = ["serve", "--store", str(tmp_path / "store"), "--zenoh", endpoint, "--http", "127.0.0.1:0"]
    command = [sys.executable, "-c", "from fleetmap_cli.main import main; main()", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline().startswith("serving 0 maps of ")
    yield endpoint
    os.kill(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert (process.returncode, err) == (0, "")
