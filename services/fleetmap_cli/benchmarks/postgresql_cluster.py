"""A PostgreSQL server for one measurement or test run, from the programs that are installed, thrown away after."""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from fleetmap.errors import RunError
from fleetmap_cli.benchmarks.workbench import CannotMeasureHereError
from fleetmap_cli.demo_processes import free_port

_PROGRAMS = Path("/usr/lib/postgresql")  # where Debian puts them: VERSION/bin
_PACKAGE = "(Debian: postgresql-15-postgis-3)"
_ROOM_BYTES = 4 * 1024**3
_STARTS_WITHIN_S = 60.0
_SETTINGS = {
    "listen_addresses": "127.0.0.1",
    "fsync": "off",
    "full_page_writes": "off",
    "shared_buffers": "128MB",
    "max_connections": "200",
}


@dataclass(frozen=True)
class PostgresqlCluster:
    """A running server whose user ``fleetmap`` may do everything without a password."""

    port: int
    programs: Path

    def url(self, database: str) -> str:
        """The address of a database, as --catalogue takes it."""
        return f"postgresql://fleetmap@127.0.0.1:{self.port}/{database}"

    def new_database(self, postgis: bool = True) -> str:
        """The address of a new and empty database."""
        name = f"maps_{secrets.token_hex(6)}"
        self.execute(f"CREATE DATABASE {name} TEMPLATE {'with_postgis' if postgis else 'template0'}")
        return self.url(name)

    def execute(self, sql: str, database: str = "postgres") -> str:
        """What psql prints; raises RunError with the last it said."""
        words = [
            str(self.programs / "psql"),
            "-qAtX",
            "-v",
            "ON_ERROR_STOP=1",
            "-d",
            self.url(database),
            "-c",
            sql,
        ]
        done = subprocess.run(words, capture_output=True, text=True)
        if done.returncode:
            raise RunError(f"PostgreSQL refuses '{sql[:60]}': {done.stderr.strip()}")
        return done.stdout.strip()


@contextmanager
def postgresql_cluster() -> Iterator[PostgresqlCluster]:
    """A server on a free port for as long as the block runs; nothing it holds is safe from a power cut.

    Raises:
        CannotMeasureHereError: PostgreSQL or PostGIS is not installed.
        RunError: it does not start.
    """
    found = sorted(_PROGRAMS.glob("*/bin/initdb"), key=lambda path: int(path.parts[-3]))
    if not found:
        raise CannotMeasureHereError(f"PostgreSQL is not installed {_PACKAGE}")
    programs = found[-1].parent
    with tempfile.TemporaryDirectory(prefix="fleetmap-pg-", dir=_place()) as name:
        folder = Path(name)
        with _running(folder, programs) as cluster:
            cluster.execute("CREATE DATABASE with_postgis")
            try:
                cluster.execute("CREATE EXTENSION postgis", "with_postgis")
            except RunError as error:
                raise CannotMeasureHereError(
                    "PostGIS is not installed (Debian: postgresql-15-postgis-3)"
                ) from error
            yield cluster


def _place() -> str:
    """Memory, where there is plenty: a new database is some 300 files. Short, as a socket's path has a limit."""
    memory = "/dev/shm"
    if os.access(memory, os.W_OK) and shutil.disk_usage(memory).free >= _ROOM_BYTES:
        return memory
    return "/tmp"


@contextmanager
def _running(folder: Path, programs: Path) -> Iterator[PostgresqlCluster]:
    """PostgreSQL refuses to run as root, so then it runs as the user that it brings."""
    user = "postgres" if os.geteuid() == 0 else None
    if user is not None:
        shutil.chown(folder, user, user)
    data, log = folder / "data", folder / "log"
    made = subprocess.run(
        [str(programs / "initdb"), "-D", str(data), "-U", "fleetmap", "-A", "trust", "-E", "UTF8", "--no-sync"],
        capture_output=True, text=True, cwd=folder, user=user, group=user,
    )  # fmt: skip
    if made.returncode:
        raise RunError(f"initdb failed: {made.stderr.strip()}")
    cluster = PostgresqlCluster(free_port(), programs)
    settings = _SETTINGS | {"port": str(cluster.port), "unix_socket_directories": str(folder)}
    options = [word for setting, value in settings.items() for word in ("-c", f"{setting}={value}")]
    with log.open("wb") as said:
        server = subprocess.Popen(
            [str(programs / "postgres"), "-D", str(data), *options],
            stdout=said,
            stderr=said,
            cwd=folder,
            user=user,
            group=user,
        )
        try:
            _wait_for(server, cluster, log)
            yield cluster
        finally:
            server.send_signal(signal.SIGQUIT)  # at once: nothing of it is needed any more
            server.wait()


def _wait_for(server: subprocess.Popen[bytes], cluster: PostgresqlCluster, log: Path) -> None:
    deadline = time.monotonic() + _STARTS_WITHIN_S
    ready = [str(cluster.programs / "pg_isready"), "-q", "-h", "127.0.0.1", "-p", str(cluster.port)]
    while subprocess.run(ready).returncode:
        if server.poll() is not None or time.monotonic() > deadline:
            raise RunError(f"PostgreSQL does not start: {log.read_text(errors='replace').strip()[-500:]}")
        with suppress(subprocess.TimeoutExpired):
            server.wait(timeout=0.05)
