"""Files that the disk keeps from the moment they have a name, whatever happens to the machine."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path


def write_flushed(path: Path, pieces: Iterable[bytes]) -> None:
    """Write a new file that the disk keeps."""
    with path.open("xb") as file:
        for piece in pieces:
            file.write(piece)
        file.flush()
        os.fsync(file.fileno())


def link_flushed(draft: Path, target: Path, root: Path) -> None:
    """Give a file a second name below the folder ``root``, and have the disk keep it.

    Raises:
        FileExistsError: something has that name.
    """
    for attempt in range(10):
        _make_folders(target.parent, root)
        try:
            os.link(draft, target)
            break
        except FileNotFoundError:  # somebody removed the folder, which was empty
            if attempt == 9:
                raise
    _flush_folder(target.parent)


def _make_folders(folder: Path, root: Path) -> None:
    if folder == root or folder.is_dir():
        return
    _make_folders(folder.parent, root)
    folder.mkdir(exist_ok=True)
    _flush_folder(folder.parent)


def _flush_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def delete_with_empty_folder(path: Path) -> None:
    """Delete a file, if it is there, and its folder when that was the last in it."""
    with suppress(FileNotFoundError):
        path.unlink()
    with suppress(OSError):  # it holds more
        path.parent.rmdir()
