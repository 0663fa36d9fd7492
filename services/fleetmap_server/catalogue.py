"""The list of published maps: every version each map ever had, which one counts, and where they lie.

A map's versions are numbered without gaps. Publishing and rolling back both add the next number, so what is the
latest only ever moves forward, and what was published can be told in order by its serial.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from fleetmap.catalogue import MapEntry
from fleetmap.errors import ConflictError
from fleetmap.manifest import Manifest
from fleetmap_server import map_search
from fleetmap_server.boxes import remove_from_index
from fleetmap_server.database import Database
from fleetmap_server.history import (
    append_parts,
    append_version,
    find_version,
    is_known,
    known_latest,
    latest_version,
    number_meant,
    published_before,
    short,
)
from fleetmap_server.problems import BadRequestError, GoneError, NotFoundError
from fleetmap_server.search import MapSearch, SearchPage
from fleetmap_server.version_rows import entries_where


@dataclass(frozen=True)
class CataloguePart:
    """A blob that a version's manifest names."""

    sha256: str
    size_bytes: int
    kind: str
    cell: tuple[int, int] | None


class Catalogue:
    """The maps in a database. What changes them takes the caller's ``database.writing()`` connection."""

    def __init__(self, database: Database, clock: Callable[[], int] = time.time_ns) -> None:
        self.database = database
        self._clock = clock

    def add(
        self,
        connection: Connection,
        manifest: Manifest,
        version: str,
        manifest_bytes: int,
        predecessor: str | None,
    ) -> MapEntry:
        """Make a version the latest of its map; doing it once more changes nothing.

        Args:
            connection: of a ``writing()`` block.
            manifest: of the version.
            version: SHA-256 of the manifest.
            manifest_bytes: the manifest's length.
            predecessor: the version that its publisher saw as the latest; None if there was no such map.

        Returns:
            Its entry. It is not the latest if the same was published before and has been succeeded since.

        Raises:
            ConflictError: somebody else published meanwhile.
        """
        map_id = manifest.map_id
        latest = latest_version(connection, map_id)
        if latest is not None and latest.version == version:
            return latest
        if (before := published_before(connection, map_id, version, predecessor)) is not None:
            return before
        if (latest.version if latest else None) != predecessor:
            raise _conflict(map_id, latest, predecessor)
        entry = MapEntry.from_manifest(manifest, version, manifest_bytes, self._now_ns(latest))
        append_version(connection, entry, manifest_bytes, predecessor, "published")
        append_parts(connection, manifest, version)
        return known_latest(connection, map_id)

    def rollback(
        self, connection: Connection, map_id: str, version: str | int, latest: str | None = None
    ) -> MapEntry:
        """Make an older content the latest again, under a new number; if it is that already, nothing changes.

        Args:
            connection: of a ``writing()`` block.
            map_id: the map.
            version: the content, as in ``entry``.
            latest: the version that the caller takes for the latest; None to go back whatever it is.

        Raises:
            NotFoundError: there is no such map or version.
            GoneError: it was retired.
            ConflictError: another version than ``latest`` is.
        """
        old = find_version(connection, map_id, version)
        if old is None:
            raise NotFoundError(f"map '{map_id}' has no version {short(version)}")
        now = known_latest(connection, map_id)
        if now.version == old.version:
            return now
        if latest is not None and latest != now.version:
            raise _conflict(map_id, now, latest)
        manifest_bytes = self._manifest_bytes(connection, old.version)
        entry = old.model_copy(update={"published_ns": self._now_ns(now)})
        append_version(connection, entry, manifest_bytes, now.version, "rollback")
        return known_latest(connection, map_id)

    def retire(self, connection: Connection, map_id: str, version: str | int | None = None) -> int:
        """Neither list nor serve a version any more, or the whole map; how many numbers it was.

        Args:
            connection: of a ``writing()`` block.
            map_id: the map.
            version: a number, or a hash for all numbers with this content; None for the whole map.

        Raises:
            NotFoundError: there is no such map or version.
            BadRequestError: it is the latest version.
        """
        if version is None:
            return self._retire_map(connection, map_id)
        try:
            old = find_version(connection, map_id, version)
        except GoneError:
            return 0
        if old is None:
            raise NotFoundError(f"map '{map_id}' has no version {short(version)}")
        by_number = number_meant(version) is not None
        if old.is_latest or (not by_number and known_latest(connection, map_id).version == old.version):
            raise BadRequestError(
                f"version {short(old.version)} is the latest of map '{map_id}'; publish or roll back to another "
                "first, or retire the whole map"
            )
        which = "number = :which" if by_number else "version = :which"
        retired = connection.execute(
            sa.text(
                "UPDATE versions SET retired_ns = :now"
                f" WHERE map_id = :map_id AND {which} AND retired_ns IS NULL AND is_latest = 0"
            ),
            {"now": self._clock(), "map_id": map_id, "which": old.number if by_number else old.version},
        )
        return retired.rowcount

    def entry(self, map_id: str, version: str | int | None = None) -> MapEntry | None:
        """One version of a map; None if there is none.

        Args:
            map_id: the map.
            version: its number, its hash or the beginning of it (8 digits or more); None for the latest.
                Of several numbers with one hash it is the highest.

        Raises:
            GoneError: it was retired.
            BadRequestError: several versions begin like this, or it is too short.
        """
        with self.database.reading() as connection:
            return find_version(connection, map_id, version)

    def latest(self, connection: Connection, map_id: str) -> MapEntry | None:
        """The latest version inside a transaction; None for a map that is unknown or retired."""
        return latest_version(connection, map_id)

    def versions(self, map_id: str) -> list[MapEntry]:
        """All versions that are not retired, oldest first; empty if there is no such map."""
        with self.database.reading() as connection:
            where = "WHERE v.map_id = :map_id AND v.retired_ns IS NULL ORDER BY v.number"
            return [entry for _, entry in entries_where(connection, where, map_id=map_id)]

    def search(self, search: MapSearch) -> SearchPage:
        """A page of latest versions. Raises BadRequestError for a cursor that is not of this search."""
        with self.database.reading() as connection:
            return map_search.find(connection, search)

    def since(self, serial: int, limit: int = 1000) -> list[tuple[int, MapEntry]]:
        """What was published or rolled back to after a serial, in order; to go on, give the last one's serial.

        Nothing is ever added before a serial that was told. Versions retired since are among them, as retired.
        """
        with self.database.reading() as connection:
            where = "WHERE v.serial > :serial ORDER BY v.serial LIMIT :limit"
            return entries_where(connection, where, serial=serial, limit=limit)

    def identity(self) -> str:
        """Of this catalogue among all; a restored one keeps it."""
        return str(self._scalar("SELECT value FROM facts WHERE name = 'catalogue_id'"))

    def last_serial(self) -> int:
        """The serial of what was published last, 0 if nothing was."""
        return int(self._scalar("SELECT coalesce(max(serial), 0) FROM versions"))

    def count(self) -> int:
        """How many maps there are."""
        return int(self._scalar("SELECT count(*) FROM versions WHERE is_latest = 1"))

    def parts(self, version: str) -> list[CataloguePart]:
        """What a version's manifest names."""
        return self.parts_of([version])[version]

    def parts_of(self, versions: Iterable[str]) -> dict[str, list[CataloguePart]]:
        """``parts`` of several versions at once."""
        found: dict[str, list[CataloguePart]] = {version: [] for version in versions}
        if not found:
            return found
        statement = sa.text(
            "SELECT version, sha256, size_bytes, kind, cell_east, cell_north FROM parts WHERE version IN :versions"
            " ORDER BY kind, cell_east, cell_north, sha256"
        ).bindparams(sa.bindparam("versions", expanding=True))
        with self.database.reading() as connection:
            for row in connection.execute(statement, {"versions": list(found)}):
                cell = (row.cell_east, row.cell_north) if row.cell_east is not None else None
                found[row.version].append(CataloguePart(row.sha256, row.size_bytes, row.kind, cell))
        return found

    def blob_size(self, version: str, sha256: str) -> int | None:
        """Size of a version's manifest or part; None if it has no such blob, or is not published or retired."""
        size = self._scalar(
            "SELECT manifest_bytes FROM versions"
            " WHERE version = :version AND version = :sha256 AND retired_ns IS NULL"
            " UNION ALL SELECT size_bytes FROM parts WHERE version = :version AND sha256 = :sha256"
            " AND EXISTS (SELECT 1 FROM versions WHERE version = :version AND retired_ns IS NULL) LIMIT 1",
            version=version,
            sha256=sha256,
        )
        return None if size is None else int(size)

    def has_part(self, map_id: str, sha256: str) -> bool:
        """Whether any version of the map that is not retired has this part."""
        found = self._scalar(
            "SELECT 1 FROM parts JOIN versions ON versions.version = parts.version"
            " WHERE sha256 = :sha256 AND map_id = :map_id AND retired_ns IS NULL LIMIT 1",
            map_id=map_id,
            sha256=sha256,
        )
        return found is not None

    def has_blob(self, sha256: str) -> bool:
        """Whether any version that is not retired is, or has, this manifest or part."""
        found = self._scalar(
            "SELECT 1 FROM versions WHERE version = :sha256 AND retired_ns IS NULL"
            " UNION ALL SELECT 1 FROM parts JOIN versions ON versions.version = parts.version"
            " WHERE sha256 = :sha256 AND retired_ns IS NULL LIMIT 1",
            sha256=sha256,
        )
        return found is not None

    def _retire_map(self, connection: Connection, map_id: str) -> int:
        row = connection.execute(
            sa.text("SELECT serial, west, south, east, north FROM versions WHERE map_id = :id AND is_latest = 1"),
            {"id": map_id},
        ).one_or_none()
        if row is None:
            if is_known(connection, map_id):
                return 0
            raise NotFoundError(f"there is no map '{map_id}'")
        remove_from_index(connection, "map_boxes", row.serial, (row.west, row.south, row.east, row.north))
        retired = connection.execute(
            sa.text(
                "UPDATE versions SET retired_ns = :now, is_latest = 0 WHERE map_id = :id AND retired_ns IS NULL"
            ),
            {"now": self._clock(), "id": map_id},
        )
        return retired.rowcount

    def _now_ns(self, latest: MapEntry | None) -> int:
        """The time, but later than the latest version's, however the clock was set meanwhile."""
        return max(self._clock(), latest.published_ns + 1 if latest else 0)

    def _manifest_bytes(self, connection: Connection, version: str) -> int:
        sql = "SELECT manifest_bytes FROM versions WHERE version = :version LIMIT 1"
        return int(connection.execute(sa.text(sql), {"version": version}).scalar_one())

    def _scalar(self, sql: str, **values: object) -> Any:
        with self.database.reading() as connection:
            return connection.execute(sa.text(sql), values).scalar()


def _conflict(map_id: str, latest: MapEntry | None, expected: str | None) -> ConflictError:
    now = f"version {short(latest.version)} (number {latest.number}) is" if latest else "none is"
    was = f"version {short(expected)} was" if expected else "there was none"
    return ConflictError(
        f"map '{map_id}' has changed meanwhile: {now} the latest now, {was} when this began; "
        "look at what is new and begin again"
    )
