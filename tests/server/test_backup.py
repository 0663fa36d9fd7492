"""Backups hold together, go from one kind of store and catalogue to another, and damage is found."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from fleetmap.errors import InputError, StorageError
from fleetmap.transport.protocol import BeginRequest, CommitRequest, DriveBeginRequest, DriveCommitRequest
from fleetmap_server.backup import back_up, restore
from fleetmap_server.collection import collect
from fleetmap_server.drive_search import DriveSearch
from fleetmap_server.library import open_library
from fleetmap_server.object_store import ObjectStore
from fleetmap_server.search import MapSearch
from fleetmap_server.settings import ServerSettings
from fleetmap_server.verification import verify


def publish(library, one):
    for sha256, data in ((one.version, one.manifest_bytes), *one.parts.items()):
        library.receive(one.version, sha256, len(data), 0, data)
    status = library.begin(BeginRequest(version=one.version, size_bytes=len(one.manifest_bytes)))
    return library.commit(CommitRequest(version=one.version, predecessor=status.latest))


@pytest.fixture
def filled(tmp_path, make_map, survey):
    """Two maps, one of them with a history, a drive with its job, and an upload under way."""
    recording = Path(survey.recording).read_bytes()
    with open_library(ServerSettings(tmp_path / "filled")) as library:
        for seed in range(3):
            publish(library, make_map(map_id="karlsruhe", part_sizes=(300_000, 500), seed=seed))
        publish(library, make_map(map_id="fiji", part_sizes=(1000,), seed=7))
        library.rollback("karlsruhe", 1)
        library.retire("karlsruhe", 2)
        sha256 = send_drive(library, recording)
        library.reception.commit(DriveCommitRequest(sha256=sha256, map_id="street"))
        library.jobs.take("worker")
        half = make_map(map_id="half", part_sizes=(2000,), seed=9)
        library.receive(half.version, half.version, len(half.manifest_bytes), 0, half.manifest_bytes)
        yield library


def send_drive(library, recording: bytes) -> str:
    sha256 = hashlib.sha256(recording).hexdigest()
    library.reception.begin(DriveBeginRequest(sha256=sha256, name="survey.mcap", size_bytes=len(recording)))
    assert library.reception.receive(sha256, len(recording), 0, recording) == len(recording)
    return sha256


def listing(library):
    return [
        (entry.map_id, entry.number, entry.version, entry.origin, entry.published_ns)
        for found in library.search(MapSearch()).entries
        for entry in library.versions(found.map_id)
    ]


def blobs_of(library, version) -> list[bytes]:
    return [library.blobs.read(part.sha256, 0, 1 << 30) for part in library.catalogue.parts(version)]


def test_what_is_restored_is_what_was_saved_whatever_it_is_restored_into(
    filled, tmp_path, store_url, database_url
):
    saved = back_up(filled.storage, ObjectStore(str(tmp_path / "saved")))
    with open_library(ServerSettings(store_url, catalogue=database_url)) as restored:
        again = restore(ObjectStore(str(tmp_path / "saved")), restored.storage)
        assert (again.blobs, again.size_bytes) == (saved.blobs, saved.size_bytes)
        assert listing(restored) == listing(filled)
        for entry in restored.search(MapSearch()).entries:
            assert blobs_of(restored, entry.version) == blobs_of(filled, entry.version)
        assert [entry.map_id for entry in restored.search(MapSearch(box=(8.3, 48.9, 8.5, 49.1))).entries]
        (drive,) = restored.drives.search(DriveSearch()).entries
        assert restored.chunk(None, drive.sha256, 0, 8) == b"\x89MCAP0\r\n"
        assert [job.state for job in restored.jobs.page().jobs] == ["queued"]  # its worker is elsewhere
        assert verify(restored.storage).problems == ()
        latest = restored.entry("fiji")
        assert restored.rollback("karlsruhe", 3).number == 5  # numbers and serials go on
        assert restored.entry("fiji") == latest


def test_backing_up_again_copies_only_what_is_new(filled, tmp_path, make_map):
    destination = ObjectStore(str(tmp_path / "saved"))
    first = back_up(filled.storage, destination)
    assert (first.copied, back_up(filled.storage, destination).copied) == (first.blobs, 0)
    publish(filled, make_map(map_id="new", part_sizes=(100, 200), seed=20))
    assert back_up(filled.storage, destination).copied == 3


def test_nothing_is_collected_while_a_backup_is_under_way(filled, tmp_path):
    filled.retire("karlsruhe")
    during = []

    def collect_meanwhile(done_bytes: int, total_bytes: int) -> None:
        during.append(collect(filled.storage.database, filled.storage.objects).objects)

    saved = back_up(filled.storage, ObjectStore(str(tmp_path / "saved")), collect_meanwhile)
    assert len(during) == saved.blobs
    assert sum(during) == 0
    assert collect(filled.storage.database, filled.storage.objects).objects > 0


def test_a_backup_that_was_cut_is_refused_or_goes_on(filled, tmp_path):
    destination = tmp_path / "saved"
    back_up(filled.storage, ObjectStore(str(destination)))
    (catalogue,) = (destination / "catalogues").iterdir()
    whole = catalogue.read_bytes()
    empty = ServerSettings(tmp_path / "restored")

    lines = whole.splitlines(keepends=True)
    catalogue.write_bytes(b"".join(lines[:-3]) + lines[-1])
    with open_library(empty) as library, pytest.raises(InputError, match="is not whole"):
        restore(ObjectStore(str(destination)), library.storage)

    header = json.loads(lines[0])
    catalogue.write_bytes(json.dumps(header | {"schema": 99}).encode() + b"\n" + b"".join(lines[1:]))
    with open_library(empty) as library, pytest.raises(InputError, match="newer fleetmap"):
        restore(ObjectStore(str(destination)), library.storage)

    catalogue.write_bytes(whole)
    blob = max((destination / "blobs").glob("*/*"), key=lambda path: path.stat().st_size)
    good = blob.read_bytes()
    blob.write_bytes(good[:-1] + bytes([good[-1] ^ 1]))
    with open_library(empty) as library, pytest.raises(StorageError, match=r"blob [0-9a-f]{12} in .* is damaged"):
        restore(ObjectStore(str(destination)), library.storage)
    with open_library(empty) as library:
        assert library.count() == 0  # nothing half-done
        blob.write_bytes(good)
        restore(ObjectStore(str(destination)), library.storage)
        assert listing(library) == listing(filled)


def test_a_store_in_use_is_not_restored_into(filled, tmp_path):
    back_up(filled.storage, ObjectStore(str(tmp_path / "saved")))
    with pytest.raises(InputError, match="holds maps or drives already"):
        restore(ObjectStore(str(tmp_path / "saved")), filled.storage)
    (tmp_path / "nothing").mkdir()
    with open_library(ServerSettings(tmp_path / "fresh")) as library, pytest.raises(InputError, match="no backup"):
        restore(ObjectStore(str(tmp_path / "nothing")), library.storage)


def test_every_kind_of_damage_is_found(filled, tmp_path):
    sound = verify(filled.storage)
    assert sound.problems == ()
    assert sound.blobs == len(list((tmp_path / "filled" / "blobs").glob("*/*")))
    largest = max((tmp_path / "filled" / "blobs").glob("*/*"), key=lambda path: path.stat().st_size)
    data = largest.read_bytes()
    for harm, told in (
        (lambda: largest.write_bytes(data[:-1] + bytes([data[-1] ^ 1])), "is damaged"),
        (lambda: largest.write_bytes(data[:-1]), f"has {len(data) - 1} bytes instead of {len(data)}"),
        (lambda: largest.unlink(), "is missing in the store"),
    ):
        harm()
        problems = verify(filled.storage).problems
        assert len(problems) >= 1
        assert told in problems[0]
    largest.write_bytes(data)
    assert verify(filled.storage).problems == ()
