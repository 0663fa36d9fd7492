"""Rows of ``fleetmap benchmark server``: slow and broken links, and a server killed under many downloads."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from fleetmap.errors import RunError
from fleetmap.transport import MapClient
from fleetmap_cli.benchmarks.made_map import MadeMap, made_map
from fleetmap_cli.benchmarks.row import Figures
from fleetmap_cli.benchmarks.server_process import ServerProcess, map_server
from fleetmap_cli.benchmarks.throttling_proxy import Fault, ThrottlingProxy
from fleetmap_cli.benchmarks.workbench import Workbench

_DOWNLOADS, _RESTARTS = 50, 2
_DOWNLOAD_PARTS_BYTES = (2_000_000,) * 10


@dataclass(frozen=True)
class _Link:
    name: str
    bytes_per_s: float
    part_sizes_bytes: tuple[int, ...]

    @property
    def size_bytes(self) -> int:
        return sum(self.part_sizes_bytes)

    def faults(self) -> tuple[Fault, ...]:
        """Two stalls and two cuts, spread over the transfer."""
        kinds = (7.0, None, 30.0, None)
        return tuple(Fault(self.size_bytes * (2 * n + 1) // 10, stall_s) for n, stall_s in enumerate(kinds))


_LINKS = (_Link("2 MB/s", 2e6, (5_000_000,) * 4), _Link("100 kB/s", 1e5, (500_000,) * 4))


def links(bench: Workbench) -> Figures:
    """Maps up and down slow links, undisturbed and with stalls and cuts, all at once; whole, and at what share."""
    bench.shown("fleetmap benchmark server --rows links")
    with map_server(bench.folder) as server, ThreadPoolExecutor(4 * len(_LINKS)) as pool:
        started = [
            (f"{link.name}, {how}{', stalls and cuts' if faults else ''}", pool.submit(act, server, link, faults))
            for link in _LINKS
            for how, act in (("fetch", _fetched), ("publish", _published))
            for faults in ((), link.faults())
        ]
        shares = [_told(bench, label, future.result()) for label, future in started]
    return {"transfers": len(shares), "smallest share of the link": min(shares)}


def _told(bench: Workbench, label: str, figures: Figures) -> float:
    bench.beside(label, figures)
    return float(figures["share of the link"] or 0.0)


def _fetched(server: ServerProcess, link: _Link, faults: tuple[Fault, ...]) -> Figures:
    one = made_map(_map_id("fetch", link, faults), link.part_sizes_bytes)
    with MapClient(server.endpoint) as client:
        client.publish(one.manifest_bytes, one.part)

    def fetch(client: MapClient) -> None:
        for sha256, data in one.parts.items():
            if client.part(one.map_id, one.version, sha256, len(data)) != data:
                raise RunError("a part did not arrive as it was sent")

    return _over(server, link, faults, fetch)


def _published(server: ServerProcess, link: _Link, faults: tuple[Fault, ...]) -> Figures:
    one = made_map(_map_id("publish", link, faults), link.part_sizes_bytes)
    figures = _over(server, link, faults, lambda client: client.publish(one.manifest_bytes, one.part))
    with MapClient(server.endpoint) as client:
        if one.version not in [entry.version for entry in client.list_maps()]:
            raise RunError("a map that was published is not listed")
    return figures


def _map_id(how: str, link: _Link, faults: tuple[Fault, ...]) -> str:
    return f"{how}-{link.bytes_per_s:.0f}-{len(faults)}"


def _over(
    server: ServerProcess, link: _Link, faults: tuple[Fault, ...], transfer: Callable[[MapClient], object]
) -> Figures:
    """A transfer over a link; its share of what the link carries in the time that it is up."""
    with ThrottlingProxy(server.port, link.bytes_per_s, faults) as proxy, MapClient(proxy.endpoint) as client:
        started_s = time.perf_counter()
        transfer(client)
        duration_s = time.perf_counter() - started_s
        up_s = duration_s - proxy.stalled_s
        return {
            "MB": round(link.size_bytes / 1e6, 1),
            "s": round(duration_s, 1),
            "stalled s": round(proxy.stalled_s, 1),
            "connections": proxy.connections,
            "share of the link": round(link.size_bytes / up_s / link.bytes_per_s, 2),
        }


def restart(bench: Workbench) -> Figures:
    """Kill the server twice while many clients fetch a map, and start it again."""
    bench.shown("fleetmap benchmark server --rows restart")
    one = made_map("restart", _DOWNLOAD_PARTS_BYTES)
    with map_server(bench.folder) as server:
        with MapClient(server.endpoint) as client:
            client.publish(one.manifest_bytes, one.part)
        started_s = time.perf_counter()
        finished = downloads_over_restarts(server, one, _DOWNLOADS, _RESTARTS)
        duration_s = time.perf_counter() - started_s
    return {
        "downloads": _DOWNLOADS,
        "kills": _RESTARTS,
        "finished and verified": finished,
        "MB": round(_DOWNLOADS * one.size_bytes / 1e6),
        "s": round(duration_s, 1),
    }


def downloads_over_restarts(server: ServerProcess, one: MadeMap, downloads: int, restarts: int) -> int:
    """Fetch a map many times at once and kill the server meanwhile; how many downloads were whole and right.

    The kills are spread over the parts that are to arrive.
    """
    arrived = _Count()
    connected = threading.Barrier(downloads)

    def fetch() -> bool:
        with MapClient(server.endpoint) as client:
            connected.wait()
            for sha256, data in one.parts.items():
                if client.part(one.map_id, one.version, sha256, len(data)) != data:
                    return False
                arrived.add_one()
        return True

    with ThreadPoolExecutor(downloads) as pool:
        futures = [pool.submit(fetch) for _ in range(downloads)]
        for number in range(restarts):
            arrived.wait_for(downloads * len(one.parts) * (number + 1) // (restarts + 1))
            server.restart()
        return sum(future.result() for future in futures)


class _Count:
    """A number that threads raise, and that one may wait for."""

    def __init__(self) -> None:
        self._value, self._changed = 0, threading.Condition()

    def add_one(self) -> None:
        with self._changed:
            self._value += 1
            self._changed.notify_all()

    def wait_for(self, value: int) -> None:
        with self._changed:
            if not self._changed.wait_for(lambda: self._value >= value, timeout=_PATIENCE_S):
                raise RunError(f"only {self._value} of {value} parts have come within {_PATIENCE_S:.0f} s")


_PATIENCE_S = 300.0
