"""A map's history in the tables: which version is meant, which is the latest, and how the next one comes.

Everything works inside the caller's transaction.
"""

from __future__ import annotations

import json
from typing import Any, Literal

import shapely
import sqlalchemy as sa
from sqlalchemy.engine import Connection

from fleetmap.catalogue import MapEntry
from fleetmap.manifest import Manifest
from fleetmap_server.boxes import add_to_index, outline, remove_from_index
from fleetmap_server.problems import BadRequestError, GoneError
from fleetmap_server.version_rows import entries_where

MIN_PREFIX = 8  # digits of a version that may stand for all of it


def find_version(connection: Connection, map_id: str, version: str | int | None) -> MapEntry | None:
    """See Catalogue.entry."""
    if version is None:
        latest = latest_version(connection, map_id)
        if latest is None and is_known(connection, map_id):
            raise GoneError(f"map '{map_id}' was retired")
        return latest
    number = number_meant(version)
    value = number if number is not None else _checked_prefix(str(version))
    which = "v.number = :value" if number is not None else "substr(v.version, 1, length(:value)) = :value"
    where = f"WHERE v.map_id = :map_id AND {which} ORDER BY v.number DESC"
    rows = entries_where(connection, where, map_id=map_id, value=value)
    found = [entry for _, entry in rows]
    if not found:
        return None
    served = [entry for entry in found if not entry.retired]
    if not served:
        raise GoneError(f"version {short(version)} of map '{map_id}' was retired")
    if len({entry.version for entry in served}) > 1:
        raise BadRequestError(f"several versions of map '{map_id}' begin with {version}; give more of it")
    return served[0]


def number_meant(version: str | int) -> int | None:
    """The number that is meant, if it is one; a text of 8 digits or more is the beginning of a hash."""
    if isinstance(version, int):
        return version if 0 < version < 2**31 else -1
    return int(version) if version.isascii() and version.isdigit() and len(version) < MIN_PREFIX else None


def _checked_prefix(version: str) -> str:
    if not MIN_PREFIX <= len(version) <= 64 or set(version) - set("0123456789abcdef"):
        raise BadRequestError(
            f"'{version[:80]}' names no version; give its number, or {MIN_PREFIX} or more digits of its hash"
        )
    return version


def latest_version(connection: Connection, map_id: str) -> MapEntry | None:
    """The latest version; None for a map that is unknown or retired."""
    rows = entries_where(connection, "WHERE v.map_id = :map_id AND v.is_latest = 1", map_id=map_id)
    return rows[0][1] if rows else None


def known_latest(connection: Connection, map_id: str) -> MapEntry:
    """The latest version of a map that has one."""
    latest = latest_version(connection, map_id)
    assert latest is not None
    return latest


def is_known(connection: Connection, map_id: str) -> bool:
    """Whether there ever was such a map."""
    sql = "SELECT 1 FROM versions WHERE map_id = :map_id LIMIT 1"
    return connection.execute(sa.text(sql), {"map_id": map_id}).scalar() is not None


def published_before(
    connection: Connection, map_id: str, version: str, predecessor: str | None
) -> MapEntry | None:
    """The version as it was published on the same predecessor: a commit whose answer got lost."""
    same = "v.predecessor = :predecessor" if predecessor is not None else "v.predecessor IS NULL"
    values = {"map_id": map_id, "version": version} | ({"predecessor": predecessor} if predecessor else {})
    rows = entries_where(
        connection,
        f"WHERE v.map_id = :map_id AND v.version = :version AND {same} AND v.origin = 'published'"
        " AND v.retired_ns IS NULL ORDER BY v.number DESC LIMIT 1",
        **values,
    )
    return rows[0][1] if rows else None


def append_version(
    connection: Connection,
    entry: MapEntry,
    manifest_bytes: int,
    predecessor: str | None,
    origin: Literal["published", "rollback"],
) -> None:
    """The next number of a map's history, which is its latest version from now on."""
    before = connection.execute(
        sa.text("SELECT serial, west, south, east, north FROM versions WHERE map_id = :id AND is_latest = 1"),
        {"id": entry.map_id},
    ).one_or_none()
    if before is not None:
        box = (before.west, before.south, before.east, before.north)
        remove_from_index(connection, "map_boxes", before.serial, box)
        connection.execute(
            sa.text("UPDATE versions SET is_latest = 0 WHERE serial = :serial"), {"serial": before.serial}
        )
    serial = connection.execute(sa.text(_INSERT), _row(entry, manifest_bytes, predecessor, origin)).scalar_one()
    add_to_index(connection, "map_boxes", serial, entry.bbox_lonlat)


_INSERT = """
INSERT INTO versions (
    map_id, number, version, predecessor, origin, published_ns, manifest_bytes, start_ns, end_ns,
    west, south, east, north, length_m, landmarks, size_bytes, is_latest, outline, entry
) VALUES (
    :map_id, (SELECT coalesce(max(number), 0) + 1 FROM versions WHERE map_id = :map_id),
    :version, :predecessor, :origin, :published_ns, :manifest_bytes, :start_ns, :end_ns,
    :west, :south, :east, :north, :length_m, :landmarks, :size_bytes, 1, :outline, :entry
) RETURNING serial
"""


def _row(entry: MapEntry, manifest_bytes: int, predecessor: str | None, origin: str) -> dict[str, Any]:
    names = ("map_id", "version", "published_ns", "start_ns", "end_ns", "length_m", "landmarks", "size_bytes")
    return {
        **{name: getattr(entry, name) for name in names},
        **dict(zip(("west", "south", "east", "north"), entry.bbox_lonlat, strict=True)),
        "manifest_bytes": manifest_bytes,
        "predecessor": predecessor,
        "origin": origin,
        "outline": shapely.to_wkb(outline(entry.trajectory_lonlat, entry.bbox_lonlat)),
        "entry": entry.model_dump_json(),
    }


def append_parts(connection: Connection, manifest: Manifest, version: str) -> None:
    """What a version's manifest names, if it is not known yet."""
    rows = [(part.sha256, part.size_bytes, part.kind, *(part.cell or (None, None))) for part in manifest.parts]
    connection.execute(
        sa.text(_INSERT_PARTS[connection.dialect.name]), {"version": version, "rows": json.dumps(rows)}
    )


# All rows in one value: a map may have thousands of parts, and every statement costs a way there and back.
_INSERT_PARTS = {
    "sqlite": """
        INSERT INTO parts
        SELECT :version, json_extract(value, '$[0]'), json_extract(value, '$[1]'), json_extract(value, '$[2]'),
            json_extract(value, '$[3]'), json_extract(value, '$[4]')
        FROM json_each(:rows) WHERE true ON CONFLICT DO NOTHING
    """,
    "postgresql": """
        INSERT INTO parts
        SELECT :version, part ->> 0, CAST(part ->> 1 AS BIGINT), part ->> 2,
            CAST(part ->> 3 AS INTEGER), CAST(part ->> 4 AS INTEGER)
        FROM jsonb_array_elements(CAST(:rows AS JSONB)) AS part ON CONFLICT DO NOTHING
    """,
}


def short(version: str | int) -> str:
    """A version as it is told to people."""
    return str(version)[:12]
