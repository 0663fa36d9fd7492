"""What the one-file catalogue of schema 1 knew, carried over into the present tables.

That catalogue lay beside its blobs, ``STORE/catalogue.sqlite`` and ``STORE/blobs/ab/<sha256>``, and did not know
what kind of part a blob is. The manifests do, so they are read again; where one is missing or damaged, the map
is carried over as it was known, and ``fleetmap store verify`` will tell.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import shapely
import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from fleetmap.catalogue import MapEntry
from fleetmap.errors import MapPackageError
from fleetmap.manifest import Manifest, manifest_version, parse_manifest
from fleetmap_server.boxes import add_to_index, outline

UNKNOWN_KIND = "unknown"


def carry_over(connection: Connection, blobs: Path) -> None:
    """Fill the new tables from ``versions_1`` and ``parts_1``, and drop those; inside the caller's transaction.

    Args:
        connection: of an SQLite database.
        blobs: the folder of the store's blobs.
    """
    old = connection.execute(sa.text(_OLD_VERSIONS)).all()
    for row in old:
        manifest = _manifest(blobs, row.version)
        _carry_version(connection, row, manifest)
        _carry_parts(connection, row.version, manifest)
    connection.execute(sa.text(_OBJECTS))
    for table in ("parts_1", "versions_1"):
        connection.execute(sa.text(f"DROP TABLE {table}"))


_OLD_VERSIONS = """
SELECT version, map_id, published_ns, manifest_bytes, entry,
    row_number() OVER history AS number,
    lag(version) OVER history AS predecessor,
    lead(version) OVER history IS NULL AS is_latest
FROM versions_1 WINDOW history AS (PARTITION BY map_id ORDER BY published_ns)
ORDER BY published_ns, map_id
"""

_INSERT = """
INSERT INTO versions (
    map_id, number, version, predecessor, origin, published_ns, manifest_bytes, start_ns, end_ns,
    west, south, east, north, length_m, landmarks, size_bytes, is_latest, outline, entry
) VALUES (
    :map_id, :number, :version, :predecessor, 'published', :published_ns, :manifest_bytes, :start_ns, :end_ns,
    :west, :south, :east, :north, :length_m, :landmarks, :size_bytes, :is_latest, :outline, :entry
) RETURNING serial
"""

# A blob whose file is damaged is found out when it is read, as always.
_OBJECTS = """
INSERT INTO objects (key, sha256, size_bytes, state, touched_ns)
SELECT 'blobs/' || substr(sha256, 1, 2) || '/' || sha256, sha256, max(size_bytes), 'live', max(published_ns)
FROM (
    SELECT version AS sha256, manifest_bytes AS size_bytes, published_ns FROM versions_1
    UNION ALL SELECT sha256, size_bytes, published_ns FROM parts_1 JOIN versions_1 USING (version)
) GROUP BY sha256
"""


def _carry_version(connection: Connection, row: Row[Any], manifest: Manifest | None) -> None:
    if manifest is None:
        entry = MapEntry.model_validate_json(row.entry)
    else:
        entry = MapEntry.from_manifest(manifest, row.version, row.manifest_bytes, row.published_ns)
    taken = ("map_id", "number", "version", "predecessor", "published_ns", "manifest_bytes", "is_latest")
    told = ("start_ns", "end_ns", "length_m", "landmarks", "size_bytes")
    values = {
        **{name: getattr(row, name) for name in taken},
        **{name: getattr(entry, name) for name in told},
        **dict(zip(("west", "south", "east", "north"), entry.bbox_lonlat, strict=True)),
        "outline": shapely.to_wkb(outline(entry.trajectory_lonlat, entry.bbox_lonlat)),
        "entry": entry.model_dump_json(),
    }
    serial = connection.execute(sa.text(_INSERT), values).scalar_one()
    if row.is_latest:
        add_to_index(connection, "map_boxes", serial, entry.bbox_lonlat)


def _carry_parts(connection: Connection, version: str, manifest: Manifest | None) -> None:
    kinds = {part.sha256: (part.kind, part.cell) for part in manifest.parts} if manifest else {}
    old = connection.execute(
        sa.text("SELECT sha256, size_bytes FROM parts_1 WHERE version = :version"), {"version": version}
    )
    rows = []
    for part in old.all():
        kind, cell = kinds.get(part.sha256, (UNKNOWN_KIND, None))
        east, north = cell or (None, None)
        rows.append((version, part.sha256, part.size_bytes, kind, east, north))
    names = ("version", "sha256", "size_bytes", "kind", "east", "north")
    connection.execute(
        sa.text("INSERT INTO parts VALUES (:version, :sha256, :size_bytes, :kind, :east, :north)"),
        [dict(zip(names, row, strict=True)) for row in rows],
    )


def _manifest(blobs: Path, version: str) -> Manifest | None:
    try:
        data = (blobs / version[:2] / version).read_bytes()
        return parse_manifest(data, version[:12]) if manifest_version(data) == version else None
    except (OSError, MapPackageError):
        return None
