"""Blobs, named by their SHA-256: there whole and verified, or not there.

The bytes lie in the object store; the catalogue's database says under which key, and is asked first. So several
servers on one database and one store are one service.
"""

from __future__ import annotations

import hashlib
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import NoReturn, TypeVar

from sqlalchemy.engine import Connection

from fleetmap.errors import MapPackageError
from fleetmap_server import object_rows
from fleetmap_server.database import Database
from fleetmap_server.keyed_lock import KeyedLock
from fleetmap_server.object_rows import ObjectRow
from fleetmap_server.object_store import ObjectMissingError, ObjectState, ObjectStore
from fleetmap_server.pairing import check_pairing, still_paired
from fleetmap_server.problems import DamagedBlobError, NotFoundError
from fleetmap_server.receiving import Accept, Receiver

VERIFIED_UP_TO_BYTES = 64 * 1024 * 1024
"""Larger blobs are not hashed before they are handed out: it would take longer than a client waits."""

_REMEMBERED = 100_000
_T = TypeVar("_T")


@dataclass(frozen=True)
class _LiveBlob:
    """Where a blob lies, and the state of the object whose hash held."""

    key: str
    size_bytes: int
    verified: ObjectState | None = None


class Blobs:
    """The blobs of one object store and one database; safe to use from several threads and processes.

    Raises:
        InputError: the store belongs to another catalogue.
        StorageError: store or database fail.
    """

    def __init__(self, objects: ObjectStore, database: Database, clock: Callable[[], int] = time.time_ns) -> None:
        check_pairing(objects, database)
        self._objects = objects
        self._database = database
        self._clock = clock
        self._receiver = Receiver(objects, database, clock)
        self._appending, self._hashing = KeyedLock(), KeyedLock()
        self._live: OrderedDict[str, _LiveBlob] = OrderedDict()
        self._live_lock = Lock()

    def received(self, sizes: Mapping[str, int]) -> dict[str, int]:
        """How many bytes of each blob are here, from its start; all of them only if it is live."""
        with self._database.reading() as connection:
            rows = object_rows.rows_of_blobs(connection, sizes)
        live = {sha256: sizes[sha256] for sha256, row in rows.items() if row.state == "live"}
        begun = [row for row in rows.values() if row.state == "receiving" and row.size_bytes == sizes[row.sha256]]
        return dict.fromkeys(sizes, 0) | self._receiver.received(begun) | live

    def expect(self, connection: Connection, sizes: Mapping[str, int]) -> None:
        """Prepare to receive many blobs in one transaction; without it each one's first byte costs one."""
        object_rows.expect(connection, sizes, self._clock())

    def missing(self, connection: Connection, sizes: Mapping[str, int]) -> list[str]:
        """Those of some blobs that are not live with their size."""
        rows = object_rows.rows_of_blobs(connection, sizes)
        whole = {
            row.sha256 for row in rows.values() if row.state == "live" and row.size_bytes == sizes[row.sha256]
        }
        return [sha256 for sha256 in sizes if sha256 not in whole]

    def append(self, sha256: str, size_bytes: int, offset: int, data: bytes, accept: Accept | None = None) -> int:
        """Add bytes to a blob if they are the next ones; returns how many are here now.

        With the last bytes it goes live, if its hash holds and ``accept``, which gets its bytes in turn, does not
        raise a FleetmapError; otherwise all of it is thrown away.

        Raises:
            MapPackageError: too many bytes, or the wrong ones.
            StorageError: the store is full or refuses.
        """
        if offset + len(data) > size_bytes:
            raise MapPackageError(f"part {sha256[:12]} ends at {size_bytes} bytes; more were sent")
        with self._appending.held(sha256):
            row = self._row_to_receive(sha256, size_bytes)
            if row.state == "live":
                if row.size_bytes != size_bytes:
                    raise MapPackageError(f"part {sha256[:12]} has {row.size_bytes} bytes, not {size_bytes}")
                return size_bytes
            received, state = self._receiver.take(row, offset, data, accept)
            if state is not None:
                self._remember(sha256, _LiveBlob(row.key, size_bytes, state))
            return received

    def size(self, sha256: str) -> int | None:
        """Size in bytes; None if there is no such blob, or it was lost."""
        try:
            return self._blob(sha256).size_bytes
        except (NotFoundError, DamagedBlobError):
            return None

    def read(self, sha256: str, offset: int, length: int) -> bytes:
        """Bytes of a blob from ``offset`` on, at most ``length``.

        Raises:
            NotFoundError: there is no such blob.
            DamagedBlobError: its bytes are not what its name says.
            StorageError: the store fails.
        """

        def read(blob: _LiveBlob) -> bytes:
            rest = min(length, blob.size_bytes - offset)
            if rest <= 0:
                return b""
            data, state = self._objects.read_with_state(blob.key, offset, rest)
            self._check(sha256, blob, state)
            return data

        return self._on(sha256, read)

    def stream(self, sha256: str, offset: int = 0, length: int | None = None) -> Iterator[bytes]:
        """Bytes of a blob in turn; raises as ``read`` does, before the first of them."""

        def stream(blob: _LiveBlob) -> Iterator[bytes]:
            self._check(sha256, blob, self._state(blob))
            rest = max(blob.size_bytes - offset, 0)
            return self._objects.stream(blob.key, offset, rest if length is None else min(length, rest))

        return self._on(sha256, stream)

    def local_path(self, sha256: str) -> Path | None:
        """The file of a blob, None if the store has no files; raises as ``read`` does."""

        def path(blob: _LiveBlob) -> Path | None:
            self._check(sha256, blob, self._state(blob))
            return self._objects.local_path(blob.key)

        return self._on(sha256, path)

    def verify(self, sha256: str) -> None:
        """Hash a blob, whatever is known of it; raises as ``read`` does."""
        self._on(sha256, lambda blob: self._hash(sha256, blob, self._state(blob)))

    def _row_to_receive(self, sha256: str, size_bytes: int) -> ObjectRow:
        with self._database.reading() as connection:
            row = object_rows.rows_of_blobs(connection, (sha256,)).get(sha256)
        if row is not None and (row.state == "live" or row.size_bytes == size_bytes):
            return row
        with self._database.writing() as connection:
            return object_rows.expect(connection, {sha256: size_bytes}, self._clock())[sha256]

    def _blob(self, sha256: str) -> _LiveBlob:
        """Where a blob lies. Raises NotFoundError; DamagedBlobError if something published needs it."""
        known = self._live.get(sha256)
        if known is not None:
            return known
        with self._database.reading() as connection:
            row = object_rows.rows_of_blobs(connection, (sha256,)).get(sha256)
            is_needed = (row is None or row.state != "live") and object_rows.is_referenced(connection, sha256)
        if is_needed:
            raise _no_good(sha256, "lost")
        if row is None or row.state != "live":
            raise NotFoundError(f"the server has no data named {sha256}")
        return self._remember(sha256, _LiveBlob(row.key, row.size_bytes))

    def _on(self, sha256: str, action: Callable[[_LiveBlob], _T]) -> _T:
        """Do something with a blob; where its object is gone, with the one that took its place."""
        blob = self._blob(sha256)
        while True:
            try:
                return action(blob)
            except ObjectMissingError:
                self._forget(sha256)
                successor = self._blob(sha256)
                if successor.key == blob.key:
                    still_paired(self._objects)
                    self._condemn(sha256, blob, "lost")
                blob = successor

    def _state(self, blob: _LiveBlob) -> ObjectState:
        state = self._objects.head(blob.key)
        if state is None:
            raise ObjectMissingError(f"{blob.key} is not there")
        return state

    def _check(self, sha256: str, blob: _LiveBlob, state: ObjectState) -> None:
        """Hash a blob unless that was done in this state of its object, or it is too large for that."""
        if blob.size_bytes > VERIFIED_UP_TO_BYTES or blob.verified == state:
            return
        with self._hashing.held(sha256):
            if self._blob(sha256).verified != state:
                self._hash(sha256, blob, state)

    def _hash(self, sha256: str, blob: _LiveBlob, state: ObjectState) -> None:
        digest = hashlib.sha256()
        for piece in self._objects.stream(blob.key):
            digest.update(piece)
        if digest.hexdigest() != sha256:
            self._condemn(sha256, blob, "damaged")
        self._remember(sha256, replace(blob, verified=state))

    def _condemn(self, sha256: str, blob: _LiveBlob, what: str) -> NoReturn:
        """Say that a blob is no good, so that it is asked for when its map is published again."""
        with self._database.writing() as connection:
            object_rows.doom(connection, (blob.key,), self._clock())
        self._forget(sha256)
        raise _no_good(sha256, what)

    def _remember(self, sha256: str, blob: _LiveBlob) -> _LiveBlob:
        with self._live_lock:
            self._live[sha256] = blob
            self._live.move_to_end(sha256)
            if len(self._live) > _REMEMBERED:
                self._live.popitem(last=False)
        return blob

    def _forget(self, sha256: str) -> None:
        with self._live_lock:
            self._live.pop(sha256, None)


def _no_good(sha256: str, what: str) -> DamagedBlobError:
    return DamagedBlobError(f"stored part {sha256[:12]} is {what}; publish its map again to repair it")
