"""Maps go up, are listed, and come down again: real Zenoh sessions over loopback."""

from __future__ import annotations

import hashlib
from concurrent.futures import ThreadPoolExecutor

import pytest

from fleetmap.catalogue import MapEntry
from fleetmap.errors import InputError, MapPackageError, ServerRefusedError
from fleetmap.manifest import parse_manifest
from fleetmap.transport import MapClient

MIB = 1024 * 1024


def fetch(client: MapClient, map_id: str) -> tuple[bytes, dict[str, bytes]]:
    data = client.manifest(map_id)
    version = hashlib.sha256(data).hexdigest()
    records = parse_manifest(data, map_id).parts
    return data, {r.sha256: client.part(map_id, version, r.sha256, r.size_bytes) for r in records}


def test_a_published_map_is_listed_and_comes_back_byte_for_byte(server, make_map):
    sizes = (3 * MIB + 17, MIB, 2 * MIB, 1, 9 * MIB)
    original = make_map(part_sizes=sizes)
    with MapClient(server.zenoh_endpoint) as client:
        assert client.list_maps() == []
        entry = client.publish(original.manifest_bytes, original.parts.__getitem__)
        listed = client.list_maps()
        manifest_bytes, parts = fetch(client, "karlsruhe")

    assert listed == [entry]
    assert manifest_bytes == original.manifest_bytes
    assert parts == original.parts
    assert entry == MapEntry.from_manifest(
        original.manifest, original.version, len(original.manifest_bytes), entry.published_ns
    )
    assert entry.size_bytes == original.size_bytes
    assert entry.published_ns > 1_700_000_000_000_000_000


def test_progress_counts_every_byte_once(server, make_map):
    original = make_map()
    seen: list[tuple[int, int]] = []
    with MapClient(server.zenoh_endpoint) as client:
        client.publish(
            original.manifest_bytes, original.parts.__getitem__, lambda done, total: seen.append((done, total))
        )
    done = [n for n, _ in seen]
    assert {total for _, total in seen} == {original.size_bytes}
    assert done == sorted(done)
    assert done[-1] == original.size_bytes
    assert len(set(done)) >= 5  # the manifest, 3 chunks of the first part, the second part


def test_publishing_the_same_map_again_changes_and_sends_nothing(server, make_map):
    original = make_map()

    def no_part(sha256: str) -> bytes:
        raise AssertionError("a part was asked for")

    with MapClient(server.zenoh_endpoint) as client:
        first = client.publish(original.manifest_bytes, original.parts.__getitem__)
        again = client.publish(original.manifest_bytes, no_part)
        assert client.list_maps() == [first]
    assert again == first


def test_a_new_version_becomes_the_latest_and_the_old_one_stays(server, make_map):
    old, new = make_map(seed=1), make_map(seed=2)
    with MapClient(server.zenoh_endpoint) as client:
        first = client.publish(old.manifest_bytes, old.parts.__getitem__)
        second = client.publish(new.manifest_bytes, new.parts.__getitem__)
        assert client.list_maps() == [second]
        assert client.manifest("karlsruhe") == new.manifest_bytes
        assert client.manifest("karlsruhe", old.version) == old.manifest_bytes
        for sha256, data in old.parts.items():
            assert client.part("karlsruhe", old.version, sha256, len(data)) == data
        third = client.publish(old.manifest_bytes, old.parts.__getitem__)
        assert client.list_maps() == [third]
    assert first.published_ns < second.published_ns < third.published_ns
    assert third.version == old.version


def test_versions_share_the_parts_they_have_in_common(server, make_map):
    old = make_map(part_sizes=(500_000, 400_000))
    new = make_map(part_sizes=(500_000, 400_000, 300_000))
    asked: list[str] = []

    def part(sha256: str) -> bytes:
        asked.append(sha256)
        return new.parts[sha256]

    with MapClient(server.zenoh_endpoint) as client:
        client.publish(old.manifest_bytes, old.parts.__getitem__)
        client.publish(new.manifest_bytes, part)
    assert asked == [sha256 for sha256 in new.parts if sha256 not in old.parts]


def test_several_clients_publish_and_fetch_at_once(server, make_map):
    originals = {f"map-{n}": make_map(map_id=f"map-{n}", seed=n // 2, part_sizes=(3_000_000,)) for n in range(6)}

    def publish_and_fetch(map_id: str) -> bool:
        original = originals[map_id]
        with MapClient(server.zenoh_endpoint) as client:
            client.publish(original.manifest_bytes, original.parts.__getitem__)
            return fetch(client, map_id) == (original.manifest_bytes, original.parts)

    with ThreadPoolExecutor(6) as pool:
        assert all(pool.map(publish_and_fetch, originals))
    with MapClient(server.zenoh_endpoint) as client:
        assert {entry.map_id for entry in client.list_maps()} == set(originals)


def test_the_catalogue_comes_in_pages_without_losing_a_map(server, make_map):
    with MapClient(server.zenoh_endpoint) as client:
        published = [
            client.publish(one.manifest_bytes, one.parts.__getitem__)
            for one in (make_map(map_id=f"map-{n}", part_sizes=(10,)) for n in range(103))
        ]
        assert client.list_maps() == published[::-1]


def test_maps_near_a_place_come_nearest_first(server, make_map):
    places = {"here": 49.000, "next": 49.004, "far": 49.100}
    with MapClient(server.zenoh_endpoint) as client:
        for map_id, lat in places.items():
            one = make_map(map_id=map_id, part_sizes=(10,), path_lonlat=((8.400, lat), (8.401, lat)))
            client.publish(one.manifest_bytes, one.parts.__getitem__)
        near = [entry.map_id for entry in client.list_maps(near=(49.003, 8.4005))]
        wide = [entry.map_id for entry in client.list_maps(near=(49.003, 8.4005), radius_m=50_000)]
        nowhere = client.list_maps(near=(-33.9, 151.2))
        with pytest.raises(InputError, match="no place on the globe"):
            client.list_maps(near=(91.0, 8.0))
    assert near == ["next", "here"]
    assert wide == ["next", "here", "far"]
    assert nowhere == []


def test_a_part_that_is_not_what_the_manifest_says_is_not_sent(server, make_map):
    original = make_map()
    tampered = {sha256: data[:-1] + b"?" for sha256, data in original.parts.items()}
    with MapClient(server.zenoh_endpoint) as client:
        with pytest.raises(MapPackageError, match=r"part .* of map 'karlsruhe' is not what its manifest names"):
            client.publish(original.manifest_bytes, tampered.__getitem__)
        assert client.list_maps() == []


def test_what_the_server_does_not_have_is_refused_in_one_line(server, make_map):
    original = make_map()
    stranger = hashlib.sha256(b"").hexdigest()
    with MapClient(server.zenoh_endpoint) as client:
        with pytest.raises(ServerRefusedError, match="no map 'nowhere'"):
            client.manifest("nowhere")
        client.publish(original.manifest_bytes, original.parts.__getitem__)
        with pytest.raises(ServerRefusedError, match=f"no version {stranger[:12]} of map 'karlsruhe'"):
            client.manifest("karlsruhe", stranger)
        with pytest.raises(ServerRefusedError, match="has no data"):
            client.part("karlsruhe", original.version, stranger, 10)
