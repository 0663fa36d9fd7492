"""Every blob hashed anew, every manifest checked anew: whether a store still holds what its catalogue promises."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import sqlalchemy as sa

from fleetmap.errors import FleetmapError, StorageError
from fleetmap.manifest import parse_manifest
from fleetmap_server import object_rows
from fleetmap_server.storage import Storage

Progress = Callable[[int, int], None]  # bytes done, bytes in total


def no_progress(done_bytes: int, total_bytes: int) -> None:
    """Nobody looks."""


@dataclass(frozen=True)
class Verification:
    """What was looked at, and what is wrong with it."""

    blobs: int
    size_bytes: int
    versions: int
    problems: tuple[str, ...]


def verify(storage: Storage, progress: Progress = no_progress, *, give_up: bool = False) -> Verification:
    """Look at everything in a store, also while servers use it.

    Args:
        storage: what to look at.
        progress: hears of the bytes hashed.
        give_up: give up blobs that are damaged or missing, so that publishing their maps again sends them anew.
            Otherwise nothing is changed.

    Raises:
        StorageError: the store or the catalogue cannot be read at all.
    """
    with storage.database.reading() as connection:
        objects = connection.execute(
            sa.text("SELECT key, sha256, size_bytes FROM objects WHERE state = 'live' ORDER BY key")
        ).all()
        versions = connection.execute(
            sa.text(
                "SELECT DISTINCT map_id, version FROM versions WHERE retired_ns IS NULL ORDER BY map_id, version"
            )
        ).all()
    problems: list[str] = []
    done_bytes, total_bytes = 0, sum(size_bytes for _, _, size_bytes in objects)
    for key, sha256, size_bytes in objects:
        if (wrong := _wrong_with_object(storage, key, sha256, size_bytes)) and _is_live(storage, key):
            problems.append(wrong)
            if give_up:
                _give_up(storage, key)
        progress(done_bytes := done_bytes + size_bytes, total_bytes)
    for map_id, version in versions:
        problems += [
            f"map '{map_id}', version {version[:12]}: {wrong}" for wrong in _wrong_with_map(storage, version)
        ]
    problems += _drives_without_recording(storage)
    return Verification(len(objects), total_bytes, len(versions), tuple(problems))


def _wrong_with_object(storage: Storage, key: str, sha256: str, size_bytes: int) -> str | None:
    state = storage.objects.head(key)
    if state is None:
        return f"blob {sha256[:12]} is missing in the store ({key})"
    if state.size_bytes != size_bytes:
        return f"blob {sha256[:12]} has {state.size_bytes} bytes instead of {size_bytes} ({key})"
    digest = hashlib.sha256()
    try:
        for piece in storage.objects.stream(key):
            digest.update(piece)
    except StorageError as error:
        return f"blob {sha256[:12]} cannot be read: {error}"
    return None if digest.hexdigest() == sha256 else f"blob {sha256[:12]} is damaged ({key})"


def _is_live(storage: Storage, key: str) -> bool:
    """Whether the catalogue still wants it: collection goes on meanwhile."""
    with storage.database.reading() as connection:
        found = connection.execute(
            sa.text("SELECT 1 FROM objects WHERE key = :key AND state = 'live'"), {"key": key}
        )
        return found.first() is not None


def _give_up(storage: Storage, key: str) -> None:
    with storage.database.writing() as connection:
        object_rows.doom(connection, (key,), time.time_ns())


def _wrong_with_map(storage: Storage, version: str) -> Iterator[str]:
    try:
        manifest = parse_manifest(b"".join(storage.blobs.stream(version)), f"version {version[:12]}")
    except FleetmapError as error:
        yield f"its manifest: {error}"
        return
    named = {(part.sha256, part.size_bytes) for part in manifest.parts}
    with storage.database.reading() as connection:
        rows = connection.execute(
            sa.text("SELECT sha256, size_bytes FROM parts WHERE version = :version"), {"version": version}
        )
        listed = {(sha256, size_bytes) for sha256, size_bytes in rows}
        missing = storage.blobs.missing(connection, {part.sha256: part.size_bytes for part in manifest.parts})
    if listed != named:
        yield f"the catalogue lists {len(listed)} parts that are not the {len(named)} its manifest names"
    yield from (f"part {sha256[:12]} is missing" for sha256 in missing)


def _drives_without_recording(storage: Storage) -> Iterator[str]:
    with storage.database.reading() as connection:
        rows = connection.execute(
            sa.text(
                "SELECT name, sha256 FROM drives WHERE retired_ns IS NULL AND NOT EXISTS"
                " (SELECT 1 FROM objects WHERE objects.sha256 = drives.sha256 AND state = 'live') ORDER BY name"
            )
        ).all()
    yield from (f"drive '{name}': its recording {sha256[:12]} is missing" for name, sha256 in rows)
