"""Blobs on disk: whole and verified, or not there."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from fleetmap.errors import MapPackageError, StorageError
from fleetmap_server.problems import DamagedBlobError, NotFoundError
from fleetmap_server.store import BlobStore

DATA = b"0123456789" * 1000
NAME = hashlib.sha256(DATA).hexdigest()


@pytest.fixture
def store(tmp_path: Path) -> BlobStore:
    return BlobStore(tmp_path)


def flip_a_byte(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def test_a_blob_appears_with_its_last_byte(store, tmp_path):
    assert store.append(NAME, len(DATA), 0, DATA[:7000]) == 7000
    with pytest.raises(NotFoundError):
        store.path(NAME)
    assert store.append(NAME, len(DATA), 7000, DATA[7000:]) == len(DATA)
    assert store.path(NAME) == tmp_path / "blobs" / NAME[:2] / NAME
    assert store.read(NAME, 5, 10) == DATA[5:15]
    assert store.read(NAME, len(DATA) - 3, 10) == DATA[-3:]
    assert list((tmp_path / "uploads").iterdir()) == []


def test_bytes_that_are_not_the_next_ones_are_left_out(store):
    store.append(NAME, len(DATA), 0, DATA[:100])
    assert store.append(NAME, len(DATA), 200, DATA[200:300]) == 100
    assert store.append(NAME, len(DATA), 0, DATA[:100]) == 100
    assert store.append(NAME, len(DATA), 100, DATA[100:]) == len(DATA)
    assert store.append(NAME, len(DATA), 0, b"anything") == len(DATA)
    assert store.read(NAME, 0, len(DATA)) == DATA


def test_another_store_on_the_same_folder_goes_on_where_the_first_stopped(store, tmp_path):
    store.append(NAME, len(DATA), 0, DATA[:4321])
    assert BlobStore(tmp_path).received_bytes(NAME, len(DATA)) == 4321


def test_wrong_bytes_are_thrown_away(store, tmp_path):
    with pytest.raises(MapPackageError, match="other bytes than its name says"):
        store.append(NAME, len(DATA), 0, DATA[:-1] + b"?")
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
    assert store.received_bytes(NAME, len(DATA)) == 0


def test_more_bytes_than_announced_are_refused(store):
    with pytest.raises(MapPackageError, match="ends at 10000 bytes"):
        store.append(NAME, len(DATA), 9999, b"??")


def test_an_upload_cut_before_its_check_is_finished_by_its_last_byte(store, tmp_path):
    (tmp_path / "uploads" / NAME).write_bytes(DATA)
    assert store.received_bytes(NAME, len(DATA)) == len(DATA) - 1
    assert store.append(NAME, len(DATA), len(DATA) - 1, DATA[-1:]) == len(DATA)
    assert store.read(NAME, 0, len(DATA)) == DATA


def test_what_rotted_on_the_disk_is_not_handed_out_and_can_be_sent_again(store):
    store.append(NAME, len(DATA), 0, DATA)
    assert store.read(NAME, 0, 10) == DATA[:10]
    flip_a_byte(store.path(NAME))
    with pytest.raises(DamagedBlobError, match="publish its map again"):
        store.read(NAME, 0, 10)
    assert store.received_bytes(NAME, len(DATA)) == 0
    store.append(NAME, len(DATA), 0, DATA)
    assert store.read(NAME, 0, 10) == DATA[:10]


def test_what_is_not_acceptable_does_not_stay(store, tmp_path):
    def refuse(content: bytes) -> None:
        raise MapPackageError(f"{len(content)} bytes of nonsense")

    with pytest.raises(MapPackageError, match="10000 bytes of nonsense"):
        store.append(NAME, len(DATA), 0, DATA, accept=refuse)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_store_that_is_a_file_is_refused_with_one_line(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(StorageError, match=r"cannot write .*file"):
        BlobStore(tmp_path / "file")
