"""A copy of a store and its catalogue that holds together, made while servers go on; and the way back.

A backup is a folder or bucket with ``blobs/ab/<sha256>`` and, written last, ``catalogues/<UTC time>.jsonl``: a
header, one line for each row, and a last line that counts them. It knows nothing of databases, so what was saved
from SQLite can be restored into PostgreSQL. Backing up into the same place again copies only what is new.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import IO, Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from fleetmap.errors import InputError, StorageError
from fleetmap_server import uploads
from fleetmap_server.boxes import add_to_index
from fleetmap_server.migrations import SCHEMA_VERSION
from fleetmap_server.object_store import ObjectStore
from fleetmap_server.storage import Storage
from fleetmap_server.verification import Progress, no_progress

_BYTES = frozenset({"outline"})  # columns that JSON cannot hold as they are
_TABLES = ("versions", "parts", "drives", "objects", "jobs")
_FORMAT = "fleetmap-backup"
_CATALOGUES = "catalogues/"
_PIECE_BYTES = 1 << 20
_ROWS_AT_ONCE = 500


@dataclass(frozen=True)
class Backup:
    """What was copied, and what had been there already."""

    name: str
    blobs: int
    size_bytes: int
    copied: int


def back_up(storage: Storage, destination: ObjectStore, progress: Progress = no_progress) -> Backup:
    """Copy everything that is published, as it is at one moment, while servers go on.

    Nothing is collected from the store meanwhile; what is published meanwhile is not in the copy.

    Raises:
        StorageError: something cannot be read or written. Running it again goes on from there.
    """
    with _nothing_is_collected(storage), tempfile.TemporaryFile() as catalogue:
        objects = _save_catalogue(storage, catalogue)
        copied = _copy(storage.objects, destination, objects, progress)
        name = f"{_CATALOGUES}{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}.jsonl"
        destination.put_stream(name, _pieces_of(catalogue))
    return Backup(name, len(objects), sum(row["size_bytes"] for row in objects), copied)


def restore(source: ObjectStore, storage: Storage, progress: Progress = no_progress) -> Backup:
    """Fill an empty store with the latest backup of ``source``; every blob is hashed on its way.

    Raises:
        InputError: the store is not empty, there is no backup, or a newer fleetmap wrote it.
        StorageError: a blob of the backup is missing or damaged, or something cannot be written. The catalogue is
            filled last and at once, so running it again goes on.
    """
    _refuse_used(storage)
    name = max((key for key, _ in source.keys(_CATALOGUES)), default=None)
    if name is None:
        raise InputError(f"{source.shown} holds no backup; 'fleetmap store backup' makes one")
    with tempfile.TemporaryFile() as catalogue:
        for piece in source.stream(name):
            catalogue.write(piece)
        rows = _read_catalogue(catalogue, f"{source.shown}/{name}")
    copied = _copy(source, storage.objects, rows["objects"], progress)
    with storage.database.writing() as connection:
        _fill(connection, storage.database.dialect, rows)
    return Backup(name, len(rows["objects"]), sum(row["size_bytes"] for row in rows["objects"]), copied)


Row = dict[str, Any]


@contextmanager
def _nothing_is_collected(storage: Storage) -> Iterator[None]:
    """A claim on everything, see fleetmap_server.collection, for as long as the block runs."""
    name = f"backup-{uuid.uuid4().hex}"
    with storage.database.writing() as connection:
        uploads.begin(connection, name, "backup", name, 0, time.time_ns())
        uploads.claim(connection, name, [uploads.EVERYTHING])
    try:
        yield
    finally:
        with storage.database.writing() as connection:
            uploads.end(connection, name)


def _save_catalogue(storage: Storage, file: IO[bytes]) -> list[Row]:
    """Write one snapshot of the catalogue; returns the live objects, under the keys they get in a backup."""
    objects, count = [], 0
    _write_line(file, {"format": _FORMAT, "schema": SCHEMA_VERSION, "saved_ns": time.time_ns()})
    with storage.database.reading() as connection:
        for table in _TABLES:
            which = " WHERE state = 'live'" if table == "objects" else ""
            for found in connection.execute(sa.text(f"SELECT * FROM {table}{which}")).mappings():
                row = {name: bytes(value).hex() if name in _BYTES else value for name, value in found.items()}
                if table == "objects":
                    objects.append(row)
                _write_line(file, {"table": table, "row": row})
                count += 1
    _write_line(file, {"rows": count})
    return objects


def _copy(source: ObjectStore, destination: ObjectStore, objects: Sequence[Row], progress: Progress) -> int:
    """Copy the objects that the destination lacks; returns how many."""
    done_bytes, total_bytes, copied = 0, sum(row["size_bytes"] for row in objects), 0
    for row in objects:
        state = destination.head(row["key"])
        if state is None or state.size_bytes != row["size_bytes"]:
            _copy_one(source, destination, row)
            copied += 1
        progress(done_bytes := done_bytes + row["size_bytes"], total_bytes)
    return copied


def _copy_one(source: ObjectStore, destination: ObjectStore, row: Row) -> None:
    """Copy a blob; what arrives with another hash than its name's is taken away again."""
    digest = hashlib.sha256()

    def pieces() -> Iterator[bytes]:
        for piece in source.stream(row["key"]):
            digest.update(piece)
            yield piece

    destination.delete([row["key"]])  # one of another size is no copy
    destination.put_stream(row["key"], pieces())
    if digest.hexdigest() != row["sha256"]:
        destination.delete([row["key"]])
        raise StorageError(
            f"blob {row['sha256'][:12]} in {source.shown} is damaged; 'fleetmap store verify' lists all that are"
        )


