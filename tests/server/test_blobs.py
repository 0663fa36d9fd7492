"""Blobs: whole and verified, or not there; on a folder and S3, on SQLite and PostgreSQL."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from fleetmap.errors import MapPackageError
from fleetmap_server.blobs import Blobs
from fleetmap_server.database import Database
from fleetmap_server.object_store import ObjectStore
from fleetmap_server.problems import DamagedBlobError, NotFoundError

DATA = b"0123456789" * 1000
NAME = hashlib.sha256(DATA).hexdigest()
SIZES = {NAME: len(DATA)}


@pytest.fixture
def database(storage_urls: tuple[str, str]) -> Iterator[Database]:
    with closing(Database(storage_urls[1])) as opened:
        yield opened


@pytest.fixture
def objects(storage_urls: tuple[str, str]) -> ObjectStore:
    return ObjectStore(storage_urls[0])


@pytest.fixture
def blobs(objects: ObjectStore, database: Database) -> Blobs:
    return Blobs(objects, database)


def keys_of(objects: ObjectStore) -> list[str]:
    return [key for prefix in ("blobs", "uploads") for key, _ in objects.keys(prefix)]


def test_a_blob_appears_with_its_last_byte(blobs, objects):
    assert blobs.append(NAME, len(DATA), 0, DATA[:7000]) == 7000
    assert blobs.received(SIZES) == {NAME: 7000}
    with pytest.raises(NotFoundError):
        blobs.read(NAME, 0, 10)
    assert blobs.append(NAME, len(DATA), 7000, DATA[7000:]) == len(DATA)
    assert blobs.received(SIZES) == SIZES
    assert blobs.read(NAME, 5, 10) == DATA[5:15]
    assert blobs.read(NAME, len(DATA) - 3, 10) == DATA[-3:]
    assert b"".join(blobs.stream(NAME, 10)) == DATA[10:]
    assert [key.split(".")[0] for key in keys_of(objects)] == [f"blobs/{NAME[:2]}/{NAME}"]


def test_bytes_that_are_not_the_next_ones_are_left_out(blobs):
    blobs.append(NAME, len(DATA), 0, DATA[:100])
    assert blobs.append(NAME, len(DATA), 200, DATA[200:300]) == 100
    assert blobs.append(NAME, len(DATA), 0, DATA[:100]) == 100
    assert blobs.append(NAME, len(DATA), 100, DATA[100:]) == len(DATA)
    assert blobs.append(NAME, len(DATA), 0, b"anything") == len(DATA)
    assert blobs.read(NAME, 0, len(DATA)) == DATA


def test_another_server_goes_on_where_the_first_stopped(blobs, objects, database):
    blobs.append(NAME, len(DATA), 0, DATA[:4321])
    other = Blobs(objects, database)
    assert other.received(SIZES) == {NAME: 4321}
    assert other.append(NAME, len(DATA), 4321, DATA[4321:5000]) == 5000
    assert blobs.append(NAME, len(DATA), 4321, DATA[4321:5555]) == 5000
    assert blobs.append(NAME, len(DATA), 5000, DATA[5000:]) == len(DATA)
    assert other.read(NAME, 0, len(DATA)) == DATA


def test_wrong_bytes_are_thrown_away(blobs, objects):
    with pytest.raises(MapPackageError, match="other bytes than its name says"):
        blobs.append(NAME, len(DATA), 0, DATA[:-1] + b"?")
    blobs.append(NAME, len(DATA), 0, DATA[:9000])
    with pytest.raises(MapPackageError, match="other bytes than its name says"):
        blobs.append(NAME, len(DATA), 9000, DATA[9000:-1] + b"?")
    assert keys_of(objects) == []
    assert blobs.received(SIZES) == {NAME: 0}


def test_more_bytes_than_announced_are_refused(blobs):
    with pytest.raises(MapPackageError, match="ends at 10000 bytes"):
        blobs.append(NAME, len(DATA), 9999, b"??")


def test_what_is_not_acceptable_does_not_stay(blobs, objects):
    def refuse(content: Iterator[bytes]) -> None:
        raise MapPackageError(f"{len(b''.join(content))} bytes of nonsense")

    for cut in (0, 5000):
        blobs.append(NAME, len(DATA), 0, DATA[:cut])
        with pytest.raises(MapPackageError, match="10000 bytes of nonsense"):
            blobs.append(NAME, len(DATA), cut, DATA[cut:], accept=refuse)
        assert keys_of(objects) == []


def test_what_rotted_is_not_handed_out_and_can_be_sent_again(tmp_path, database):
    objects = ObjectStore(str(tmp_path / "store"))
    blobs = Blobs(objects, database)
    blobs.append(NAME, len(DATA), 0, DATA)
    path = blobs.local_path(NAME)
    assert path is not None
    flip_a_byte(path)
    with pytest.raises(DamagedBlobError, match="publish its map again"):
        blobs.read(NAME, 0, 10)
    assert blobs.received(SIZES) == {NAME: 0}
    blobs.append(NAME, len(DATA), 0, DATA)
    assert blobs.read(NAME, 0, 10) == DATA[:10]


def flip_a_byte(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
