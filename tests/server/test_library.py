"""The library over its store and catalogue: who may open it, how maps come in, what it finds."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3

import pytest

from fleetmap.errors import ConflictError, InputError, JobLostError, MapPackageError, RunError, StorageError
from fleetmap.transport.protocol import BeginRequest, CommitRequest, MapsRequest
from fleetmap_server import uploading
from fleetmap_server.library import open_library
from fleetmap_server.problems import BadRequestError, GoneError, IncompleteUploadError, NotFoundError
from fleetmap_server.search import MapSearch
from fleetmap_server.settings import ServerSettings


@pytest.fixture
def settings(tmp_path, database_url) -> ServerSettings:
    return ServerSettings(tmp_path / "store", catalogue=database_url)


@pytest.fixture
def library(settings):
    with open_library(settings) as library:
        yield library


def begin(library, one):
    return library.begin(BeginRequest(version=one.version, size_bytes=len(one.manifest_bytes)))


def put(library, one) -> None:
    for sha256, data in ((one.version, one.manifest_bytes), *one.parts.items()):
        library.receive(one.version, sha256, len(data), 0, data)


def publish(library, one):
    put(library, one)
    return library.commit(CommitRequest(version=one.version, predecessor=begin(library, one).latest))


def commit(library, one):
    return library.commit(CommitRequest(version=one.version))


@pytest.fixture
def small_map(make_map):
    return lambda map_id, *path, seed=0: make_map(map_id=map_id, part_sizes=(100,), seed=seed, path_lonlat=path)


def found(library, *box: float) -> set[str]:
    return {entry.map_id for entry in library.search(MapSearch(box=box)).entries}


def test_a_store_opened_again_has_what_it_had(settings, make_map):
    with open_library(settings) as library:
        entry = publish(library, make_map(part_sizes=(100, 200)))
    with open_library(settings) as library:
        assert library.search(MapSearch()).entries == (entry,)
        assert library.entry("karlsruhe") == entry


def test_a_second_server_on_the_same_file_is_refused(tmp_path):
    settings = ServerSettings(tmp_path)
    with open_library(settings), pytest.raises(RunError, match="another map server uses the store"):
        open_library(settings).__enter__()
    with open_library(settings) as library:
        assert library.count() == 0


def test_several_servers_on_one_postgresql_see_each_others_maps_at_once(tmp_path, database_url, make_map):
    settings = ServerSettings(tmp_path / "store", catalogue=database_url)
    if not database_url.startswith("postgresql"):
        pytest.skip("an SQLite file belongs to one server")
    one, other = make_map(part_sizes=(100,), seed=1), make_map(part_sizes=(100,), seed=2)
    with open_library(settings) as here, open_library(settings) as there:
        put(here, one)
        entry = commit(there, one)  # what one server received the other may commit
        assert here.entry("karlsruhe") == entry
        ((sha256, data),) = one.parts.items()
        assert here.chunk(one.version, sha256, 0, 100) == data
        put(here, other)
        put(there, make_map(part_sizes=(100,), seed=3))
        seen_here, seen_there = begin(here, other).latest, begin(there, make_map(part_sizes=(100,), seed=3)).latest
        there.commit(CommitRequest(version=make_map(part_sizes=(100,), seed=3).version, predecessor=seen_there))
        with pytest.raises(ConflictError, match="karlsruhe"):
            here.commit(CommitRequest(version=other.version, predecessor=seen_here))
        assert [entry.number for entry in here.versions("karlsruhe")] == [1, 2]


def test_a_store_of_a_newer_fleetmap_is_refused_and_left_alone(tmp_path, make_map):
    settings = ServerSettings(tmp_path)
    with open_library(settings) as library:
        publish(library, make_map(part_sizes=(100,)))
    with contextlib.closing(sqlite3.connect(tmp_path / "catalogue.sqlite")) as database:
        database.execute("PRAGMA user_version = 7")
    before = (tmp_path / "catalogue.sqlite").read_bytes()
    with pytest.raises(InputError, match=r"written by a newer fleetmap \(schema 7, this one reads 2"):
        open_library(settings).__enter__()
    assert (tmp_path / "catalogue.sqlite").read_bytes() == before


def test_a_catalogue_that_is_no_database_is_refused(tmp_path):
    (tmp_path / "catalogue.sqlite").write_text("something else entirely " * 100)
    with pytest.raises(InputError, match="is no catalogue of maps"):
        open_library(ServerSettings(tmp_path)).__enter__()


def test_a_commit_before_everything_is_there_is_refused(library, make_map):
    one = make_map(part_sizes=(100, 200, 300))
    with pytest.raises(NotFoundError):
        commit(library, one)
    library.receive(one.version, one.version, len(one.manifest_bytes), 0, one.manifest_bytes)
    first, *rest = one.parts.items()
    library.receive(one.version, first[0], len(first[1]), 0, first[1])
    with pytest.raises(IncompleteUploadError, match="'karlsruhe' cannot be committed: 2 parts are missing"):
        commit(library, one)
    assert library.count() == 0
    with pytest.raises(NotFoundError):  # nothing of it is readable yet
        library.chunk(one.version, first[0], 0, 100)
    for sha256, data in rest:
        library.receive(one.version, sha256, len(data), 0, data)
    assert commit(library, one).map_id == "karlsruhe"
    assert library.chunk(one.version, rest[0][0], 0, 1000) == rest[0][1]


def test_the_same_commit_said_twice_is_one_version(library, make_map):
    one = make_map(part_sizes=(100,))
    entry = publish(library, one)
    assert commit(library, one) == entry
    assert begin(library, one).missing == ()
    assert library.versions("karlsruhe") == [entry]


def test_what_the_manifest_does_not_name_is_not_taken(library, make_map):
    one, other = make_map(seed=1, part_sizes=(100,)), make_map(seed=2, part_sizes=(100,))
    ((sha256, data),) = other.parts.items()
    ((own, _),) = one.parts.items()
    with pytest.raises(NotFoundError):
        library.receive(one.version, sha256, 100, 0, data)
    library.receive(one.version, one.version, len(one.manifest_bytes), 0, one.manifest_bytes)
    for name, size in ((sha256, 100), (own, 99)):
        with pytest.raises(MapPackageError, match="names no part"):
            library.receive(one.version, name, size, 0, data[:size])


def test_a_map_that_does_not_fit_the_disk_is_refused_before_it_is_sent(library, make_map, tmp_path, monkeypatch):
    one = make_map(part_sizes=(1000,))
    library.receive(one.version, one.version, len(one.manifest_bytes), 0, one.manifest_bytes)
    monkeypatch.setattr(uploading, "_RESERVE_BYTES", shutil.disk_usage(tmp_path).free + 10**12)
    with pytest.raises(StorageError, match="has room for 0 MB"):
        begin(library, one)


def test_a_manifest_that_no_catalogue_page_could_hold_is_refused(library, make_map):
    path = tuple((8.0 + 1e-6 * n, 49.123456) for n in range(70_000))
    one = make_map(part_sizes=(10,), path_lonlat=path)
    with pytest.raises(MapPackageError, match="too long for a catalogue"):
        library.receive(one.version, one.version, len(one.manifest_bytes), 0, one.manifest_bytes)


def test_long_lists_come_in_pages_that_fit_a_message(library, make_map):
    path = tuple((8.0 + 1e-6 * n, 49.123456) for n in range(12_000))
    for seed in range(4):
        publish(library, make_map(map_id=f"long-{seed}", part_sizes=(10,), seed=seed, path_lonlat=path))
        publish(library, make_map(map_id="one", part_sizes=(10,), seed=seed, path_lonlat=path))
    for request in (MapsRequest(), MapsRequest(map_id="one", versions="all")):
        told, pages, after = [], 0, None
        while pages == 0 or after is not None:
            page = library.page(request.model_copy(update={"after": after}))
            assert len(page.model_dump_json()) < 1_000_000
            told += [(entry.map_id, entry.number) for entry in page.maps]
            pages, after = pages + 1, page.next_after
        assert pages > 1
        assert len(set(told)) == len(told) == (5 if request.map_id is None else 4)


def test_a_retired_map_is_gone_and_a_retired_version_too(library, make_map):
    old, new = make_map(part_sizes=(100,), seed=1), make_map(part_sizes=(100,), seed=2)
    publish(library, old)
    publish(library, new)
    library.retire("karlsruhe", old.version)
    with pytest.raises(GoneError):
        library.manifest_ticket("karlsruhe", old.version)
    assert library.manifest_ticket("karlsruhe", None).version == new.version
    library.retire("karlsruhe")
    with pytest.raises(GoneError):
        library.entry("karlsruhe")
    assert library.page(MapsRequest()).maps == ()
    assert publish(library, new).number == 3


def test_a_job_is_fulfilled_in_the_commit_or_neither_is(library, make_map):
    one = make_map(part_sizes=(100,))
    drive = "d" * 64
    with library.storage.database.writing() as connection:
        library.drives.add(connection, drive, "survey.mcap", 1000)
        job = library.jobs.queue(connection, drive, "karlsruhe")
    taken = library.jobs.take("worker")
    put(library, one)
    with pytest.raises(JobLostError):
        library.commit(CommitRequest(version=one.version, job_id=job.job_id, fence=taken.fence + 1))
    other = make_map(map_id="elsewhere", part_sizes=(100,))
    put(library, other)
    with pytest.raises(BadRequestError, match="asks for map 'karlsruhe'"):
        library.commit(CommitRequest(version=other.version, job_id=job.job_id, fence=taken.fence))
    assert library.count() == 0
    library.commit(CommitRequest(version=one.version, job_id=job.job_id, fence=taken.fence))
    library.commit(CommitRequest(version=one.version, job_id=job.job_id, fence=taken.fence))  # its answer got lost
    done = library.jobs.get(job.job_id)
    assert (done.state, done.version, library.count()) == ("done", one.version, 1)


def test_boxes_find_the_maps_they_touch(library, small_map):
    publish(library, small_map("south", (8.0, 48.0), (8.1, 48.1)))
    publish(library, small_map("north", (8.0, 50.0), (8.1, 50.1)))
    assert found(library, 7.0, 47.0, 9.0, 51.0) == {"south", "north"}
    assert found(library, 8.1, 50.1, 8.2, 50.2) == {"north"}  # touching is meeting
    assert found(library, 8.04, 48.04, 8.05, 48.05) == {"south"}  # inside
    assert found(library, 8.1000001, 47.0, 9.0, 51.0) == set()
    assert found(library, 7.0, 48.2, 9.0, 49.9) == set()
    assert found(library, 170.0, 40.0, 8.05, 60.0) == {"south", "north"}  # across 180 degrees
    assert found(library, 9.0, 40.0, 7.9, 60.0) == set()


def test_maps_across_the_antimeridian_are_found_from_both_sides(library, make_map):
    path = ((179.9, -17.0), (-179.9, -16.0))
    one = make_map(map_id="fiji", part_sizes=(10,), path_lonlat=path)
    manifest = one.manifest.model_copy(update={"bbox_lonlat": (179.9, -17.0, -179.9, -16.0)})
    publish(library, type(one)(manifest, manifest.to_bytes(), one.parts))
    assert found(library, 179.95, -18.0, 179.99, -15.0) == {"fiji"}
    assert found(library, -180.0, -18.0, -179.95, -15.0) == {"fiji"}
    assert found(library, 179.0, -18.0, -179.0, -15.0) == {"fiji"}
    assert found(library, -179.8, -18.0, 179.8, -15.0) == set()


def test_a_new_version_moves_the_map_to_where_it_now_is(library, small_map):
    publish(library, small_map("moving", (8.0, 48.0), (8.1, 48.1)))
    publish(library, small_map("moving", (9.0, 49.0), (9.1, 49.1)))
    assert found(library, 7.9, 47.9, 8.2, 48.2) == set()
    assert found(library, 8.9, 48.9, 9.2, 49.2) == {"moving"}
    assert library.count() == 1
