"""Objects in a folder and in a bucket: there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from fleetmap.errors import InputError, StorageError
from fleetmap_server.object_store import STREAM_BYTES, ObjectExistsError, ObjectMissingError, ObjectStore

LARGE = os.urandom(2 * STREAM_BYTES + 12_345)


@pytest.fixture
def objects(store_url: str) -> ObjectStore:
    store = ObjectStore(store_url)
    store.check()
    return store


def pieces_of(data: bytes, size_bytes: int = 1_000_000) -> Iterator[bytes]:
    return (data[start : start + size_bytes] for start in range(0, len(data), size_bytes))


def test_what_was_put_is_read_back_whole_and_in_part(objects):
    written = objects.put("blobs/ab/one", b"0123456789")
    assert objects.head("blobs/ab/one") == written
    assert written.size_bytes == 10
    assert objects.read("blobs/ab/one", 3, 4) == b"3456"
    assert objects.read("blobs/ab/one", 8, 100) == b"89"
    assert b"".join(objects.stream("blobs/ab/one", 2, 5)) == b"23456"


def test_a_large_object_goes_in_and_out_piece_by_piece(objects):
    written = objects.put_stream("blobs/ab/large", pieces_of(LARGE))
    assert objects.head("blobs/ab/large") == written
    pieces = list(objects.stream("blobs/ab/large"))
    assert b"".join(pieces) == LARGE
    assert max(map(len, pieces)) == STREAM_BYTES
    assert b"".join(objects.stream("blobs/ab/large", STREAM_BYTES - 5)) == LARGE[STREAM_BYTES - 5 :]


def test_an_object_is_never_overwritten(objects):
    objects.put("blobs/ab/one", b"first")
    with pytest.raises(ObjectExistsError):
        objects.put("blobs/ab/one", b"second")
    with pytest.raises(ObjectExistsError):
        objects.put_stream("blobs/ab/one", pieces_of(b"third"))
    assert objects.read("blobs/ab/one", 0, 10) == b"first"


def test_a_stream_that_fails_leaves_nothing(objects, store_url):
    def failing() -> Iterator[bytes]:
        yield from pieces_of(LARGE)
        raise ValueError("the sender went away")

    with pytest.raises(ValueError, match="the sender went away"):
        objects.put_stream("blobs/ab/large", failing())
    assert list(objects.keys("blobs")) == []
    if "://" not in store_url:
        assert [path for path in Path(store_url).rglob("*") if path.is_file()] == []


def test_keys_are_listed_by_whole_segments_of_their_names(objects):
    for key, data in (("uploads/a/1", b"1"), ("uploads/a/2", b"22"), ("uploads/ab/1", b"333")):
        objects.put(key, data)
    assert sorted(objects.keys("uploads/a")) == [("uploads/a/1", 1), ("uploads/a/2", 2)]
    assert len(list(objects.keys("uploads"))) == 3
    assert list(objects.keys("nothing")) == []


def test_deleting_what_is_not_there_is_no_matter(objects):
    objects.put("uploads/a/1", b"1")
    objects.delete(["uploads/none", "uploads/a/1", "uploads/nor/this"])
    assert list(objects.keys("uploads")) == []
    assert objects.head("uploads/a/1") is None


def test_reading_what_is_not_there_says_so(objects, store_url):
    with pytest.raises(ObjectMissingError, match="blobs/ab/none is not there"):
        objects.read("blobs/ab/none", 0, 10)
    with pytest.raises(ObjectMissingError, match="blobs/ab/none is not there"):
        list(objects.stream("blobs/ab/none"))


def test_an_unknown_kind_of_store_is_refused_with_the_known_ones():
    with pytest.raises(InputError, match="ftp://host/store' is no store; give a folder, or s3://"):
        ObjectStore("ftp://host/store")


def test_a_store_that_is_a_file_is_refused_with_one_line(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(StorageError, match=r"cannot write .*file: (File exists|Not a directory)"):
        ObjectStore(str(tmp_path / "file"))


def test_an_absent_bucket_is_told_at_opening(s3_bucket):
    with pytest.raises(StorageError, match=f"s3://{s3_bucket}-not/x.*bucket does not exist"):
        ObjectStore(f"s3://{s3_bucket}-not/x").check()
