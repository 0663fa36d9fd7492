"""Rows of ``drives`` as entries."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict
from sqlalchemy.engine import Row

from fleetmap.jobs import DriveEntry, DriveState, DriveSummary

COLUMNS = (
    "serial, sha256, name, size_bytes, received_ns, start_ns, end_ns, west, south, east, north, "
    "summary, retired_ns"
)


class StoredSummary(BaseModel):
    """What is known of a drive beside its file, as it stands in the column ``summary``."""

    model_config = ConfigDict(frozen=True)

    state: DriveState
    summary: DriveSummary


def drive_entry(row: Row[Any]) -> DriveEntry:
    """The drive of a row with all ``COLUMNS``."""
    stored = StoredSummary.model_validate_json(row.summary) if row.summary is not None else None
    return DriveEntry(
        sha256=row.sha256,
        name=row.name,
        size_bytes=row.size_bytes,
        received_ns=row.received_ns,
        start_ns=row.start_ns,
        end_ns=row.end_ns,
        bbox_lonlat=None if row.west is None else (row.west, row.south, row.east, row.north),
        summary=stored.summary if stored else None,
        state=stored.state if stored else "received",
    )
