"""A row of ``fleetmap benchmark server``: a fleet that asks for tiles while somebody fetches a large map."""

from __future__ import annotations

import multiprocessing
import random
import threading
import time
from dataclasses import dataclass, field
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Barrier, Event

import numpy as np

from fleetmap.errors import FleetmapError, RunError
from fleetmap.transport import MapClient
from fleetmap.transport.download import Blob, blob_pieces
from fleetmap.transport.link import ServerLink
from fleetmap_cli.benchmarks.made_map import MadeMap, made_map
from fleetmap_cli.benchmarks.row import Figures
from fleetmap_cli.benchmarks.server_process import map_server
from fleetmap_cli.benchmarks.workbench import Workbench

_PROCESSES, _VEHICLES_EACH = 4, 50
_DURATION_S, _EVERY_S = 60.0, 10.0
_TILES_BYTES, _LARGE_BYTES = (200_000,) * 40, (12_500_000,) * 8
_PATIENCE_S = 120.0


@dataclass
class _Seen:
    """What the vehicles of one process have seen."""

    latencies_s: list[float] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    starved: int = 0  # vehicles that never got an answer


def fleet(bench: Workbench) -> Figures:
    """200 vehicles ask for a tile every 10 s for a minute; another client fetches 100 MB over and over."""
    bench.shown("fleetmap benchmark server --rows fleet")
    tiles, large = made_map("tiles", _TILES_BYTES), made_map("large", _LARGE_BYTES)
    with map_server(bench.folder) as server:
        with MapClient(server.endpoint) as client:
            for one in (tiles, large):
                client.publish(one.manifest_bytes, one.part)
        seen, fetched = _drive(server.endpoint, tiles, large)
        peak_bytes = server.peak_memory_bytes
    latencies_s = [latency_s for one in seen for latency_s in one.latencies_s]
    errors = [error for one in seen for error in one.errors]
    p50_ms, p99_ms = np.percentile(latencies_s, (50, 99)) * 1e3
    return {
        "vehicles": _PROCESSES * _VEHICLES_EACH,
        "tiles": len(latencies_s),
        "errors": len(errors),
        "starved": sum(one.starved for one in seen),
        "p50 ms": round(float(p50_ms), 1),
        "p99 ms": round(float(p99_ms), 1),
        "max ms": round(1e3 * max(latencies_s), 1),
        "large maps fetched": fetched,
        "server peak MB": round(peak_bytes / 1e6),
        **({"first error": errors[0]} if errors else {}),
    }


def _drive(endpoint: str, tiles: MadeMap, large: MadeMap) -> tuple[list[_Seen], int]:
    """Let all vehicles drive, and fetch the large map meanwhile; what they saw, and how often it came whole."""
    processes = multiprocessing.get_context("spawn")
    ready, over = processes.Barrier(_PROCESSES + 2), processes.Event()
    told, fetched = processes.Queue(), processes.Queue()
    sizes = {sha256: len(data) for sha256, data in tiles.parts.items()}
    large_sizes = {sha256: len(data) for sha256, data in large.parts.items()}
    started = [
        processes.Process(target=_vehicles, args=(endpoint, tiles.version, sizes, seed, ready, told), daemon=True)
        for seed in range(_PROCESSES)
    ]
    args = (endpoint, large.version, large_sizes, ready, over, fetched)
    started.append(processes.Process(target=_fetch_over_and_over, args=args, daemon=True))
    for process in started:
        process.start()
    ready.wait(_PATIENCE_S)
    seen = [told.get(timeout=_DURATION_S + _PATIENCE_S) for _ in range(_PROCESSES)]
    over.set()
    count = fetched.get(timeout=_PATIENCE_S)
    for process in started:
        process.join()
    return seen, count


def _vehicles(
    endpoint: str, version: str, sizes: dict[str, int], seed: int, ready: Barrier, told: Queue[_Seen]
) -> None:
    """The vehicles of one process, each with a connection of its own."""
    seen, connected = _Seen(), threading.Barrier(_VEHICLES_EACH + 1)
    threads = [
        threading.Thread(target=_vehicle, args=(endpoint, version, sizes, 1000 * seed + n, connected, seen))
        for n in range(_VEHICLES_EACH)
    ]
    for thread in threads:
        thread.start()
    ready.wait(_PATIENCE_S)
    connected.wait(_PATIENCE_S)
    for thread in threads:
        thread.join()
    told.put(seen)


def _vehicle(
    endpoint: str, version: str, sizes: dict[str, int], seed: int, connected: threading.Barrier, seen: _Seen
) -> None:
    """Ask for a tile every 10 s; a latency counts from when the tile was due, not from when its turn came."""
    chance = random.Random(seed)
    answers = 0
    with MapClient(endpoint) as client:
        connected.wait(_PATIENCE_S)
        begun_s = time.monotonic()
        due_s = chance.uniform(0.0, _EVERY_S)
        while due_s < _DURATION_S:
            time.sleep(max(0.0, begun_s + due_s - time.monotonic()))
            sha256 = chance.choice(list(sizes))
            try:
                client.part("tiles", version, sha256, sizes[sha256])
            except FleetmapError as error:
                seen.errors.append(str(error))
            else:
                answers += 1
                seen.latencies_s.append(time.monotonic() - begun_s - due_s)
            due_s += _EVERY_S
    seen.starved += answers == 0


def _fetch_over_and_over(
    endpoint: str, version: str, sizes: dict[str, int], ready: Barrier, over: Event, fetched: Queue[int]
) -> None:
    """There is always a large download under way."""
    link = ServerLink(endpoint, timeout_s=30.0, patience_s=15.0)
    ready.wait(_PATIENCE_S)
    count = 0
    while not over.is_set():
        wanted = [(Blob(sha256, size_bytes, version, "the map"), 0) for sha256, size_bytes in sizes.items()]
        received = sum(len(piece) for piece in blob_pieces(link, wanted))
        if received != sum(sizes.values()):
            raise RunError(f"{received} of {sum(sizes.values())} bytes arrived")
        count += 1
    link.close()
    fetched.put(count)
