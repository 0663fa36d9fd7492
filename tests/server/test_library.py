"""The catalogue of a store: who may open it, what it remembers, what it finds."""

from __future__ import annotations

import shutil
import sqlite3

import pytest

from fleetmap.errors import InputError, MapPackageError, RunError, StorageError
from fleetmap_server import library as library_module
from fleetmap_server.library import open_library
from fleetmap_server.problems import IncompleteUploadError, NotFoundError


def put(library, one) -> None:
    for sha256, data in ((one.version, one.manifest_bytes), *one.parts.items()):
        library.receive(one.version, sha256, len(data), 0, data)


def publish(library, one):
    put(library, one)
    return library.commit(one.version)


@pytest.fixture
def small_map(make_map):
    return lambda map_id, *path, seed=0: make_map(map_id=map_id, part_sizes=(100,), seed=seed, path_lonlat=path)


def found(library, *box: float) -> set[str]:
    entries = library.maps(box, 100, 0)
    assert library.count(box) == len(entries)
    return {entry.map_id for entry in entries}


def test_a_store_opened_again_has_what_it_had(tmp_path, make_map):
    with open_library(tmp_path) as library:
        entry = publish(library, make_map(part_sizes=(100, 200)))
    with open_library(tmp_path) as library:
        assert library.maps(None, 10, 0) == [entry]
        assert library.entry("karlsruhe") == entry


def test_a_second_server_on_the_same_store_is_refused(tmp_path):
    with open_library(tmp_path), pytest.raises(RunError, match="another map server uses the store"):
        open_library(tmp_path).__enter__()
    with open_library(tmp_path) as library:
        assert library.count() == 0


def test_a_store_of_a_newer_fleetmap_is_refused_and_left_alone(tmp_path, make_map):
    with open_library(tmp_path) as library:
        publish(library, make_map(part_sizes=(100,)))
    with sqlite3.connect(tmp_path / "catalogue.sqlite") as database:
        database.execute("PRAGMA user_version = 7")
    before = (tmp_path / "catalogue.sqlite").read_bytes()
    with pytest.raises(InputError, match=r"written by a newer fleetmap \(schema 7, this one reads 1"):
        open_library(tmp_path).__enter__()
    assert (tmp_path / "catalogue.sqlite").read_bytes() == before


def test_a_catalogue_that_is_no_database_is_refused(tmp_path):
    (tmp_path / "catalogue.sqlite").write_text("something else entirely " * 100)
    with pytest.raises(InputError, match="is no catalogue of maps"):
        open_library(tmp_path).__enter__()


def test_a_commit_before_everything_is_there_is_refused(tmp_path, make_map):
    one = make_map(part_sizes=(100, 200, 300))
    with open_library(tmp_path) as library:
        with pytest.raises(NotFoundError):
            library.commit(one.version)
        library.receive(one.version, one.version, len(one.manifest_bytes), 0, one.manifest_bytes)
        first, *rest = one.parts.items()
        library.receive(one.version, first[0], len(first[1]), 0, first[1])
        with pytest.raises(IncompleteUploadError, match="'karlsruhe' cannot be committed: 2 parts are missing"):
            library.commit(one.version)
        assert library.count() == 0
        with pytest.raises(NotFoundError):  # nothing of it is readable yet
            library.chunk(one.version, first[0], 0)
        for sha256, data in rest:
            library.receive(one.version, sha256, len(data), 0, data)
        assert library.commit(one.version).map_id == "karlsruhe"
        assert library.chunk(one.version, first[0], 0) == first[1]


def test_a_part_that_rotted_before_the_commit_is_missing(tmp_path, make_map):
    one = make_map(part_sizes=(100, 200))
    with open_library(tmp_path) as library:
        put(library, one)
        sha256, data = next(iter(one.parts.items()))
        (tmp_path / "blobs" / sha256[:2] / sha256).write_bytes(data[::-1])
        with pytest.raises(IncompleteUploadError, match="1 parts are missing"):
            library.commit(one.version)
        status = library.begin(one.version, len(one.manifest_bytes))
        assert [blob.sha256 for blob in status.missing] == [sha256]
        library.receive(one.version, sha256, len(data), 0, data)
        library.commit(one.version)


