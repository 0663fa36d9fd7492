"""What nothing counts on is deleted, and nothing else."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import closing

import pytest
from sqlalchemy.engine import Connection

from fleetmap.errors import InputError, StorageError
from fleetmap_server import uploads
from fleetmap_server.blobs import Blobs
from fleetmap_server.catalogue import Catalogue
from fleetmap_server.collection import Collected, collect, retain
from fleetmap_server.database import Database
from fleetmap_server.object_store import ObjectStore
from fleetmap_server.problems import DamagedBlobError, NotFoundError

DAY_NS = 86_400 * 1_000_000_000
NOW_NS = 1_800_000_000_000_000_000


@pytest.fixture
def database(storage_urls: tuple[str, str]) -> Iterator[Database]:
    with closing(Database(storage_urls[1])) as opened:
        yield opened


@pytest.fixture
def objects(storage_urls: tuple[str, str]) -> ObjectStore:
    return ObjectStore(storage_urls[0])


@pytest.fixture
def blobs(objects: ObjectStore, database: Database) -> Blobs:
    return Blobs(objects, database, clock)


@pytest.fixture
def catalogue(database: Database) -> Catalogue:
    return Catalogue(database, clock)


def clock() -> int:
    return NOW_NS


def publish(made, blobs: Blobs, catalogue: Catalogue, predecessor: str | None = None) -> dict[str, int]:
    """Sizes of all blobs of a map that is published now."""
    contents = {made.version: made.manifest_bytes, **made.parts}
    for sha256, data in contents.items():
        blobs.append(sha256, len(data), 0, data)
    with catalogue.database.writing() as connection:
        catalogue.add(connection, made.manifest, made.version, len(made.manifest_bytes), predecessor)
    return {sha256: len(data) for sha256, data in contents.items()}


def missing(database: Database, blobs: Blobs, sizes: dict[str, int]) -> list[str]:
    with database.reading() as connection:
        return blobs.missing(connection, sizes)


def keys_of(objects: ObjectStore) -> list[str]:
    return [key for prefix in ("blobs", "uploads") for key, _ in objects.keys(prefix)]


def store_blob(blobs: Blobs, data: bytes) -> str:
    sha256 = hashlib.sha256(data).hexdigest()
    blobs.append(sha256, len(data), 0, data)
    return sha256


def claim(connection: Connection, upload: str, sha256: str, now_ns: int = NOW_NS) -> None:
    uploads.begin(connection, upload, "map", upload, 10, now_ns)
    uploads.claim(connection, upload, [sha256])


def test_what_is_published_stays_and_what_is_retired_goes(make_map, database, objects, blobs, catalogue):
    old, new = (make_map(part_sizes=(300, 200 + seed)) for seed in (0, 1))  # part 0 is the same
    publish(old, blobs, catalogue)
    sizes = publish(new, blobs, catalogue, predecessor=old.version)
    assert collect(database, objects, now_ns=NOW_NS) == Collected()
    with database.writing() as connection:
        assert retain(connection, 1, NOW_NS) == 1
    gone = [old.manifest_bytes, next(data for data in old.parts.values() if len(data) == 200)]
    assert collect(database, objects, now_ns=NOW_NS) == Collected(2, sum(map(len, gone)))
    assert missing(database, blobs, sizes) == []
    assert len(keys_of(objects)) == 3
    for data in gone:
        with pytest.raises(NotFoundError):
            blobs.read(hashlib.sha256(data).hexdigest(), 0, 10)


def test_retaining_two_versions_retires_the_rest_but_never_the_latest(make_map, database, blobs, catalogue):
    made = [make_map(part_sizes=(10 + seed,)) for seed in range(4)]
    for before, now in zip([None, *made], made, strict=False):
        publish(now, blobs, catalogue, predecessor=before.version if before else None)
    other = make_map(map_id="other", part_sizes=(5,))
    publish(other, blobs, catalogue)
    with database.writing() as connection:
        assert retain(connection, 2, NOW_NS) == 2
        assert retain(connection, 2, NOW_NS) == 0
        assert retain(connection, 0, NOW_NS) == 1
    assert [entry.number for entry in catalogue.versions(made[0].manifest.map_id)] == [4]
    assert [entry.number for entry in catalogue.versions("other")] == [1]


def test_what_an_upload_claims_stays_until_it_ends(database, objects, blobs):
    whole = store_blob(blobs, b"claimed and whole")
    begun = b"claimed and begun"
    begun_name = hashlib.sha256(begun).hexdigest()
    blobs.append(begun_name, len(begun), 0, begun[:5])
    with database.writing() as connection:
        claim(connection, "a", whole)
        claim(connection, "b", begun_name)
    store_blob(blobs, b"nobody's")
    assert collect(database, objects, now_ns=NOW_NS) == Collected(1, len(b"nobody's"))
    assert blobs.received({begun_name: len(begun)}) == {begun_name: 5}
    assert blobs.read(whole, 0, 100) == b"claimed and whole"
    with database.writing() as connection:
        uploads.end(connection, "a")
        uploads.end(connection, "b")
    assert collect(database, objects, now_ns=NOW_NS).objects == 2
    assert keys_of(objects) == []


def test_an_upload_that_nobody_touched_for_a_week_is_given_up(database, objects, blobs):
    name = store_blob(blobs, b"claimed")
    with database.writing() as connection:
        claim(connection, "a", name)
    assert collect(database, objects, now_ns=NOW_NS + 6 * DAY_NS) == Collected()
    assert collect(database, objects, now_ns=NOW_NS + 8 * DAY_NS) == Collected(1, 7)
    with database.reading() as connection:
        assert uploads.find(connection, "a") is None


def test_a_claim_on_everything_keeps_everything(database, objects, blobs):
    store_blob(blobs, b"nobody's")
    with database.writing() as connection:
        claim(connection, "backup", uploads.EVERYTHING)
    assert collect(database, objects, now_ns=NOW_NS) == Collected()
    with database.writing() as connection:
        uploads.end(connection, "backup")
    assert collect(database, objects, now_ns=NOW_NS).objects == 1


def test_what_the_catalogue_does_not_know_is_deleted(database, objects, blobs):
    name = store_blob(blobs, b"1234567")
    with database.writing() as connection:
        claim(connection, "a", name)
    for key in ("blobs/ab/abcd.0123", "uploads/abcd.0123/0000000000000000", f"uploads/{'f' * 64}"):
        objects.put(key, b"left over")
    assert collect(database, objects, now_ns=NOW_NS) == Collected(3, 27)
    assert [key.split(".")[0] for key in keys_of(objects)] == [f"blobs/{name[:2]}/{name}"]


def test_more_objects_than_one_transaction_takes_are_all_collected(database, tmp_path):
    objects = ObjectStore(str(tmp_path / "store"))
    blobs = Blobs(objects, database, clock)
    kept = store_blob(blobs, b"kept")
    with database.writing() as connection:
        claim(connection, "a", kept)
        blobs.expect(connection, {f"{number:064x}": 5 for number in range(2500)})
    for number in range(0, 2500, 100):
        blobs.append(f"{number:064x}", 5, 0, b"abc")
    assert collect(database, objects, now_ns=NOW_NS) == Collected(25, 75)
    with database.reading() as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM objects").scalar_one() == 1
    assert blobs.read(kept, 0, 10) == b"kept"


def test_a_collected_blob_sent_again_is_another_object(database, objects, blobs):
    name = store_blob(blobs, b"comes again")
    first = keys_of(objects)
    collect(database, objects, now_ns=NOW_NS)
    assert store_blob(blobs, b"comes again") == name
    assert keys_of(objects) != first
    objects.delete(first)  # of a collector that was slow
    assert blobs.read(name, 0, 100) == b"comes again"


def test_the_store_of_another_catalogue_is_neither_opened_nor_collected(
    make_map, objects, blobs, catalogue, tmp_path
):
    publish(make_map(part_sizes=(100,)), blobs, catalogue)
    with closing(Database(f"sqlite:///{tmp_path / 'another.sqlite'}")) as another:
        for use in (lambda: Blobs(objects, another), lambda: collect(another, objects, now_ns=NOW_NS)):
            with pytest.raises(InputError, match="is the store of another catalogue than"):
                use()
    assert len(keys_of(objects)) == 2


def test_an_empty_store_is_not_taken_for_one_that_lost_everything(make_map, database, blobs, catalogue, tmp_path):
    publish(make_map(part_sizes=(100,)), blobs, catalogue)
    with pytest.raises(InputError, match="has nothing of what the catalogue"):
        Blobs(ObjectStore(str(tmp_path / "empty")), database)


def test_what_is_out_of_reach_is_not_taken_for_lost(make_map, database, objects, blobs, catalogue):
    made = make_map(part_sizes=(100,))
    sizes = publish(made, blobs, catalogue)
    keys = [*keys_of(objects), "catalogue-id"]
    objects.delete(keys)  # as if the disk was not mounted
    with pytest.raises(StorageError, match="is it mounted"):
        blobs.read(made.version, 0, 10)
    assert missing(database, blobs, sizes) == []


def test_what_is_lost_is_told_and_sent_again(make_map, database, objects, blobs, catalogue):
    made = make_map(part_sizes=(100,))
    sizes = publish(made, blobs, catalogue)
    objects.delete(key for key in keys_of(objects) if made.version in key)
    for _ in range(2):
        with pytest.raises(DamagedBlobError, match="is lost; publish its map again"):
            blobs.read(made.version, 0, 10)
        collect(database, objects, now_ns=NOW_NS)
    assert missing(database, blobs, sizes) == [made.version]
    store_blob(blobs, made.manifest_bytes)
    assert blobs.read(made.version, 0, 10) == made.manifest_bytes[:10]
