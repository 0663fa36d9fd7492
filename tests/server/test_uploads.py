"""Uploads under way and what they claim."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import pytest
import sqlalchemy as sa
from sqlalchemy.engine import Connection

from fleetmap_server import uploads
from fleetmap_server.database import Database
from fleetmap_server.uploads import UploadUnderWay

NAMES = [f"{number:064x}" for number in range(5000)]


@pytest.fixture
def connection(database_url: str) -> Iterator[Connection]:
    with closing(Database(database_url)) as database, database.writing() as writing:
        yield writing


def claims(connection: Connection) -> list[tuple[str, str]]:
    rows = connection.execute(sa.text("SELECT upload, sha256 FROM claims ORDER BY upload, sha256"))
    return [(upload, sha256) for upload, sha256 in rows]


def test_an_upload_begun_again_keeps_its_claims_and_is_younger(connection):
    uploads.begin(connection, "a", "map", "karlsruhe", 10, now_ns=1)
    uploads.claim(connection, "a", NAMES[:2])
    uploads.begin(connection, "a", "map", "karlsruhe", 20, now_ns=5)
    uploads.claim(connection, "a", NAMES[1:3])
    assert uploads.find(connection, "a") == UploadUnderWay("a", "map", "karlsruhe", 20, 5)
    assert claims(connection) == [("a", name) for name in NAMES[:3]]


def test_thousands_of_blobs_are_claimed_at_once(connection):
    uploads.begin(connection, "a", "map", "karlsruhe", 10, now_ns=1)
    uploads.claim(connection, "a", NAMES)
    assert claims(connection) == [("a", name) for name in NAMES]


def test_an_upload_that_ends_takes_only_its_own_claims_along(connection):
    for upload in ("a", "b"):
        uploads.begin(connection, upload, "drive", upload, 10, now_ns=1)
        uploads.claim(connection, upload, NAMES[:1])
    uploads.end(connection, "a")
    assert claims(connection) == [("b", NAMES[0])]
    assert (uploads.find(connection, "a"), uploads.find(connection, "b") is None) == (None, False)


def test_only_uploads_that_nobody_touched_since_are_abandoned(connection):
    for upload, now_ns in (("old", 1), ("touched", 1), ("young", 9)):
        uploads.begin(connection, upload, "map", upload, 10, now_ns)
        uploads.claim(connection, upload, NAMES[:1])
    assert uploads.touch(connection, "touched", now_ns=8)
    assert uploads.end_abandoned(connection, before_ns=8) == 1
    found = {upload: uploads.find(connection, upload) for upload in ("old", "touched", "young")}
    assert [upload for upload, one in found.items() if one is not None] == ["touched", "young"]
    assert claims(connection) == [("touched", NAMES[0]), ("young", NAMES[0])]
    assert not uploads.touch(connection, "old", now_ns=9)
