"""Maps made by hand, and real servers in this process and in others."""

from __future__ import annotations

import contextlib
import hashlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from fleetmap.manifest import Manifest, make_manifest, manifest_version
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
    lons, lats = [place[0] for place in path_lonlat], [place[1] for place in path_lonlat]
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
            "bbox_lonlat": (min(lons), min(lats), max(lons), max(lats)),
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
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def server(tmp_path: Path, endpoint: str) -> Iterator[RunningServer]:
    with running_server(ServerSettings(tmp_path / "store", endpoint, http_port=0)) as running:
        yield running


class ServerProcess:
    """``fleetmap serve`` in a process of its own; ready when constructed."""

    def __init__(self, store: Path, endpoint: str) -> None:
        arguments = ["serve", "--store", str(store), "--zenoh", endpoint, "--http", "127.0.0.1:0"]
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
def start_server() -> Iterator[Callable[[Path, str], ServerProcess]]:
    started: list[ServerProcess] = []

    def start(store: Path, endpoint: str) -> ServerProcess:
        started.append(ServerProcess(store, endpoint))
        return started[-1]

    yield start
    for server in started:
        with contextlib.suppress(Exception):
            server.kill()


@pytest.fixture(scope="module")
def module_endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"
