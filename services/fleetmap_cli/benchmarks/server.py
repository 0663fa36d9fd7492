"""``fleetmap benchmark server``: how fast maps travel, beside what the machine's loopback carries at all."""

from __future__ import annotations

import hashlib
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, redirect_stdout
from statistics import median

from fleetmap.errors import RunError
from fleetmap.manifest import Manifest, make_manifest, manifest_version
from fleetmap.transport import MapClient
from fleetmap_cli.benchmarks.row import Benchmark, Figures, Row
from fleetmap_cli.benchmarks.workbench import Workbench
from fleetmap_cli.demo_processes import running_map_server

_PART_BYTES, _PART_COUNT = 12_500_000, 8
_PIECE_BYTES = 1 << 20
_REPEATS = 3


def _loopback(bench: Workbench) -> Figures:
    """Publish and fetch 100 MB, and send as much over a plain socket."""
    parts = _random_parts(_PART_COUNT, _PART_BYTES)
    manifest = _manifest(parts)
    raw = manifest.to_bytes()
    version, size_bytes = manifest_version(raw), sum(map(len, parts.values()))
    bench.shown("fleetmap benchmark server --rows loopback")
    with ExitStack() as stack:
        stack.enter_context(redirect_stdout(sys.stderr))  # the server says that it is ready
        server = stack.enter_context(running_map_server("maps", bench.folder))
        client = stack.enter_context(MapClient(server.zenoh_endpoint))
        publish_s = _timed(lambda: client.publish(raw, parts.__getitem__))
        fetch_s = median(_timed(lambda: _fetch(client, version, parts)) for _ in range(_REPEATS))
        again_s = _timed(lambda: client.publish(raw, parts.__getitem__))
    everything = b"".join(parts.values())
    tcp_s = median(_timed(lambda: _send_over_tcp(everything)) for _ in range(_REPEATS))
    return {
        "map MB": round(size_bytes / 1e6),
        "publish MB/s": round(size_bytes / publish_s / 1e6),
        "fetch MB/s": round(size_bytes / fetch_s / 1e6),
        "raw TCP MB/s": round(size_bytes / tcp_s / 1e6),
        "publish again ms": round(1e3 * again_s),
    }


def _fetch(client: MapClient, version: str, parts: dict[str, bytes]) -> None:
    for sha256, content in parts.items():
        if client.part("benchmark", version, sha256, len(content)) != content:
            raise RunError("the map that was fetched is not the one that was published")


def _random_parts(count: int, size_bytes: int) -> dict[str, bytes]:
    contents = [hashlib.shake_128(str(number).encode()).digest(size_bytes) for number in range(count)]
    return {hashlib.sha256(content).hexdigest(): content for content in contents}


def _send_over_tcp(data: bytes) -> None:
    """Through the loopback interface from one thread to another."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        sender = threading.Thread(target=_send, args=(listening.getsockname()[1], data))
        sender.start()
        connection, _ = listening.accept()
        received, buffer = 0, bytearray(_PIECE_BYTES)
        with connection:
            while count := connection.recv_into(buffer):
                received += count
        sender.join()
    if received != len(data):
        raise RunError(f"{received} of {len(data)} bytes arrived over TCP")


def _send(port: int, data: bytes) -> None:
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(data)


def _timed(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def _manifest(parts: dict[str, bytes]) -> Manifest:
    """Of a map that is nothing but its size: to the server, parts are bytes."""
    return make_manifest(
        {
            "map_id": "benchmark",
            "anchor": {"epsg": 32632, "easting_m": 456_000, "northing_m": 5_428_000, "height_m": 110},
            "map_from_vis": {"scale": 1.0, "quat_xyzw": (0, 0, 0, 1), "translation_m": (0, 0, 0)},
            "camera": {
                "width_px": 640, "height_px": 480, "fx_px": 500, "fy_px": 500, "cx_px": 320, "cy_px": 240,
                "distortion": (0, 0, 0, 0, 0),
            },
            "bbox_lonlat": (8.40, 49.00, 8.42, 49.01),
            "trajectory_lonlat": ((8.40, 49.00), (8.42, 49.01)),
            "parts": [
                {
                    "kind": "cell", "sha256": sha256, "size_bytes": len(content), "cell": (number, 0),
                    "keyframes": 1, "landmarks": 10,
                }
                for number, (sha256, content) in enumerate(parts.items())
            ],
            "quality": {
                "keyframes": len(parts), "landmarks": 10 * len(parts), "observations": 20 * len(parts),
                "length_m": 1700.0, "frames_total": 300, "frames_posed": 300, "reprojection_rms_px": 0.7,
                "gnss_fixes": 60, "gnss_residual_rms_m": 0.05, "gnss_mode": "full", "publishable": True,
                "warnings": (),
            },
            "provenance": {
                "drive": "benchmark", "fleetmap_version": "0", "settings": {}, "start_ns": 0, "end_ns": 1,
                "created_ns": 2,
            },
        },
        "the benchmark's map",
    )  # fmt: skip


BENCHMARK = Benchmark(
    "server",
    "maps published and fetched over loopback",
    (Row("loopback", "a map of 100 MB, and as much over a plain socket", _loopback),),
)
