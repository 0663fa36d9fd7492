"""The table ``objects``: which key of the object store holds which blob, and how far it is.

A row comes before its object, and an object goes before its row. A key is used for one row only, ever, so whatever
comes late to a key that is gone (a slow writer, a second collector) cannot touch the blob that was sent again.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import sqlalchemy as sa
from sqlalchemy.engine import Connection

EVERYTHING = "*"
"""Claimed instead of a SHA-256, it keeps all there is: a backup does so."""

BLOBS, PIECES = "blobs", "uploads"  # what keys begin with

ObjectPhase = Literal["receiving", "live", "doomed"]

REFERENCED = """(
    EXISTS (SELECT 1 FROM versions WHERE version = {sha256} AND retired_ns IS NULL)
    OR EXISTS (
        SELECT 1 FROM parts JOIN versions ON versions.version = parts.version
        WHERE parts.sha256 = {sha256} AND retired_ns IS NULL
    )
    OR EXISTS (SELECT 1 FROM drives WHERE drives.sha256 = {sha256} AND retired_ns IS NULL)
)"""
"""Whether something that is published needs a blob, whose SHA-256 is put in."""

_UNREFERENCED = (
    "state IN ('live', 'receiving') "
    f"AND NOT EXISTS (SELECT 1 FROM claims WHERE claims.sha256 IN (objects.sha256, '{EVERYTHING}')) "
    f"AND NOT {REFERENCED.format(sha256='objects.sha256')}"
)

_LISTED = {
    "sqlite": "(SELECT value FROM json_each(:{name}))",
    "postgresql": "(SELECT json_array_elements_text(CAST(:{name} AS json)))",
}


@dataclass(frozen=True)
class ObjectRow:
    """One key of the object store."""

    key: str
    sha256: str
    size_bytes: int
    state: ObjectPhase

    @property
    def pieces(self) -> str:
        """Below this lies what was received so far."""
        return pieces_of(self.key)


def new_key(sha256: str) -> str:
    """A key for a blob that nobody used before."""
    return f"{BLOBS}/{sha256[:2]}/{sha256}.{secrets.token_hex(8)}"


def pieces_of(key: str) -> str:
    """The prefix of a key's pieces."""
    return f"{PIECES}/{key.rpartition('/')[2]}"


def key_of_piece(piece: str) -> str:
    """The key that a piece is received for."""
    name = piece.split("/")[1]
    return f"{BLOBS}/{name[:2]}/{name}"


def listed(connection: Connection, name: str) -> str:
    """A subquery of the texts in the JSON array bound to ``name``; bind it by ``as_list``."""
    return _LISTED[connection.dialect.name].format(name=name)


def as_list(texts: Iterable[str]) -> str:
    """Texts to bind where ``listed`` stands: any number of them, in one statement."""
    return json.dumps(list(texts))


def rows_of_blobs(connection: Connection, sha256s: Iterable[str]) -> dict[str, ObjectRow]:
    """What counts for some blobs: where one is live that, otherwise the one being received."""
    found = connection.execute(
        sa.text(
            "SELECT key, sha256, size_bytes, state FROM objects WHERE state IN ('live', 'receiving') "
            f"AND sha256 IN {listed(connection, 'sha256s')}"
        ),
        {"sha256s": as_list(sha256s)},
    )
    rows = sorted((ObjectRow(*row) for row in found), key=lambda row: row.state == "live")
    return {row.sha256: row for row in rows}


def row_of_key(connection: Connection, key: str) -> ObjectRow | None:
    """What is known of a key."""
    found = connection.execute(
        sa.text("SELECT key, sha256, size_bytes, state FROM objects WHERE key = :key"), {"key": key}
    ).one_or_none()
    return None if found is None else ObjectRow(*found)


def expect(connection: Connection, sizes: Mapping[str, int], now_ns: int) -> dict[str, ObjectRow]:
    """Give every blob that is not live a key to be received under; what counts for all of them.

    One that is being received with another size was announced wrongly and is given up.
    """
    rows = rows_of_blobs(connection, sizes)
    wrong = [row for row in rows.values() if row.state == "receiving" and row.size_bytes != sizes[row.sha256]]
    doom(connection, (row.key for row in wrong), now_ns)
    fresh = [
        ObjectRow(new_key(sha256), sha256, sizes[sha256], "receiving")
        for sha256 in [*(sizes.keys() - rows.keys()), *(row.sha256 for row in wrong)]
    ]
    _insert(connection, fresh, now_ns)
    return rows | {row.sha256: row for row in fresh}


