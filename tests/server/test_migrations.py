"""Catalogues of other versions: the one-file catalogue is carried over, a newer one is left alone."""

from __future__ import annotations

import contextlib
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa

from fleetmap.catalogue import MapEntry
from fleetmap.errors import InputError
from fleetmap_server.catalogue import Catalogue
from fleetmap_server.database import Database
from fleetmap_server.library import open_library
from fleetmap_server.migrations import SCHEMA_VERSION
from fleetmap_server.problems import DamagedBlobError
from fleetmap_server.search import MapSearch
from fleetmap_server.settings import ServerSettings

# The schema as the first map server wrote it.
SCHEMA_1 = """
CREATE TABLE versions (
    version TEXT PRIMARY KEY,
    map_id TEXT NOT NULL,
    published_ns INTEGER NOT NULL,
    manifest_bytes INTEGER NOT NULL,
    west REAL NOT NULL, south REAL NOT NULL, east REAL NOT NULL, north REAL NOT NULL,
    entry TEXT NOT NULL
) WITHOUT ROWID;
CREATE UNIQUE INDEX versions_of_map ON versions (map_id, published_ns);
CREATE TABLE parts (
    version TEXT NOT NULL REFERENCES versions (version),
    sha256 TEXT NOT NULL,
    size_bytes INTEGER NOT NULL,
    PRIMARY KEY (version, sha256)
) WITHOUT ROWID;
CREATE VIEW latest AS
    SELECT * FROM versions AS v
    WHERE published_ns = (SELECT max(published_ns) FROM versions WHERE map_id = v.map_id);
PRAGMA user_version = 1;
"""
FIELDS_1 = {
    "map_id", "version", "epsg", "bbox_lonlat", "trajectory_lonlat", "start_ns", "end_ns", "created_ns",
    "published_ns", "keyframes", "landmarks", "length_m", "size_bytes", "publishable", "gnss_mode",
    "gnss_residual_rms_m", "reprojection_rms_px", "warnings",
}  # fmt: skip


@pytest.fixture
def history(make_map):
    """Three versions of one map, two maps more; and when each was published."""
    made = {
        "street 1": make_map(map_id="street", part_sizes=(100, 200), seed=1),
        "airport": make_map(map_id="airport", part_sizes=(50,), seed=2),
        "street 2": make_map(map_id="street", part_sizes=(100, 250), seed=1, path_lonlat=((9, 48), (9.1, 48.1))),
        "street 3": make_map(map_id="street", part_sizes=(300,), seed=4, path_lonlat=((10.0, 47.0), (10.1, 47.1))),
        "harbour": make_map(map_id="harbour", part_sizes=(70,), seed=5),
    }  # fmt: skip
    return {name: (one, 1_700_000_000_000_000_000 + at) for at, (name, one) in enumerate(made.items())}


@pytest.fixture
def old_store(tmp_path, history) -> Path:
    """A store as the first server left it: catalogue, and blobs but for one manifest."""
    with contextlib.closing(sqlite3.connect(tmp_path / "catalogue.sqlite", isolation_level=None)) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.executescript(SCHEMA_1)
        for one, published_ns in sorted(history.values(), key=lambda item: item[0].version):
            entry = MapEntry.from_manifest(one.manifest, one.version, len(one.manifest_bytes), published_ns)
            database.execute(
                "INSERT INTO versions VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (
                    one.version, entry.map_id, published_ns, len(one.manifest_bytes), *entry.bbox_lonlat,
                    entry.model_dump_json(include=FIELDS_1),
                ),
            )  # fmt: skip
            rows = [(one.version, sha256, len(data)) for sha256, data in one.parts.items()]
            database.executemany("INSERT INTO parts VALUES (?, ?, ?)", rows)
            for sha256, data in ((one.version, one.manifest_bytes), *one.parts.items()):
                path = tmp_path / "blobs" / sha256[:2] / sha256
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)
    harbour = history["harbour"][0].version
    (tmp_path / "blobs" / harbour[:2] / harbour).unlink()
    return tmp_path


@pytest.fixture
def carried(old_store) -> Iterator[Catalogue]:
    with contextlib.closing(Database(f"sqlite:///{old_store / 'catalogue.sqlite'}")) as database:
        yield Catalogue(database)


def test_all_versions_are_numbered_in_the_order_of_publishing(carried, history):
    street = carried.versions("street")
    assert [(entry.number, entry.version) for entry in street] == [
        (number, history[f"street {number}"][0].version) for number in (1, 2, 3)
    ]
    assert [entry.is_latest for entry in street] == [False, False, True]
    assert [entry.predecessor for entry in street] == [None, street[0].version, street[1].version]
    for name, (one, published_ns) in history.items():
        entry = carried.entry(one.manifest.map_id, one.version)
        known = MapEntry.from_manifest(one.manifest, one.version, len(one.manifest_bytes), published_ns)
        include = FIELDS_1 if name == "harbour" else FIELDS_1 | {"drive", "frames_total"}  # from the manifest
        assert entry.model_dump(include=include) == known.model_dump(include=include)
    told = [entry.version for _, entry in carried.since(0)]
    assert told == [one.version for one, _ in history.values()]


