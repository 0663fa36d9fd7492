"""Transfers under way, and what each of them counts on.

What an upload claims is not collected, whether it is here already or has yet to arrive, until the upload ends or
is abandoned. All functions work in the caller's transaction. Claims come first, then the question what is missing:
so nothing that was said to be here can be gone when the upload is committed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from fleetmap_server.object_rows import EVERYTHING as EVERYTHING
from fleetmap_server.object_rows import as_list, listed

UploadKind = Literal["map", "drive", "backup"]


@dataclass(frozen=True)
class UploadUnderWay:
    """A transfer that has begun and not ended."""

    upload: str
    kind: UploadKind
    name: str
    size_bytes: int
    touched_ns: int


def begin(connection: Connection, upload: str, kind: UploadKind, name: str, size_bytes: int, now_ns: int) -> None:
    """Begin an upload, or go on with one of the same name; it keeps its claims."""
    connection.execute(
        sa.text(
            "INSERT INTO uploads (upload, kind, name, size_bytes, touched_ns) "
            "VALUES (:upload, :kind, :name, :size_bytes, :now_ns) ON CONFLICT (upload) DO UPDATE "
            "SET kind = :kind, name = :name, size_bytes = :size_bytes, touched_ns = :now_ns"
        ),
        {"upload": upload, "kind": kind, "name": name, "size_bytes": size_bytes, "now_ns": now_ns},
    )


def claim(connection: Connection, upload: str, sha256s: Iterable[str]) -> None:
    """Count on blobs until the upload, which has begun, ends."""
    connection.execute(
        sa.text(
            "INSERT INTO claims (upload, sha256) "
            f"SELECT :upload, wanted.* FROM {listed(connection, 'sha256s')} AS wanted WHERE true "
            "ON CONFLICT (upload, sha256) DO NOTHING"
        ),
        {"upload": upload, "sha256s": as_list(sha256s)},
    )


def touch(connection: Connection, upload: str, now_ns: int) -> bool:
    """Tell that an upload is still under way; False if it is not any more."""
    touched = connection.execute(
        sa.text("UPDATE uploads SET touched_ns = :now_ns WHERE upload = :upload"),
        {"upload": upload, "now_ns": now_ns},
    )
    return touched.rowcount == 1


def end(connection: Connection, upload: str) -> None:
    """End an upload with its claims, in the transaction in which its blobs come to be referenced otherwise."""
    connection.execute(sa.text("DELETE FROM uploads WHERE upload = :upload"), {"upload": upload})


def end_abandoned(connection: Connection, before_ns: int) -> int:
    """End the uploads that nobody touched since; returns how many."""
    ended = connection.execute(
        sa.text("DELETE FROM uploads WHERE touched_ns < :before_ns"), {"before_ns": before_ns}
    )
    return ended.rowcount


def find(connection: Connection, upload: str) -> UploadUnderWay | None:
    """One upload; None if it did not begin, or has ended."""
    found = connection.execute(
        sa.text("SELECT upload, kind, name, size_bytes, touched_ns FROM uploads WHERE upload = :upload"),
        {"upload": upload},
    ).one_or_none()
    return None if found is None else UploadUnderWay(*found)