def test_what_the_manifest_does_not_name_is_not_taken(tmp_path, make_map):
    one, other = make_map(seed=1, part_sizes=(100,)), make_map(seed=2, part_sizes=(100,))
    ((sha256, data),) = other.parts.items()
    ((own, _),) = one.parts.items()
    with open_library(tmp_path) as library:
        with pytest.raises(NotFoundError):
            library.receive(one.version, sha256, 100, 0, data)
        library.receive(one.version, one.version, len(one.manifest_bytes), 0, one.manifest_bytes)
        for name, size in ((sha256, 100), (own, 99)):
            with pytest.raises(MapPackageError, match="names no part"):
                library.receive(one.version, name, size, 0, data[:size])


def test_a_map_that_does_not_fit_the_disk_is_refused_before_it_is_sent(tmp_path, make_map, monkeypatch):
    one = make_map(part_sizes=(1000,))
    with open_library(tmp_path) as library:
        library.receive(one.version, one.version, len(one.manifest_bytes), 0, one.manifest_bytes)
        monkeypatch.setattr(library_module, "_RESERVE_BYTES", shutil.disk_usage(tmp_path).free + 10**12)
        with pytest.raises(StorageError, match="has room for 0 MB"):
            library.begin(one.version, len(one.manifest_bytes))


def test_a_manifest_that_no_catalogue_page_could_hold_is_refused(tmp_path, make_map):
    path = tuple((8.0 + 1e-6 * n, 49.123456) for n in range(70_000))
    one = make_map(part_sizes=(10,), path_lonlat=path)
    with open_library(tmp_path) as library, pytest.raises(MapPackageError, match="too long for a catalogue"):
        library.receive(one.version, one.version, len(one.manifest_bytes), 0, one.manifest_bytes)


def test_boxes_find_the_maps_they_touch(tmp_path, small_map):
    with open_library(tmp_path) as library:
        publish(library, small_map("south", (8.0, 48.0), (8.1, 48.1)))
        publish(library, small_map("north", (8.0, 50.0), (8.1, 50.1)))
        assert found(library, 7.0, 47.0, 9.0, 51.0) == {"south", "north"}
        assert found(library, 8.1, 50.1, 8.2, 50.2) == {"north"}  # touching is meeting
        assert found(library, 8.04, 48.04, 8.05, 48.05) == {"south"}  # inside
        assert found(library, 8.1000001, 47.0, 9.0, 51.0) == set()
        assert found(library, 7.0, 48.2, 9.0, 49.9) == set()
        assert found(library, 170.0, 40.0, 8.05, 60.0) == {"south", "north"}  # across 180 degrees
        assert found(library, 9.0, 40.0, 7.9, 60.0) == set()


def test_maps_across_the_antimeridian_are_found_from_both_sides(tmp_path, make_map):
    one = make_map(map_id="fiji", part_sizes=(10,))
    manifest = one.manifest.model_copy(update={"bbox_lonlat": (179.9, -17.0, -179.9, -16.0)})
    fiji = type(one)(manifest, manifest.to_bytes(), one.parts)
    with open_library(tmp_path) as library:
        publish(library, fiji)
        assert found(library, 179.95, -18.0, 179.99, -15.0) == {"fiji"}
        assert found(library, -180.0, -18.0, -179.95, -15.0) == {"fiji"}
        assert found(library, 179.0, -18.0, -179.0, -15.0) == {"fiji"}
        assert found(library, -179.8, -18.0, 179.8, -15.0) == set()


def test_a_new_version_moves_the_map_to_where_it_now_is(tmp_path, small_map):
    with open_library(tmp_path) as library:
        publish(library, small_map("moving", (8.0, 48.0), (8.1, 48.1)))
        publish(library, small_map("moving", (9.0, 49.0), (9.1, 49.1)))
        assert found(library, 7.9, 47.9, 8.2, 48.2) == set()
        assert found(library, 8.9, 48.9, 9.2, 49.2) == {"moving"}
        assert library.count() == 1
