"""The list of survey drives: recordings that arrived whole, named by their SHA-256, with what is known of them.

What the sender found in a recording counts until a worker has looked at it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from fleetmap.jobs import DriveEntry, DriveSummary
from fleetmap_server.boxes import add_to_index, remove_from_index
from fleetmap_server.database import Database
from fleetmap_server.drive_rows import COLUMNS, StoredSummary, drive_entry
from fleetmap_server.drive_search import DrivePage, DriveSearch, find_drives
from fleetmap_server.problems import BadRequestError, GoneError, NotFoundError

MIN_PREFIX = 8  # digits of a hash that may stand for all of it


class Drives:
    """The drives in a database. What changes them takes the caller's ``database.writing()`` connection."""

    def __init__(self, database: Database, clock: Callable[[], int] = time.time_ns) -> None:
        self._database = database
        self._clock = clock

    def add(
        self,
        connection: Connection,
        sha256: str,
        name: str,
        size_bytes: int,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> DriveEntry:
        """List a recording that is in the store; the same one again is the same drive with its first name.

        Args:
            connection: of a ``writing()`` block.
            sha256: of the recording.
            name: of its file.
            size_bytes: its length.
            start_ns: what the recording's frame says about its time, until a summary knows better.
            end_ns: likewise.
        """
        row = _row(connection, sha256)
        if row is not None:
            return drive_entry(row) if row.retired_ns is None else self._revive(connection, row)
        connection.execute(
            sa.text(
                "INSERT INTO drives (sha256, name, size_bytes, received_ns, start_ns, end_ns)"
                " VALUES (:sha256, :name, :size_bytes, :now, :start_ns, :end_ns)"
            ),
            {
                "sha256": sha256,
                "name": name,
                "size_bytes": size_bytes,
                "now": self._clock(),
                "start_ns": start_ns,
                "end_ns": end_ns,
            },
        )
        return drive_entry(_need(connection, sha256))

    def summarise(
        self, connection: Connection, sha256: str, summary: DriveSummary, *, checked: bool
    ) -> DriveEntry:
        """Note what was found in a recording; ``checked`` by a worker, which a sender's word never replaces.

        Raises:
            NotFoundError, GoneError: there is no such drive, or not any more.
        """
        row = _need(connection, sha256)
        entry = drive_entry(row)
        if entry.state == "checked" and not checked:
            return entry
        if entry.bbox_lonlat is not None:
            remove_from_index(connection, "drive_boxes", row.serial, entry.bbox_lonlat)
        box = summary.bbox_lonlat
        stored = StoredSummary(state="checked" if checked else "received", summary=summary)
        sides = dict(zip(("west", "south", "east", "north"), box or (None,) * 4, strict=True))
        connection.execute(
            sa.text(
                "UPDATE drives SET summary = :summary, west = :west, south = :south, east = :east, north = :north,"
                " start_ns = COALESCE(:start_ns, start_ns), end_ns = COALESCE(:end_ns, end_ns)"
                " WHERE serial = :serial"
            ),
            {
                "summary": stored.model_dump_json(),
                "start_ns": summary.start_ns,
                "end_ns": summary.end_ns,
                "serial": row.serial,
                **sides,
            },
        )
        if box is not None:
            add_to_index(connection, "drive_boxes", row.serial, box)
        return drive_entry(_need(connection, sha256))

    def get(self, sha256: str) -> DriveEntry:
        """One drive by its hash, or by the first digits of it if they are enough.

        Raises:
            NotFoundError: there is none.
            GoneError: it was retired.
            BadRequestError: there are several with these digits, or there are too few digits.
        """
        with self._database.reading() as connection:
            if len(sha256) == 64:
                return drive_entry(_need(connection, sha256))
            if len(sha256) < MIN_PREFIX:
                raise BadRequestError(f"'{sha256}' is too short to name a drive; give {MIN_PREFIX} digits or more")
            page = find_drives(connection, DriveSearch(prefix=sha256, limit=2))
        if not page.entries:
            raise _not_found(sha256)
        if len(page.entries) > 1:
            raise BadRequestError(f"several drives begin with '{sha256}'; give more digits")
        return page.entries[0]

    def find(self, sha256: str, connection: Connection | None = None) -> DriveEntry | None:
        """The drive with this hash, also inside a transaction; None if there is none, or not any more."""
        if connection is None:
            with self._database.reading() as connection:
                return self.find(sha256, connection)
        row = _row(connection, sha256)
        return None if row is None or row.retired_ns is not None else drive_entry(row)

    def search(self, search: DriveSearch) -> DrivePage:
        """One page of a search. Raises BadRequestError for a cursor that is not of this search."""
        with self._database.reading() as connection:
            return find_drives(connection, search)

    def count(self) -> int:
        """How many drives there are."""
        with self._database.reading() as connection:
            return int(
                connection.execute(sa.text("SELECT count(*) FROM drives WHERE retired_ns IS NULL")).scalar_one()
            )

    def retire(self, connection: Connection, sha256: str) -> None:
        """Neither list nor serve a drive any more; its recording may be collected. Once more changes nothing.

        Its jobs are for the caller to cancel.

        Raises:
            NotFoundError: there is no such drive.
        """
        row = _row(connection, sha256)
        if row is None:
            raise _not_found(sha256)
        if row.retired_ns is not None:
            return
        box = drive_entry(row).bbox_lonlat
        if box is not None:
            remove_from_index(connection, "drive_boxes", row.serial, box)
        connection.execute(
            sa.text("UPDATE drives SET retired_ns = :now WHERE serial = :serial"),
            {"now": self._clock(), "serial": row.serial},
        )

    def _revive(self, connection: Connection, row: Row[Any]) -> DriveEntry:
        """A retired drive that somebody sent again."""
        connection.execute(
            sa.text("UPDATE drives SET retired_ns = NULL, received_ns = :now WHERE serial = :serial"),
            {"now": self._clock(), "serial": row.serial},
        )
        entry = drive_entry(_need(connection, row.sha256))
        if entry.bbox_lonlat is not None:
            add_to_index(connection, "drive_boxes", row.serial, entry.bbox_lonlat)
        return entry


def _row(connection: Connection, sha256: str) -> Row[Any] | None:
    sql = f"SELECT {COLUMNS} FROM drives WHERE sha256 = :sha256"
    return connection.execute(sa.text(sql), {"sha256": sha256}).first()


def _need(connection: Connection, sha256: str) -> Row[Any]:
    row = _row(connection, sha256)
    if row is None:
        raise _not_found(sha256)
    if row.retired_ns is not None:
        raise GoneError(f"drive {sha256[:12]} was retired; upload it again to have it back")
    return row


def _not_found(sha256: str) -> NotFoundError:
    return NotFoundError(f"the server has no drive {sha256[:12]}; 'fleetmap drives list' names those it has")
