"""Maps made by hand, and real servers in this process and in others."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import secrets
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from moto.server import ThreadedMotoServer

from fleetmap.footprint import bounding_box
from fleetmap.manifest import Manifest, make_manifest, manifest_version
from fleetmap_cli.benchmarks.postgresql_cluster import PostgresqlCluster, postgresql_cluster
from fleetmap_cli.benchmarks.workbench import CannotMeasureHereError
from fleetmap_server.server import RunningServer, running_server
from fleetmap_server.settings import ServerSettings


@dataclass(frozen=True)
class HandmadeMap:
    """A manifest and its parts; to the server parts are bytes."""

    manifest: Manifest
    manifest_bytes: bytes
    parts: dict[str, bytes]

    @property
    def version(self) -> str:
        return manifest_version(self.manifest_bytes)

    @property
    def size_bytes(self) -> int:
        return len(self.manifest_bytes) + sum(len(data) for data in self.parts.values())


def handmade_map(
    map_id: str = "karlsruhe",
    part_sizes: tuple[int, ...] = (2_500_000, 10_000),
    seed: int = 0,
    path_lonlat: tuple[tuple[float, float], ...] = ((8.40, 49.00), (8.41, 49.005), (8.42, 49.00)),
    publishable: bool = True,
) -> HandmadeMap:
    contents = [
        hashlib.shake_128(f"{seed}/{number}".encode()).digest(size) for number, size in enumerate(part_sizes)
    ]
    parts = {hashlib.sha256(data).hexdigest(): data for data in contents}
    manifest = make_manifest(
        {
            "map_id": map_id,
            "anchor": {"epsg": 32632, "easting_m": 456_000, "northing_m": 5_428_000, "height_m": 110},
            "map_from_vis": {"scale": 2.0, "quat_xyzw": (0, 0, 0, 1), "translation_m": (1, 2, 3)},
            "camera": {
                "width_px": 640,
                "height_px": 480,
                "fx_px": 500,
                "fy_px": 500,
                "cx_px": 320,
                "cy_px": 240,
                "distortion": (0, 0, 0, 0, 0),
            },
            "bbox_lonlat": bounding_box(np.array(path_lonlat)),
            "trajectory_lonlat": path_lonlat,
            "parts": [
                {
                    "kind": "cell",
                    "sha256": sha256,
                    "size_bytes": len(data),
                    "cell": (number, 0),
                    "keyframes": 1,
                    "landmarks": 10,
                }
                for number, (sha256, data) in enumerate(parts.items())
            ],
            "quality": {
                "keyframes": 40,
                "landmarks": 4000,
                "observations": 20_000,
                "length_m": 1700.0,
                "frames_total": 300,
                "frames_posed": 300,
                "reprojection_rms_px": 0.7,
                "gnss_fixes": 60,
                "gnss_residual_rms_m": 0.05,
                "gnss_mode": "full",
                "publishable": publishable,
                "warnings": () if publishable else ("few landmarks",),
            },
            "provenance": {
                "drive": "survey.mcap",
                "fleetmap_version": "0.1.0",
                "settings": {"seed": seed},
                "start_ns": 1_700_000_000_000_000_000,
                "end_ns": 1_700_000_060_500_000_000,
                "created_ns": 1_700_000_100_000_000_000,
            },
        },
        "the handmade map",
    )
    return HandmadeMap(manifest, manifest.to_bytes(), parts)


@pytest.fixture(scope="session")
def make_map() -> Callable[..., HandmadeMap]:
    return handmade_map


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def unused_ports() -> Callable[[], int]:
    return free_port


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def server(tmp_path: Path, endpoint: str) -> Iterator[RunningServer]:
    with running_server(ServerSettings(tmp_path / "store", endpoint, http_port=0)) as running:
        yield running


class ServerProcess:
    """``fleetmap serve`` in a process of its own; ready when constructed."""

    def __init__(self, store: Path, endpoint: str, *options: str) -> None:
        arguments = ["serve", "--store", str(store), "--zenoh", endpoint, "--http", "127.0.0.1:0", *options]
        self.process = subprocess.Popen(
            [sys.executable, "-c", "from fleetmap_cli.main import main; main()", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        self.announcement = self.process.stdout.readline()
        if not self.announcement.startswith("serving "):
            raise AssertionError(f"no server: {self.process.communicate(timeout=10)}")
        self.http_url = self.announcement.split("HTTP ")[1].strip()

    def kill(self) -> None:
        """Death without any last words; returns when the process is gone."""
        self.process.kill()
        self.process.communicate(timeout=10)

    def stop(self, number: int = signal.SIGTERM) -> tuple[int, str]:
        """Asks it to end; exit code and what it said on stderr."""
        if self.process.poll() is None:
            os.kill(self.process.pid, number)
        _, err = self.process.communicate(timeout=20)
        return self.process.returncode, err


@pytest.fixture
def start_server() -> Iterator[Callable[..., ServerProcess]]:
    started: list[ServerProcess] = []

    def start(store: Path, endpoint: str, *options: str) -> ServerProcess:
        started.append(ServerProcess(store, endpoint, *options))
        return started[-1]

    yield start
    for server in started:
        with contextlib.suppress(Exception):
            server.kill()


@pytest.fixture(scope="module")
def module_endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture(scope="session")
def postgresql() -> Iterator[PostgresqlCluster]:
    """A PostgreSQL of the tests' own; they are skipped where it is not installed."""
    with contextlib.ExitStack() as stack:
        try:
            cluster = stack.enter_context(postgresql_cluster())
        except CannotMeasureHereError as error:
            pytest.skip(str(error))
        yield cluster


@pytest.fixture(params=["sqlite", "postgresql"])
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """A catalogue that does not exist yet, of either kind."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'catalogue.sqlite'}"
    cluster: PostgresqlCluster = request.getfixturevalue("postgresql")
    return cluster.new_database()


@pytest.fixture(scope="session")
def s3_endpoint() -> Iterator[str]:
    """The address of an S3 service of our own."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # it logs every request otherwise
    service = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    service.start()
    host, port = service.get_host_and_port()
    yield f"http://{host}:{port}"
    service.stop()


@pytest.fixture
def s3_bucket(s3_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of a new and empty bucket; the environment says how to get at it."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", s3_endpoint)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    monkeypatch.setenv("AWS_REGION", "us-east-1")
    name = f"test-{secrets.token_hex(6)}"
    with urllib.request.urlopen(urllib.request.Request(f"{s3_endpoint}/{name}", method="PUT")):
        return name


@pytest.fixture(params=["folder", "s3"])
def store_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """An object store that is empty, of either kind."""
    if request.param == "folder":
        return str(tmp_path / "store")
    return f"s3://{request.getfixturevalue('s3_bucket')}/prefix"


@pytest.fixture(params=["folder, sqlite", "s3, postgresql"])
def storage_urls(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, str]:
    """An object store and a catalogue that are empty, each kind of both once."""
    if request.param == "folder, sqlite":
        return str(tmp_path / "store"), f"sqlite:///{tmp_path / 'catalogue.sqlite'}"
    cluster: PostgresqlCluster = request.getfixturevalue("postgresql")
    return f"s3://{request.getfixturevalue('s3_bucket')}/prefix", cluster.new_database()
