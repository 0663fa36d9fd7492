"""Asking for maps over Zenoh: by place, area, time and version, page by page; and rolling back."""

from __future__ import annotations

import json
from typing import Any

import pytest

from fleetmap.errors import ConflictError, InputError, ServerRefusedError
from fleetmap.transport import MapClient
from fleetmap.transport.session import Connection, ProblemError

START_NS, END_NS = 1_700_000_000_000_000_000, 1_700_000_060_500_000_000  # of every handmade map


def publish(client: MapClient, one: Any) -> None:
    client.publish(one.manifest_bytes, one.parts.__getitem__)


@pytest.fixture
def client(server):
    with MapClient(server.zenoh_endpoint) as client:
        yield client


def listed(server: Any, maps: list[Any]) -> None:
    """Put maps into the catalogue without their blobs, at once."""
    with server.library.storage.database.writing() as connection:
        for one in maps:
            server.library.catalogue.add(connection, one.manifest, one.version, len(one.manifest_bytes), None)


def names(entries) -> list[str]:
    return [entry.map_id for entry in entries]


def test_maps_are_found_by_area_place_and_time(client, make_map):
    for name, lon_deg in (("west", 8.40), ("middle", 8.45), ("dateline", 179.99)):
        way = ((lon_deg, 49.0), (lon_deg + 0.01 if lon_deg < 179 else -179.99, 49.0))
        publish(client, make_map(map_id=name, part_sizes=(100,), seed=len(name), path_lonlat=way))
    assert names(client.list_maps()) == ["dateline", "middle", "west"]  # newest first
    assert names(client.list_maps(area_lonlat=(8.3, 48.9, 8.42, 49.1))) == ["west"]
    assert names(client.list_maps(area_lonlat=(179.0, 48.0, -179.0, 50.0))) == ["dateline"]
    assert names(client.list_maps(area_lonlat=(8.3, 49.05, 8.5, 49.1))) == []
    assert names(client.list_maps(near=(49.0, 8.445))) == ["middle"]
    assert names(client.list_maps(near=(49.0, 8.44), radius_m=5000.0)) == ["middle", "west"]  # nearest first
    assert names(client.list_maps(near=(49.0, -180.0))) == ["dateline"]
    assert names(client.list_maps(near=(49.0, 8.44), radius_m=5000.0, area_lonlat=(8.3, 48.0, 8.42, 50.0))) == [
        "west"
    ]
    assert len(client.list_maps(from_ns=END_NS, until_ns=END_NS)) == 3
    assert client.list_maps(from_ns=END_NS + 1) == client.list_maps(until_ns=START_NS - 1) == []
    with pytest.raises(InputError, match="is no place on the globe"):
        client.list_maps(near=(91.0, 0.0))
    with pytest.raises(ServerRefusedError, match="area_lonlat"):
        client.list_maps(area_lonlat=(8.0, 49.0, 9.0, 95.0))


def test_versions_are_listed_fetched_by_any_name_rolled_back_and_retired(client, make_map):
    versions = [make_map(part_sizes=(100,), seed=seed) for seed in range(3)]
    for one in versions:
        publish(client, one)
    first, second, third = versions
    assert [(entry.number, entry.version) for entry in client.versions("karlsruhe")] == [
        (3, third.version),
        (2, second.version),
        (1, first.version),
    ]
    for name in ("1", first.version, first.version[:8]):
        assert client.manifest("karlsruhe", name) == first.manifest_bytes
    with pytest.raises(ConflictError, match=third.version[:12]):
        client.rollback("karlsruhe", "1", latest=second.version)
    back = client.rollback("karlsruhe", "1", latest=third.version)
    assert (back.number, back.version, back.predecessor) == (4, first.version, third.version)
    assert client.manifest("karlsruhe") == first.manifest_bytes
    assert client.retire("karlsruhe", third.version[:10]) == 1
    assert client.retire("karlsruhe", third.version[:10]) == 0
    with pytest.raises(ServerRefusedError, match="was retired"):
        client.manifest("karlsruhe", "3")
    with pytest.raises(ServerRefusedError, match="is the latest"):
        client.retire("karlsruhe", "4")
    assert client.retire("karlsruhe") == 3
    assert client.list_maps() == []
    with pytest.raises(ServerRefusedError, match="was retired"):
        client.versions("karlsruhe")


def test_pages_hold_each_map_once_whatever_is_published_meanwhile(client, server, make_map):
    listed(server, [make_map(map_id=f"map-{number}", part_sizes=(100,)) for number in range(53)])
    assert names(client.list_maps()) == [f"map-{number}" for number in reversed(range(53))]
    connection = Connection(server.zenoh_endpoint, 5.0)
    connection.server_id = client.hello.server_id
    first = json.loads(connection.ask("maps", {}, None, 10.0).answer())
    publish(client, make_map(map_id="late", part_sizes=(100,)))
    client.retire("map-1")
    second = json.loads(connection.ask("maps", {"after": first["next_after"]}, None, 10.0).answer())
    connection.close()
    assert [entry["map_id"] for entry in first["maps"] + second["maps"]] == [
        *(f"map-{number}" for number in reversed(range(2, 53))),
        "map-0",
    ]
    assert second["next_after"] is None


def test_the_pages_of_a_long_history_hold_each_number_once(client, server, make_map):
    first, second = make_map(part_sizes=(100,)), make_map(part_sizes=(100,), seed=1)
    publish(client, first)
    publish(client, second)
    with server.library.storage.database.writing() as connection:
        for number in range(60):
            server.library.catalogue.rollback(connection, "karlsruhe", (first, second)[number % 2].version)
    assert [entry.number for entry in client.versions("karlsruhe")] == list(range(62, 0, -1))
    connection = Connection(server.zenoh_endpoint, 5.0)
    connection.server_id = client.hello.server_id
    asked = {"map_id": "karlsruhe", "versions": "all"}
    page = json.loads(connection.ask("maps", asked, None, 10.0).answer())
    client.rollback("karlsruhe", first.version)
    rest = json.loads(connection.ask("maps", {**asked, "after": page["next_after"]}, None, 10.0).answer())
    assert [entry["number"] for entry in page["maps"] + rest["maps"]] == list(range(62, 0, -1))
    with pytest.raises(ProblemError, match="no page of a map's versions"):
        connection.ask("maps", {**asked, "after": "x"}, None, 10.0).answer()
    connection.close()