def test_the_latest_versions_are_found_where_they_are(carried):
    def found(*box: float) -> set[str]:
        return {entry.map_id for entry in carried.search(MapSearch(box=box)).entries}

    assert found(-180, -90, 180, 90) == {"street", "airport", "harbour"}
    assert found(10.0, 47.0, 10.2, 47.2) == {"street"}
    assert found(9.0, 48.0, 9.2, 48.2) == set()


def test_parts_are_told_with_what_the_manifest_says_of_them(carried, history):
    for name, (one, _) in history.items():
        for part in carried.parts(one.version):
            assert part.size_bytes == len(one.parts[part.sha256])
            assert (part.kind, part.cell is None) == (("unknown", True) if name == "harbour" else ("cell", False))
        assert {part.sha256 for part in carried.parts(one.version)} == set(one.parts)
        assert carried.blob_size(one.version, one.version) == len(one.manifest_bytes)


def test_every_blob_is_known_as_an_object_under_its_old_name(carried, history):
    with carried.database.reading() as connection:
        rows = connection.execute(sa.text("SELECT key, sha256, size_bytes, state FROM objects")).all()
    known = {}
    for one, _ in history.values():
        known |= {one.version: one.manifest_bytes} | one.parts
    assert len(rows) == len(known)  # a part that two versions share is one object
    assert {tuple(row) for row in rows} == {
        (f"blobs/{sha256[:2]}/{sha256}", sha256, len(data), "live") for sha256, data in known.items()
    }


def test_publishing_goes_on_after_the_upgrade(carried, history, make_map):
    new = make_map(map_id="street", part_sizes=(400,), seed=9)
    with carried.database.writing() as connection:
        entry = carried.add(
            connection, new.manifest, new.version, len(new.manifest_bytes), history["street 3"][0].version
        )
    assert (entry.number, entry.is_latest) == (4, True)
    assert carried.entry("street", 3).successor == new.version


def test_a_server_goes_on_with_an_old_store_and_serves_what_it_had(old_store, history):
    with open_library(ServerSettings(store=str(old_store))) as library:
        for name, (one, _) in history.items():
            for sha256, data in one.parts.items():
                assert library.chunk(one.version, sha256, 0, len(data)) == data
            if name != "harbour":
                assert library.manifest(one.version) == one.manifest
        with pytest.raises(DamagedBlobError, match="is lost; publish its map again"):
            library.manifest(history["harbour"][0].version)


KILLED_UPGRADE = """
import os, signal, sys
from fleetmap_server import migrations
from fleetmap_server.database import Database
migrations._set_schema = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
Database(sys.argv[1])
"""


def test_an_upgrade_that_is_killed_leaves_the_old_catalogue(old_store, history):
    url = f"sqlite:///{old_store / 'catalogue.sqlite'}"
    died = subprocess.run([sys.executable, "-c", KILLED_UPGRADE, url], capture_output=True, timeout=60)
    assert died.returncode == -signal.SIGKILL, died.stderr
    with contextlib.closing(sqlite3.connect(old_store / "catalogue.sqlite")) as old:
        assert old.execute("PRAGMA user_version").fetchone() == (1,)
        assert old.execute("SELECT count(*) FROM versions JOIN parts USING (version)").fetchone() == (7,)
        assert old.execute("SELECT count(*) FROM latest").fetchone() == (3,)
    with contextlib.closing(Database(url)) as database:
        assert Catalogue(database).count() == 3


def test_a_newer_schema_is_refused_and_left_alone(database_url, make_map):
    with contextlib.closing(Database(database_url)) as database, database.writing() as connection:
        if database.dialect == "sqlite":
            connection.execute(sa.text("PRAGMA user_version = 7"))
        else:
            connection.execute(sa.text("UPDATE fleetmap_schema SET version = 7"))
        file = database.file
    before = file.read_bytes() if file else None
    for _ in range(2):
        with pytest.raises(InputError, match=rf"newer fleetmap \(schema 7, this one reads {SCHEMA_VERSION}\)"):
            Database(database_url)
    assert (file.read_bytes() if file else None) == before


def test_two_servers_that_start_at_once_make_one_catalogue(database_url):
    code = "import sys; from fleetmap_server.database import Database; Database(sys.argv[1]).close()"
    starting = [
        subprocess.Popen([sys.executable, "-c", code, database_url], stderr=subprocess.PIPE) for _ in range(2)
    ]
    for process in starting:
        _, told = process.communicate(timeout=60)
        assert process.returncode == 0, told
    with contextlib.closing(Database(database_url)) as database, database.reading() as connection:
        facts = connection.execute(sa.text("SELECT name FROM facts")).scalars().all()
    assert list(facts) == ["catalogue_id"]
