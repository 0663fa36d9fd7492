"""How much a server keeps, counted in its catalogue."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from threading import Lock

import sqlalchemy as sa

from fleetmap_server.database import Database

_JOB_STATES = ("queued", "running", "done", "failed", "cancelled")
_UPLOAD_KINDS = ("map", "drive")
_SHARE = 0.01  # of the time may be spent on counting, which takes a look at every version and every blob


@dataclass(frozen=True)
class CatalogueSize:
    """Numbers of what a catalogue has."""

    maps: int
    versions: int  # that are not retired
    drives: int
    stored_bytes: int  # of all blobs
    uploads_under_way: Mapping[str, int]  # by kind
    jobs: Mapping[str, int]  # by state


def catalogue_size(database: Database) -> CatalogueSize:
    """Counted in one snapshot. Raises StorageError."""
    with database.reading() as connection:
        maps, versions, drives, stored_bytes = connection.execute(
            sa.text(
                "SELECT (SELECT count(*) FROM versions WHERE is_latest = 1),"
                " (SELECT count(*) FROM versions WHERE retired_ns IS NULL),"
                " (SELECT count(*) FROM drives WHERE retired_ns IS NULL),"
                " (SELECT coalesce(sum(size_bytes), 0) FROM objects WHERE state = 'live')"
            )
        ).one()
        jobs = connection.execute(sa.text("SELECT state, count(*) FROM jobs GROUP BY state"))
        jobs_by_state = dict.fromkeys(_JOB_STATES, 0) | {state: int(count) for state, count in jobs}
        uploads = connection.execute(sa.text("SELECT kind, count(*) FROM uploads GROUP BY kind"))
        uploads_by_kind = dict.fromkeys(_UPLOAD_KINDS, 0) | {kind: int(count) for kind, count in uploads}
    return CatalogueSize(int(maps), int(versions), int(drives), int(stored_bytes), uploads_by_kind, jobs_by_state)


class SparingCount:
    """The size of a catalogue, counted anew only as often as it is cheap; safe to use from several threads."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = Lock()
        self._known: CatalogueSize | None = None
        self._next_s = float("-inf")

    def read(self) -> CatalogueSize:
        """The size now or lately. Raises StorageError, also where only the last count is to be told."""
        with self._lock:
            begun_s = time.monotonic()
            if self._known is None or begun_s >= self._next_s:
                self._known = catalogue_size(self._database)
                ended_s = time.monotonic()
                self._next_s = ended_s + (ended_s - begun_s) / _SHARE
            else:
                with self._database.reading() as connection:
                    connection.execute(sa.text("SELECT 1"))
            return self._known