def _read_catalogue(file: IO[bytes], origin: str) -> dict[str, list[Row]]:
    rows: dict[str, list[Row]] = {table: [] for table in _TABLES}
    file.seek(0)
    try:
        header, *lines = map(json.loads, file)
        if header["format"] != _FORMAT:
            raise InputError(f"{origin} is no backup of a map server")
        if header["schema"] > SCHEMA_VERSION:
            raise InputError(f"{origin} was saved by a newer fleetmap; upgrade this one")
        for line in lines[:-1]:
            row = {name: bytes.fromhex(value) if name in _BYTES else value for name, value in line["row"].items()}
            rows[line["table"]].append(row)
        is_whole = lines[-1]["rows"] == len(lines) - 1
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(f"{origin} is no backup of a map server, or it is damaged: {error}") from error
    if not is_whole:
        raise InputError(f"{origin} is not whole; take another backup")
    return rows


def _refuse_used(storage: Storage) -> None:
    with storage.database.reading() as connection:
        for table in ("versions", "drives"):
            if connection.execute(sa.text(f"SELECT 1 FROM {table} LIMIT 1")).first() is not None:
                raise InputError(
                    f"{storage.database.shown} holds maps or drives already; restore into an empty store and "
                    "an empty catalogue"
                )


def _fill(connection: Connection, dialect: str, rows: dict[str, list[Row]]) -> None:
    """All tables, indices of places included; jobs under way wait for a worker again."""
    for row in rows["jobs"]:
        if row["state"] == "running":
            row.update(state="queued", worker="", lease_until_ns=0)
    connection.execute(sa.text("DELETE FROM objects"))
    for table in _TABLES:
        _insert(connection, table, rows[table])
    for table, boxes, is_indexed in (
        ("versions", "map_boxes", lambda row: row["is_latest"]),
        ("drives", "drive_boxes", lambda row: row["west"] is not None),
    ):
        for row in filter(is_indexed, rows[table]):
            box = (row["west"], row["south"], row["east"], row["north"])
            add_to_index(connection, boxes, row["serial"], box)
        if dialect == "postgresql" and rows[table]:
            connection.execute(
                sa.text(f"SELECT setval(pg_get_serial_sequence('{table}', 'serial'), max(serial)) FROM {table}")
            )


def _insert(connection: Connection, table: str, rows: Sequence[Row]) -> None:
    if not rows:
        return
    columns = list(rows[0])
    statement = sa.text(
        f"INSERT INTO {table} ({', '.join(columns)}) VALUES ({', '.join(f':{name}' for name in columns)})"
    )
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        connection.execute(statement, list(rows[start : start + _ROWS_AT_ONCE]))


def _write_line(file: IO[bytes], document: dict[str, Any]) -> None:
    file.write(json.dumps(document, separators=(",", ":")).encode() + b"\n")


def _pieces_of(file: IO[bytes]) -> Iterator[bytes]:
    file.seek(0)
    while piece := file.read(_PIECE_BYTES):
        yield piece
