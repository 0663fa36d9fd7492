"""Files that are there whole or not at all."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from fleetmap.errors import OutputExistsError, StorageError


@contextmanager
def atomic_path(target: Path) -> Iterator[Path]:
    """A sibling path to write a file or folder at; it becomes ``target`` when the block ends without error.

    An existing target of the same kind is replaced; on an error (also KeyboardInterrupt) it stays as it was and
    the sibling is removed.

    Raises:
        StorageError: the disk is full or refuses.
    """
    draft = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield draft
        _replace(draft, target)
    except OSError as error:
        raise StorageError(f"cannot write {target}: {error.strerror or error}") from error
    finally:
        _remove(draft)


def write_bytes_atomically(target: Path, data: bytes) -> None:
    """Write a file that is there whole or not at all, flushed to the disk."""
    with atomic_path(target) as draft, draft.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def write_text_atomically(target: Path, text: str) -> None:
    """The same for UTF-8 text."""
    write_bytes_atomically(target, text.encode())


def flush_folder(folder: Path) -> None:
    """Have the disk keep which names are in a folder. Raises OSError."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def refuse_existing(target: Path, force: bool) -> None:
    """Raise OutputExistsError if ``target`` is there already and ``force`` is not given."""
    if target.exists() and not force:
        raise OutputExistsError(f"{target} exists already; give another name, or --force to replace it")


def _replace(draft: Path, target: Path) -> None:
    """Rename over; a folder cannot be renamed over a folder, so the old one steps aside first."""
    if not (draft.is_dir() and target.is_dir() and not target.is_symlink()):
        draft.replace(target)  # a file never takes a folder's place: the system refuses
        return
    aside = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.old")
    target.replace(aside)
    try:
        draft.replace(target)
    except OSError:
        aside.replace(target)
        raise
    _remove(aside)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)
