"""Slow links, stalls, cuts, clients that fall silent and servers that die, by the benchmark's own means."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from statistics import median

import pytest

from fleetmap.transport import MapClient, protocol
from fleetmap.transport.connecting import connect
from fleetmap.transport.session import Connection
from fleetmap_cli.benchmarks.made_map import MadeMap, made_map
from fleetmap_cli.benchmarks.server_links import downloads_over_restarts
from fleetmap_cli.benchmarks.server_process import map_server
from fleetmap_cli.benchmarks.throttling_proxy import Fault, ThrottlingProxy

MIB = 1024 * 1024


def port_of(endpoint: str) -> int:
    return int(endpoint.rpartition(":")[2])


def publish(endpoint: str, one: MadeMap) -> None:
    with MapClient(endpoint) as client:
        client.publish(one.manifest_bytes, one.part)


def fetch(client: MapClient, one: MadeMap) -> bool:
    """Whether all parts come as they are."""
    return all(
        client.part(one.map_id, one.version, sha256, len(data)) == data for sha256, data in one.parts.items()
    )


@contextmanager
def connected(endpoint: str) -> Iterator[Connection]:
    deadline_s = time.monotonic() + 5.0
    connection, _ = connect([endpoint], None, deadline_s, deadline_s)
    yield connection
    connection.close()


@pytest.mark.parametrize("stall_s", [None, 0.1], ids=["cut", "stalled"])
def test_a_link_that_fails_again_and_again_costs_retries_and_no_transfer(server, stall_s):
    one = made_map("often", (1_000_000, 400_000, 1))
    faults = [Fault(at_bytes, stall_s) for at_bytes in range(300, 3_200_000, 290_000)]
    with ThrottlingProxy(port_of(server.zenoh_endpoint), faults=faults) as proxy:
        with MapClient(proxy.endpoint) as client:
            assert client.publish(one.manifest_bytes, one.part).version == one.version
            assert client.manifest(one.map_id) == one.manifest_bytes
            assert fetch(client, one)
        assert proxy.faults_left < len(faults) // 2
        if stall_s is None:
            assert proxy.connections > len(faults) // 2


def test_a_slow_link_is_used_and_small_requests_overtake(server):
    one = made_map("slow", (500_000,))
    publish(server.zenoh_endpoint, one)
    rate = 250e3
    with (
        ThrottlingProxy(port_of(server.zenoh_endpoint), rate) as proxy,
        MapClient(proxy.endpoint) as client,
        ThreadPoolExecutor(1) as pool,
    ):
        begun_s, begun_bytes = time.monotonic(), proxy.carried_bytes
        download = pool.submit(fetch, client, one)
        while proxy.carried_bytes < begun_bytes + 150_000:
            time.sleep(0.005)
        assert [entry.map_id for entry in client.list_maps()] == ["slow"]
        assert not download.done()
        assert download.result()
        duration_s = time.monotonic() - begun_s
    assert one.size_bytes / rate / duration_s > 0.6  # of what the link carries; the benchmark asks for more


def test_a_client_that_falls_silent_holds_nobody_up(server):
    one = made_map("silent", (16 * MIB,))
    publish(server.zenoh_endpoint, one)
    (sha256,) = one.parts
    silent = threading.Event()
    faults = [Fault(MIB, stall_s=60.0)]
    with (
        ThrottlingProxy(port_of(server.zenoh_endpoint), 50e6, faults, lambda fault: silent.set()) as proxy,
        connected(proxy.endpoint) as greedy,
    ):
        for number in range(16):  # five times what a client may ask for
            named = {"version": one.version, "sha256": sha256, "offset": str(number * MIB)}
            greedy.ask(protocol.CHUNK, {**named, "length_bytes": str(MIB)}, None, 60.0, bulk=True)
        assert silent.wait(30.0)
        for _ in range(5):
            with MapClient(server.zenoh_endpoint, timeout_s=10.0, patience_s=0.1) as client:
                assert fetch(client, one)
                assert [entry.map_id for entry in client.list_maps()] == ["silent"]


def test_downloads_outlive_a_killed_server(tmp_path):
    one = made_map("killed", (1_500_000,) * 4)
    with map_server(tmp_path) as server:
        publish(server.endpoint, one)
        assert downloads_over_restarts(server, one, downloads=5, restarts=1) == 5


def test_tiles_come_sooner_than_bulk(server):
    large, tile = made_map("large", (8 * MIB,)), made_map("tile", (200_000,))
    for one in (large, tile):
        publish(server.zenoh_endpoint, one)
    over = threading.Event()

    def fetch_large() -> list[float]:
        with MapClient(server.zenoh_endpoint) as client:
            durations_s = []
            while not over.is_set() or not durations_s:
                durations_s.append(timed(lambda: fetch(client, large)))
        return durations_s

    with ThreadPoolExecutor(4) as pool, MapClient(server.zenoh_endpoint) as client:
        bulk = [pool.submit(fetch_large) for _ in range(4)]
        tiles_s = [timed(lambda: fetch(client, tile)) for _ in range(60)]
        over.set()
        bulk_s = [duration_s for future in bulk for duration_s in future.result()]
    assert median(tiles_s) < 0.5 * median(bulk_s)
    assert max(tiles_s) < 2.0 * max(bulk_s)


def timed(work: Callable[[], bool]) -> float:
    begun_s = time.monotonic()
    assert work()
    return time.monotonic() - begun_s
