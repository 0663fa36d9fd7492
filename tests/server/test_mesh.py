"""Several servers on one catalogue and one store, meshed or not: to a client they are one service."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from fleetmap.errors import ConflictError
from fleetmap.transport import MapClient
from fleetmap_server.server import RunningServer, running_server
from fleetmap_server.settings import ServerSettings


def until(condition: Callable[[], Any], within_s: float = 20.0) -> None:
    deadline_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline_s, "it did not come true in time"
        time.sleep(0.01)


@pytest.fixture
def start(postgresql, tmp_path, endpoint_of) -> Iterator[Callable[..., RunningServer]]:
    """Servers of one PostgreSQL and one folder; ``start("a", "b")`` is server a, whose peer is b."""
    catalogue = postgresql.new_database()
    with ExitStack() as stack:

        def run(name: str, *peers: str) -> RunningServer:
            settings = ServerSettings(
                tmp_path / "store",
                endpoint_of(name),
                http_port=0,
                catalogue=catalogue,
                peers=tuple(map(endpoint_of, peers)),
            )
            return stack.enter_context(running_server(settings))

        yield run


@pytest.fixture
def endpoint_of(unused_ports) -> Callable[[str], str]:
    ports: dict[str, int] = {}
    return lambda name: f"tcp/127.0.0.1:{ports.setdefault(name, unused_ports())}"


def publish(client: MapClient, one: Any) -> None:
    client.publish(one.manifest_bytes, one.parts.__getitem__)


def test_what_one_server_took_in_the_other_has_at_once(start, make_map):
    a, b = start("a"), start("b", "a")
    first, second = make_map(part_sizes=(300_000,)), make_map(part_sizes=(300_000,), seed=1)
    with MapClient(a.zenoh_endpoint) as at_a, MapClient(b.zenoh_endpoint) as at_b:
        assert (at_a.hello.server_id, at_b.hello.server_id) == (a.zenoh.server_id, b.zenoh.server_id)
        assert at_a.hello.catalogue_id == at_b.hello.catalogue_id
        publish(at_a, first)
        assert at_b.manifest("karlsruhe") == first.manifest_bytes
        publish(at_b, second)
        assert [entry.version for entry in at_a.versions("karlsruhe")] == [second.version, first.version]
        (sha256,) = first.parts
        assert at_b.part("karlsruhe", first.version, sha256, 300_000) == first.parts[sha256]


def test_of_two_who_publish_the_same_map_over_two_servers_one_wins_and_the_other_is_told(start, make_map):
    a, b = start("a"), start("b", "a")
    ours, theirs = make_map(part_sizes=(3_000_000,)), make_map(part_sizes=(1000,), seed=1)
    with MapClient(a.zenoh_endpoint) as at_a, MapClient(b.zenoh_endpoint) as at_b:
        left = [lambda: publish(at_b, theirs)]

        def be_overtaken(done_bytes: int, total_bytes: int) -> None:
            if done_bytes > 1_000_000 and left:
                left.pop()()

        with pytest.raises(ConflictError, match=theirs.version[:12]):
            at_a.publish(ours.manifest_bytes, ours.parts.__getitem__, be_overtaken)
        assert [entry.version for entry in at_a.versions("karlsruhe")] == [theirs.version]
        publish(at_a, ours)  # decided anew, now knowing the other
        assert [entry.number for entry in at_b.versions("karlsruhe")] == [2, 1]


@pytest.mark.parametrize("peers", [("a",), ()], ids=["meshed", "by the catalogue alone"])
def test_what_one_server_took_in_is_announced_by_the_other_too_and_told_once(start, make_map, peers):
    a, b = start("a"), start("b", *peers)
    with MapClient(a.zenoh_endpoint) as at_a, MapClient(b.zenoh_endpoint) as at_b:
        publish(at_a, make_map(part_sizes=(1000,)))
        heard = at_b.announcements()
        assert (entry := heard.next(20.0)) is not None
        assert entry.number == 1
        publish(at_a, make_map(part_sizes=(1000,), seed=1))
        publish(at_a, make_map(map_id="other", part_sizes=(1000,), seed=2))
        told = [heard.next(20.0), heard.next(20.0)]
        assert {(entry.map_id, entry.number) for entry in told if entry} == {("karlsruhe", 2), ("other", 1)}
        assert heard.next(0.2) is None


def test_a_peer_that_is_not_there_yet_is_waited_for_while_the_server_serves(start, make_map):
    a = start("a", "b")
    with MapClient(a.zenoh_endpoint) as at_a:
        publish(at_a, make_map(part_sizes=(1000,)))
        b = start("b")
        with MapClient(b.zenoh_endpoint, vehicle_id="v-1"):
            until(lambda: a.zenoh.vehicles_online() == 1)  # heard over the mesh
            assert b.zenoh.vehicles_online() == 1
        until(lambda: a.zenoh.vehicles_online() == b.zenoh.vehicles_online() == 0)


@pytest.mark.parametrize("end", ["kill", "stop"])
def test_a_client_of_several_servers_goes_on_with_the_next_when_one_ends(
    start, start_server, tmp_path, endpoint_of, make_map, end
):
    first, second = endpoint_of("first"), endpoint_of("second")
    catalogue = start("second", "first").library.settings.catalogue
    one = start_server(tmp_path / "store", first, "--catalogue", catalogue, "--peer", second)
    original = make_map(part_sizes=(3_000_000,))
    left = [getattr(one, end)]

    def end_it(done_bytes: int, total_bytes: int) -> None:
        if done_bytes > 1_500_000 and left:
            left.pop()()

    with MapClient(f"{first},{second}") as client:
        before = client.hello.server_id
        client.publish(original.manifest_bytes, original.parts.__getitem__, end_it)
        assert not left
        assert client.hello.server_id != before
        assert client.manifest("karlsruhe") == original.manifest_bytes
