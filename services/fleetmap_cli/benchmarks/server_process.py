"""``fleetmap serve`` in a process of its own, on the same ports whenever it starts again."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fleetmap.errors import RunError
from fleetmap_cli.demo_processes import free_port

_FLEETMAP = (sys.executable, "-P", "-c", "from fleetmap_cli.main import main; main()")
_PATIENCE_S = 30.0


class ServerProcess:
    """A map server with a store in ``folder``; ready when constructed.

    Raises:
        RunError: it did not start; the message holds the last it said.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.port, http_port = free_port(), free_port()
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        self._arguments = [
            "serve",
            "--store",
            "maps",
            "--zenoh",
            self.endpoint,
            "--http",
            f"127.0.0.1:{http_port}",
        ]
        self._process = self._started()

    def restart(self) -> None:
        """Kill it without any warning, and start another in its place."""
        self.kill()
        self._process = self._started()

    def kill(self) -> None:
        """SIGKILL; returns when it is gone."""
        self._process.kill()
        self._process.communicate()

    def stop(self) -> None:
        """Ask it to end."""
        self._process.terminate()
        try:
            self._process.communicate(timeout=_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.kill()

    @property
    def peak_memory_bytes(self) -> int:
        """The most memory that it has held at once (VmHWM)."""
        lines = Path(f"/proc/{self._process.pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:"))

    def _started(self) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [*_FLEETMAP, *self._arguments],
            cwd=self._folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
            process_group=0,
        )
        assert process.stdout is not None
        if not process.stdout.readline().startswith("serving "):
            process.kill()
            process.communicate()
            raise RunError(f"'fleetmap serve' did not start on {self.endpoint}; what it said stands above")
        return process


@contextmanager
def map_server(folder: Path) -> Iterator[ServerProcess]:
    """A server for as long as the block runs."""
    server = ServerProcess(folder)
    try:
        yield server
    finally:
        server.stop()
