"""Deleting what nothing counts on any more, while servers go on serving and receiving.

A blob is kept while a version or drive that is not retired names it, or an upload under way claims it. In between:
first the rows of all others are doomed, each judged again in the transaction that dooms it; then their objects are
deleted; then their rows. A claim that comes before finds the blob kept, one that comes after finds it missing and
has it sent again, under another key. So a collection may stop anywhere, and several may run at once.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from fleetmap_server import object_rows, uploads
from fleetmap_server.database import Database
from fleetmap_server.object_rows import BLOBS, PIECES, ObjectPhase
from fleetmap_server.object_store import ObjectStore
from fleetmap_server.pairing import check_pairing

ABANDONED_AFTER_S = 7 * 86_400.0

_SLICE = 1000  # objects in one transaction
_DRAFT_AGE_S = 86_400.0


@dataclass(frozen=True)
class Collected:
    """What was deleted from the object store."""

    objects: int = 0
    bytes: int = 0

    def __add__(self, other: Collected) -> Collected:
        return Collected(self.objects + other.objects, self.bytes + other.bytes)


def collect(
    database: Database,
    objects: ObjectStore,
    *,
    abandoned_after_s: float = ABANDONED_AFTER_S,
    now_ns: int | None = None,
) -> Collected:
    """Give up abandoned uploads, and delete every object that nothing counts on.

    Args:
        database: of the catalogue.
        objects: the store that belongs to it.
        abandoned_after_s: an upload is given up when nobody touched it for so long.
        now_ns: UTC since the epoch; None for the present.

    Raises:
        InputError: the store belongs to another catalogue.
        StorageError: store or database fail; what was deleted stays deleted, the rest is for the next time.
    """
    now_ns = time.time_ns() if now_ns is None else now_ns
    check_pairing(objects, database)
    with database.writing() as connection:
        uploads.end_abandoned(connection, now_ns - round(abandoned_after_s * 1e9))
    doom_unreferenced(database, now_ns)
    doomed = doomed_keys(database)
    collected = delete_unwanted(database, objects)
    forget_deleted(database, doomed)
    objects.delete_drafts(_DRAFT_AGE_S)
    return collected


def retain(connection: Connection, keep_versions: int, now_ns: int) -> int:
    """Retire all but the newest versions of each map; the latest always stays. Returns how many were retired."""
    retired = connection.execute(
        sa.text(
            "UPDATE versions SET retired_ns = :now_ns WHERE is_latest = 0 AND serial IN (SELECT serial FROM ("
            "SELECT serial, row_number() OVER (PARTITION BY map_id ORDER BY number DESC) AS place "
            "FROM versions WHERE retired_ns IS NULL) AS ranked WHERE place > :keep_versions)"
        ),
        {"now_ns": now_ns, "keep_versions": keep_versions},
    )
    return retired.rowcount


def doom_unreferenced(database: Database, now_ns: int) -> None:
    """Mark every object that nothing counts on as one to be deleted."""
    after = ""
    while True:
        with database.reading() as connection:
            candidates = object_rows.unreferenced_after(connection, after, _SLICE)
        if not candidates:
            return
        with database.writing() as connection:
            object_rows.doom_unreferenced(connection, candidates, now_ns)
        after = candidates[-1]


def doomed_keys(database: Database) -> list[str]:
    """The keys that are to be deleted."""
    with database.reading() as connection:
        found = connection.execute(sa.text("SELECT key FROM objects WHERE state = 'doomed'"))
        return [str(key) for key in found.scalars()]


def delete_unwanted(database: Database, objects: ObjectStore) -> Collected:
    """Delete the objects of doomed rows and of no row at all, and the pieces of what is not being received.

    Rows come before their objects: an object that was seen, and has no row afterwards, will never get one.
    """
    collected = Collected()
    for found in _slices(objects.keys(BLOBS)):
        kept = _keys_in(database, (key for key, _ in found), ("receiving", "live"))
        collected += _delete(objects, [(key, size_bytes) for key, size_bytes in found if key not in kept])
    for found in _slices(objects.keys(PIECES)):
        owners = {piece: object_rows.key_of_piece(piece) for piece, _ in found}
        kept = _keys_in(database, owners.values(), ("receiving",))
        collected += _delete(objects, [(piece, size) for piece, size in found if owners[piece] not in kept])
    return collected


def forget_deleted(database: Database, keys: list[str]) -> None:
    """Drop the rows of doomed keys whose objects are deleted."""
    for start in range(0, len(keys), _SLICE):
        with database.writing() as connection:
            object_rows.forget(connection, keys[start : start + _SLICE])


def _slices(found: Iterator[tuple[str, int]]) -> Iterator[list[tuple[str, int]]]:
    while some := list(islice(found, _SLICE)):
        yield some


def _keys_in(database: Database, keys: Iterable[str], states: tuple[ObjectPhase, ...]) -> set[str]:
    with database.reading() as connection:
        return object_rows.keys_in(connection, keys, states)


def _delete(objects: ObjectStore, found: list[tuple[str, int]]) -> Collected:
    objects.delete(key for key, _ in found)
    return Collected(len(found), sum(size_bytes for _, size_bytes in found))
