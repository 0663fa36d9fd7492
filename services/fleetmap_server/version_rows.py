"""Rows of ``versions`` as entries: what the manifest said is kept as JSON, its place in the history looked up."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from fleetmap.catalogue import MapEntry

# Of the neighbours only those count that are not retired.
_NEIGHBOUR = """(
    SELECT o.number || ':' || o.version FROM versions o
    WHERE o.map_id = v.map_id AND o.number {side} v.number AND o.retired_ns IS NULL
    ORDER BY o.number {order} LIMIT 1
)"""
_ENTRIES = f"""
SELECT v.serial, v.entry, v.number, v.origin, v.is_latest, v.retired_ns,
    {_NEIGHBOUR.format(side="<", order="DESC")} AS before,
    {_NEIGHBOUR.format(side=">", order="ASC")} AS behind
FROM versions v
"""


def entries_where(connection: Connection, where: str, **values: object) -> list[tuple[int, MapEntry]]:
    """Serials and entries; ``where`` is SQL from WHERE on, over the table ``v``."""
    rows = connection.execute(sa.text(_ENTRIES + where), values)
    return [(row.serial, _entry(row)) for row in rows]


def entries_of(connection: Connection, serials: Iterable[int]) -> list[MapEntry]:
    """The entries of some serials, in their order."""
    wanted = list(serials)
    statement = sa.text(_ENTRIES + "WHERE v.serial IN :serials").bindparams(
        sa.bindparam("serials", expanding=True)
    )
    found = {row.serial: _entry(row) for row in connection.execute(statement, {"serials": wanted})}
    return [found[serial] for serial in wanted]


def _entry(row: Row[Any]) -> MapEntry:
    before_number, before = _neighbour(row.before)
    behind_number, behind = _neighbour(row.behind)
    return MapEntry.model_validate_json(row.entry).model_copy(
        update={
            "number": row.number,
            "origin": row.origin,
            "is_latest": bool(row.is_latest),
            "retired": row.retired_ns is not None,
            "predecessor": before,
            "predecessor_number": before_number,
            "successor": behind,
            "successor_number": behind_number,
        }
    )


def _neighbour(told: str | None) -> tuple[int | None, str | None]:
    if told is None:
        return None, None
    number, _, version = told.partition(":")
    return int(number), version
