"""Blobs on their way in: pieces, each an object of its own, until all are there and become one.

A piece that was acknowledged is in the object store, so any server of a fleet can go on where another stopped.
The last piece makes the blob: all are streamed into its key and hashed on the way, and only then it goes live. A
stop between any two steps leaves pieces to go on with, or a live blob; what else is left goes with a collection.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from threading import Lock

from fleetmap.errors import FleetmapError, MapPackageError, StorageError
from fleetmap_server import object_rows
from fleetmap_server.database import Database
from fleetmap_server.object_rows import PIECES, ObjectRow
from fleetmap_server.object_store import ObjectExistsError, ObjectMissingError, ObjectState, ObjectStore

Accept = Callable[[Iterator[bytes]], object]

_REMEMBERED = 10_000
_FEW = 16  # listed one by one; more with all there is
_SMALL_BYTES = 8 * 1024 * 1024  # written in one request, from memory


@dataclass(frozen=True)
class Progress:
    """What has been received, from the start on without gaps."""

    end_bytes: int = 0
    last_piece_bytes: int = 0  # where the last piece begins

    def told(self, size_bytes: int) -> int:
        """How much to tell the sender, who sends the last piece of an unsettled blob once more."""
        return self.end_bytes if self.end_bytes < size_bytes else self.last_piece_bytes


class Receiver:
    """Takes the pieces of blobs and settles those that are whole; safe to use from several threads."""

    def __init__(self, objects: ObjectStore, database: Database, clock: Callable[[], int]) -> None:
        self._objects = objects
        self._database = database
        self._clock = clock
        self._progress: dict[str, Progress] = {}  # by key, so that 5,000 pieces are not listed 5,000 times
        self._lock = Lock()

    def received(self, rows: Collection[ObjectRow]) -> dict[str, int]:
        """How much of some blobs is in the store, by SHA-256, whoever put it there."""
        if len(rows) <= _FEW:
            return {row.sha256: self._listed(row).told(row.size_bytes) for row in rows}
        pieces: dict[str, list[tuple[str, int]]] = defaultdict(list)
        for key, size_bytes in self._objects.keys(PIECES):
            pieces[key.rpartition("/")[0]].append((key, size_bytes))
        return {
            row.sha256: self._remember(row.key, _without_gaps(pieces[row.pieces])).told(row.size_bytes)
            for row in rows
        }

    def take(
        self, row: ObjectRow, offset: int, data: bytes, accept: Accept | None
    ) -> tuple[int, ObjectState | None]:
        """Add bytes to a blob that is being received if they are the next ones, and settle it with the last.

        Returns how many bytes are here now, and the blob's state if these made it one.

        Raises:
            MapPackageError: the bytes are not what they should be; the upload is thrown away.
            StorageError: the store is full or refuses; what was received before stays.
        """
        progress = self._progress.get(row.key) or self._listed(row)
        if offset == 0 and len(data) == row.size_bytes and progress.end_bytes == 0:
            if hashlib.sha256(data).hexdigest() != row.sha256:
                raise _wrong_bytes(row)
            return self._settle(row, (data,), accept)
        if offset > progress.end_bytes:
            progress = self._listed(row)
        if offset == progress.end_bytes < row.size_bytes and data:
            progress = self._put(row, offset, data)
        if progress.end_bytes < row.size_bytes:
            return progress.end_bytes, None
        if offset < progress.last_piece_bytes:
            return progress.told(row.size_bytes), None
        return self._settle(row, None, accept)

    def _put(self, row: ObjectRow, offset: int, data: bytes) -> Progress:
        try:
            self._objects.put(f"{row.pieces}/{offset:016d}", data)
        except ObjectExistsError:  # another server was faster, or our own acknowledgement was lost
            return self._listed(row)
        return self._remember(row.key, Progress(offset + len(data), offset))

    def _settle(
        self, row: ObjectRow, whole: tuple[bytes] | None, accept: Accept | None
    ) -> tuple[int, ObjectState | None]:
        """Make a whole upload a blob, or throw it away."""
        try:
            state = self._write(row, self._pieces(row) if whole is None else whole)
            if accept is not None:
                accept(self._objects.stream(row.key) if whole is None else iter(whole))
        except ObjectMissingError:  # another server settled it, or threw it away
            return self._after_others(row)
        except StorageError:
            raise
        except FleetmapError:
            self._throw_away(row)
            raise
        with self._database.writing() as connection:
            is_live = object_rows.make_live(connection, row.key, self._clock())
        if not is_live:
            return self._after_others(row)
        self._objects.delete(self._piece_keys(row))
        self._forget(row.key)
        return row.size_bytes, state

    def _write(self, row: ObjectRow, pieces: Iterable[bytes]) -> ObjectState:
        """The object under the row's key, its hash checked before it is there."""
        checked = _checked(pieces, row)
        try:
            if row.size_bytes > _SMALL_BYTES:
                return self._objects.put_stream(row.key, checked)
            return self._objects.put(row.key, b"".join(checked))
        except ObjectExistsError:  # written and checked before a stop, or by another server just now
            state = self._objects.head(row.key)
            if state is None:
                raise ObjectMissingError(f"{row.key} is gone again") from None
            return state

    def _throw_away(self, row: ObjectRow) -> None:
        """Give up an upload, unless another server has made a blob of it."""
        with self._database.writing() as connection:
            doomed = object_rows.doom_received(connection, row.key, self._clock())
        self._forget(row.key)
        if doomed:
            self._objects.delete([*self._piece_keys(row), row.key])
            with self._database.writing() as connection:
                object_rows.forget(connection, (row.key,))

    def _after_others(self, row: ObjectRow) -> tuple[int, ObjectState | None]:
        """Where a blob stands after somebody else interfered."""
        self._forget(row.key)
        with self._database.reading() as connection:
            now = object_rows.row_of_key(connection, row.key)
        if now is not None and now.state == "receiving":
            return self._listed(row).told(row.size_bytes), None
        self._objects.delete(self._piece_keys(row))
        if now is not None and now.state == "live":
            return row.size_bytes, None
        self._objects.delete([row.key])  # given up: it can never be live again
        return 0, None

    def _pieces(self, row: ObjectRow) -> Iterator[bytes]:
        """All bytes of a blob in turn. Raises ObjectMissingError if somebody else took them away."""
        found = sorted(self._objects.keys(row.pieces))
        if _without_gaps(found).end_bytes != row.size_bytes:
            raise ObjectMissingError(f"pieces of {row.key} are gone")
        for key, _ in found:
            yield from self._objects.stream(key)

    def _piece_keys(self, row: ObjectRow) -> list[str]:
        return sorted(key for key, _ in self._objects.keys(row.pieces))

    def _listed(self, row: ObjectRow) -> Progress:
        """How far a blob is, by the pieces that lie in the store."""
        return self._remember(row.key, _without_gaps(self._objects.keys(row.pieces)))

    def _remember(self, key: str, progress: Progress) -> Progress:
        with self._lock:
            if len(self._progress) >= _REMEMBERED:
                self._progress.clear()
            self._progress[key] = progress
        return progress

    def _forget(self, key: str) -> None:
        with self._lock:
            self._progress.pop(key, None)


def _without_gaps(pieces: Iterable[tuple[str, int]]) -> Progress:
    """How far the pieces of a blob go, given their keys and sizes in bytes."""
    progress = Progress()
    for key, size_bytes in sorted(pieces):
        if int(key.rpartition("/")[2]) != progress.end_bytes:
            break
        progress = Progress(progress.end_bytes + size_bytes, progress.end_bytes)
    return progress


def _checked(pieces: Iterable[bytes], row: ObjectRow) -> Iterator[bytes]:
    """The same bytes; raises MapPackageError at their end if they are not those of the row's blob."""
    digest = hashlib.sha256()
    for piece in pieces:
        digest.update(piece)
        yield piece
    if digest.hexdigest() != row.sha256:
        raise _wrong_bytes(row)


def _wrong_bytes(row: ObjectRow) -> MapPackageError:
    return MapPackageError(f"part {row.sha256[:12]} arrived with other bytes than its name says")
