"""Blobs from a map server: in pieces as they come, whole in memory, or straight into a file."""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from fleetmap.errors import RunError, StorageError, TransferError
from fleetmap.files import flush_folder
from fleetmap.transport.link import Parameters, PendingRequest, ServerLink
from fleetmap.transport.protocol import CHUNK
from fleetmap.transport.session import NoAnswerError

_READ_BYTES = 1 << 20

Progress = Callable[[int, int], None]  # bytes done, bytes in total


@dataclass(frozen=True)
class Blob:
    """What to fetch."""

    sha256: str
    size_bytes: int
    version: str | None  # the map version that it belongs to; None for a drive
    shown: str  # for messages, such as "part 0123456789ab of map 'street'"

    def damaged(self, link: ServerLink) -> TransferError:
        """What came is not it."""
        return TransferError(f"{self.shown} arrived damaged from {link.endpoint}")


def download(link: ServerLink, blobs: Sequence[Blob]) -> Iterator[bytes]:
    """Whole blobs in memory, each verified, in their order; while one is worked on the next is under way.

    Raises:
        As ``blob_pieces``; TransferError also if a hash is another.
    """
    pieces = blob_pieces(link, [(blob, 0) for blob in blobs])
    for blob in blobs:
        digest, data, left_bytes = hashlib.sha256(), [], blob.size_bytes
        while left_bytes > 0:
            data.append(next(pieces))
            digest.update(data[-1])
            left_bytes -= len(data[-1])
        if digest.hexdigest() != blob.sha256:
            raise blob.damaged(link)
        yield b"".join(data)


def download_to(
    path: Path, link: ServerLink, blob: Blob, progress: Progress = lambda done_bytes, total_bytes: None
) -> None:
    """A blob of any length into a file, which appears whole, verified and flushed to the disk, or not at all.

    What has come lies beside it in ``.NAME.part``, and a download that was cut goes on from there; if what lay
    there spoils the hash, all is fetched anew.

    Raises:
        RunError: another download is filling the same file.
        StorageError: the disk is full or refuses.
        As ``download`` does; what has come until then is kept.
    """
    draft = path.with_name(f".{path.name}.part")
    with _writing(path), _only_writer(draft, path) as file:
        if os.fstat(file.fileno()).st_size > blob.size_bytes:
            file.truncate(0)
        may_be_spoilt = os.fstat(file.fileno()).st_size > 0
        while not _is_completed(file, link, blob, progress):
            file.truncate(0)
            if not may_be_spoilt:
                draft.unlink()
                raise blob.damaged(link)
            may_be_spoilt = False
        file.flush()
        os.fsync(file.fileno())
        draft.replace(path)
        flush_folder(path.parent)


def blob_pieces(link: ServerLink, wanted: Iterable[tuple[Blob, int]]) -> Iterator[bytes]:
    """The bytes of blobs, each from an offset on, in order; while one piece is worked on the next are under way.

    No piece holds bytes of two blobs.

    Raises:
        ServerRefusedError: the server has no such blob.
        TransferError: the server was away for longer than the link's patience, or sent nothing, or too much.
    """
    requests = _requests(link, wanted)
    window: deque[_Piece] = deque()
    _fill(window, link, requests)
    while window:
        piece = window.popleft()
        try:
            data = piece.request.finish()
        except NoAnswerError as error:
            raise piece.cut_off(link) from error
        if not 0 < len(data) <= piece.length_bytes:
            raise piece.blob.damaged(link)
        if len(data) < piece.length_bytes:  # a server may send less than it was asked for
            rest_bytes = piece.length_bytes - len(data)
            window.appendleft(_ask(link, piece.blob, piece.offset + len(data), rest_bytes))
        _fill(window, link, requests)
        yield data


@dataclass(frozen=True)
class _Piece:
    """A piece of a blob that is under way."""

    blob: Blob
    offset: int
    length_bytes: int
    request: PendingRequest

    def cut_off(self, link: ServerLink) -> TransferError:
        """It does not come any more."""
        done_mb, all_mb = self.offset / 1e6, self.blob.size_bytes / 1e6
        return TransferError(
            f"download of {self.blob.shown} ended at {done_mb:.1f} of {all_mb:.1f} MB: "
            f"map server at {link.endpoint} answers no more; try again when it runs"
        )


def _fill(window: deque[_Piece], link: ServerLink, requests: Iterator[_Piece]) -> None:
    """Ask on until the window is full."""
    while len(window) < link.pace[CHUNK].download_window_chunks and (piece := next(requests, None)):
        window.append(piece)


def _requests(link: ServerLink, wanted: Iterable[tuple[Blob, int]]) -> Iterator[_Piece]:
    """All pieces in order; each is asked for when its turn comes, at the length that suits the link then."""
    for blob, offset in wanted:
        while offset < blob.size_bytes:
            length_bytes = min(link.pace[CHUNK].download_chunk_bytes, blob.size_bytes - offset)
            yield _ask(link, blob, offset, length_bytes)
            offset += length_bytes


def _ask(link: ServerLink, blob: Blob, offset: int, length_bytes: int) -> _Piece:
    place: Parameters = {"sha256": blob.sha256, "offset": offset, "length_bytes": length_bytes}
    if blob.version is not None:
        place = {**place, "version": blob.version}
    return _Piece(blob, offset, length_bytes, link.start(CHUNK, place))


def _is_completed(file: BinaryIO, link: ServerLink, blob: Blob, progress: Progress) -> bool:
    """Fetch what is missing at the file's end; whether the whole has the right hash."""
    digest, done_bytes = hashlib.sha256(), 0
    file.seek(0)
    while earlier := file.read(_READ_BYTES):
        digest.update(earlier)
        done_bytes += len(earlier)
    progress(done_bytes, blob.size_bytes)
    for piece in blob_pieces(link, [(blob, done_bytes)]):
        file.write(piece)
        digest.update(piece)
        progress(done_bytes := done_bytes + len(piece), blob.size_bytes)
    return digest.hexdigest() == blob.sha256


@contextmanager
def _only_writer(draft: Path, path: Path) -> Iterator[BinaryIO]:
    """The draft for this download alone; the lock ends with the process, however it ends."""
    draft.parent.mkdir(parents=True, exist_ok=True)
    with draft.open("a+b") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            is_draft = os.path.samestat(os.fstat(file.fileno()), draft.stat())
        except (BlockingIOError, FileNotFoundError):
            is_draft = False
        if not is_draft:  # locked, or renamed by its owner between opening and locking
            raise RunError(f"another download is writing {path}; wait for it, or give another name")
        yield file


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror or error}") from error