def make_live(connection: Connection, key: str, now_ns: int) -> bool:
    """A blob has arrived; False if its key is not being received any more."""
    return _move(connection, (key,), "live", ("receiving",), now_ns) == 1


def doom(connection: Connection, keys: Iterable[str], now_ns: int) -> int:
    """Have keys deleted, whatever they hold; returns how many were not doomed yet."""
    return _move(connection, keys, "doomed", ("receiving", "live"), now_ns)


def doom_received(connection: Connection, key: str, now_ns: int) -> bool:
    """Give up a key that is being received; False if it is something else by now."""
    return _move(connection, (key,), "doomed", ("receiving",), now_ns) == 1


def is_referenced(connection: Connection, sha256: str) -> bool:
    """Whether a version or drive that is not retired needs a blob."""
    found = connection.execute(sa.text(f"SELECT {REFERENCED.format(sha256=':sha256')}"), {"sha256": sha256})
    return bool(found.scalar_one())


def unreferenced_after(connection: Connection, key: str, limit: int) -> list[str]:
    """Keys in order, behind ``key``, of what is neither published nor claimed by an upload."""
    found = connection.execute(
        sa.text(f"SELECT key FROM objects WHERE key > :key AND {_UNREFERENCED} ORDER BY key LIMIT :limit"),
        {"key": key, "limit": limit},
    )
    return [str(found_key) for found_key in found.scalars()]


def doom_unreferenced(connection: Connection, keys: Iterable[str], now_ns: int) -> None:
    """Doom those of some keys that are still neither published nor claimed."""
    connection.execute(
        sa.text(
            "UPDATE objects SET state = 'doomed', touched_ns = :now_ns "
            f"WHERE key IN {listed(connection, 'keys')} AND {_UNREFERENCED}"
        ),
        {"keys": as_list(keys), "now_ns": now_ns},
    )


def keys_in(connection: Connection, keys: Iterable[str], states: tuple[ObjectPhase, ...]) -> set[str]:
    """Those of some keys that are in one of some states."""
    found = connection.execute(
        sa.text(
            f"SELECT key FROM objects WHERE state IN ({_quoted(states)}) AND key IN {listed(connection, 'keys')}"
        ),
        {"keys": as_list(set(keys))},
    )
    return {str(key) for key in found.scalars()}


def forget(connection: Connection, keys: Iterable[str]) -> None:
    """Drop the rows of doomed keys, whose objects are deleted."""
    connection.execute(
        sa.text(f"DELETE FROM objects WHERE state = 'doomed' AND key IN {listed(connection, 'keys')}"),
        {"keys": as_list(keys)},
    )


def _move(
    connection: Connection,
    keys: Iterable[str],
    to: ObjectPhase,
    origins: tuple[ObjectPhase, ...],
    now_ns: int,
) -> int:
    moved = connection.execute(
        sa.text(
            f"UPDATE objects SET state = '{to}', touched_ns = :now_ns "
            f"WHERE state IN ({_quoted(origins)}) AND key IN {listed(connection, 'keys')}"
        ),
        {"keys": as_list(keys), "now_ns": now_ns},
    )
    return moved.rowcount


def _quoted(states: tuple[ObjectPhase, ...]) -> str:
    return ", ".join(f"'{state}'" for state in states)


def _insert(connection: Connection, rows: list[ObjectRow], now_ns: int) -> None:
    """One statement for many rows: while it runs nobody else writes."""
    fields = {
        "sqlite": "SELECT value ->> 0, value ->> 1, value ->> 2 FROM json_each(:rows)",
        "postgresql": "SELECT value ->> 0, value ->> 1, CAST(value ->> 2 AS BIGINT) "
        "FROM json_array_elements(CAST(:rows AS json)) AS value",
    }[connection.dialect.name]
    connection.execute(
        sa.text(
            "INSERT INTO objects (key, sha256, size_bytes, state, touched_ns) "
            f"SELECT entry.*, 'receiving', :now_ns FROM ({fields}) AS entry"
        ),
        {"rows": json.dumps([(row.key, row.sha256, row.size_bytes) for row in rows]), "now_ns": now_ns},
    )
