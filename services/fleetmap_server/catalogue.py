"""The list of published maps: one SQLite file that remembers every version and knows the latest."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import RLock
from typing import Any

from fleetmap.catalogue import MapEntry
from fleetmap.errors import InputError, StorageError
from fleetmap.manifest import Manifest

SCHEMA_VERSION = 1
LonLatBox = tuple[float, float, float, float]  # west, south, east, north; west > east crosses 180 degrees

_SCHEMA = f"""
CREATE TABLE versions (
    version TEXT PRIMARY KEY,
    map_id TEXT NOT NULL,
    published_ns INTEGER NOT NULL,
    manifest_bytes INTEGER NOT NULL,
    west REAL NOT NULL, south REAL NOT NULL, east REAL NOT NULL, north REAL NOT NULL,
    entry TEXT NOT NULL
) WITHOUT ROWID;
CREATE UNIQUE INDEX versions_of_map ON versions (map_id, published_ns);
CREATE TABLE parts (
    version TEXT NOT NULL REFERENCES versions (version),
    sha256 TEXT NOT NULL,
    size_bytes INTEGER NOT NULL,
    PRIMARY KEY (version, sha256)
) WITHOUT ROWID;
CREATE VIEW latest AS
    SELECT * FROM versions AS v
    WHERE published_ns = (SELECT max(published_ns) FROM versions WHERE map_id = v.map_id);
PRAGMA user_version = {SCHEMA_VERSION};
"""


class Catalogue:
    """Open the catalogue file, or make it; safe to use from several threads.

    Raises:
        InputError: it is no catalogue, or was written by a newer fleetmap.
        StorageError: it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = RLock()
        with self._errors():
            self._database = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
        try:
            self._prepare()
        except BaseException:
            self._database.close()
            raise

    def close(self) -> None:
        """Let go of the file."""
        with self._lock:
            self._database.close()

    def add(self, manifest: Manifest, version: str, manifest_bytes: int) -> MapEntry:
        """Make a version the latest of its map; nothing changes if it is that already."""
        with self._transaction():
            current = self.entry(manifest.map_id)
            if current is not None and current.version == version:
                return current
            published_ns = max(time.time_ns(), current.published_ns + 1 if current else 0)
            entry = MapEntry.from_manifest(manifest, version, manifest_bytes, published_ns)
            self._database.execute(
                "INSERT OR REPLACE INTO versions VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (version, entry.map_id, published_ns, manifest_bytes, *entry.bbox_lonlat, entry.model_dump_json()),
            )
            self._database.executemany(
                "INSERT OR REPLACE INTO parts VALUES (?, ?, ?)",
                {(version, part.sha256, part.size_bytes) for part in manifest.parts},
            )
        return entry

    def entry(self, map_id: str, version: str | None = None) -> MapEntry | None:
        """One version of a map, without ``version`` the latest; None if there is none."""
        if version is None:
            rows = self._rows("SELECT entry FROM latest WHERE map_id = ?", (map_id,))
        else:
            rows = self._rows("SELECT entry FROM versions WHERE map_id = ? AND version = ?", (map_id, version))
        return MapEntry.model_validate_json(rows[0][0]) if rows else None

    def entries(self, box: LonLatBox | None = None, limit: int = -1, offset: int = 0) -> list[MapEntry]:
        """The latest versions whose bounding boxes meet ``box``, newest first; ``limit`` -1 is none."""
        where, values = _meets(box) if box is not None else ("1", ())
        rows = self._rows(
            f"SELECT entry FROM latest WHERE {where} ORDER BY published_ns DESC, map_id LIMIT ? OFFSET ?",
            (*values, limit, offset),
        )
        return [MapEntry.model_validate_json(row[0]) for row in rows]

    def count(self, box: LonLatBox | None = None) -> int:
        """How many maps ``entries`` would list without a limit."""
        where, values = _meets(box) if box is not None else ("1", ())
        return int(self._rows(f"SELECT count(*) FROM latest WHERE {where}", values)[0][0])

    def blob_size(self, version: str, sha256: str) -> int | None:
        """Size of a version's manifest or part; None if the version has no such blob, or is not published."""
        rows = self._rows(
            "SELECT manifest_bytes FROM versions WHERE version = ?1 AND version = ?2"
            " UNION ALL SELECT size_bytes FROM parts WHERE version = ?1 AND sha256 = ?2",
            (version, sha256),
        )
        return int(rows[0][0]) if rows else None

    def has_part(self, map_id: str, sha256: str) -> bool:
        """Whether any version of the map has this part."""
        return bool(
            self._rows(
                "SELECT 1 FROM parts JOIN versions USING (version) WHERE map_id = ? AND sha256 = ? LIMIT 1",
                (map_id, sha256),
            )
        )

    def _prepare(self) -> None:
        with self._lock, self._errors():
            found = int(self._database.execute("PRAGMA user_version").fetchone()[0])
            if found > SCHEMA_VERSION:
                raise InputError(
                    f"{self._path} was written by a newer fleetmap (schema {found}, this one reads "
                    f"{SCHEMA_VERSION}); upgrade fleetmap or give another --store"
                )
            self._database.execute("PRAGMA journal_mode = WAL")
            self._database.execute("PRAGMA synchronous = FULL")
            if found == 0:
                self._database.executescript(f"BEGIN; {_SCHEMA} COMMIT;")

    def _rows(self, sql: str, values: tuple[object, ...]) -> list[tuple[Any, ...]]:
        with self._lock, self._errors():
            return self._database.execute(sql, values).fetchall()

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._lock, self._errors():
            self._database.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._database.execute("COMMIT")
            except BaseException:
                if self._database.in_transaction:
                    self._database.execute("ROLLBACK")
                raise

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.OperationalError as error:
            raise StorageError(f"{self._path}: {error}; free some space or check its permissions") from error
        except sqlite3.DatabaseError as error:
            raise InputError(f"{self._path} is no catalogue of maps: {error}; give another --store") from error


def _meets(box: LonLatBox) -> tuple[str, tuple[float, ...]]:
    """SQL that holds for bounding boxes that meet ``box``, and its values.

    Two intervals of longitude meet if each begins before the other ends. If one of them crosses 180 degrees,
    one of these is enough; if both do, they meet there.
    """
    west, south, east, north = box
    if west <= east:
        longitudes = "iif(west <= east, west <= ?1 AND east >= ?2, west <= ?1 OR east >= ?2)"
    else:
        longitudes = "(west > east OR west <= ?1 OR east >= ?2)"
    return f"{longitudes} AND south <= ?3 AND north >= ?4", (east, west, north, south)
