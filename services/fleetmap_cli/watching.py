"""The mapper agent's folder: every drive dropped into it is mapped and published, exactly once.

What became of a drive stands beside it in ``.fleetmap/NAME.json``: ``done``, ``unfit`` (mapped, but its quality
check advises against publishing) or ``failed``, with the reason. A drive without a record is still to be done,
also after a crash in the middle of it. Replace a drive, or delete its record, to have it done again.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Literal

import click

from fleetmap.errors import (
    AccessDeniedError,
    ConflictError,
    FleetmapError,
    InputError,
    RunError,
    ServerUnreachableError,
    StorageError,
    TransferError,
)
from fleetmap.files import write_text_atomically

STATE_FOLDER = ".fleetmap"
LONGEST_PAUSE_S = 300.0
MCAP_MAGIC = b"\x89MCAP0\r\n"

Snapshot = tuple[tuple[str, int, int], ...]  # relative name, size in bytes and time of change in ns of each file

# Not the drive's fault, and likely to pass: the drive keeps its place and is tried again.
_TEMPORARY = (ServerUnreachableError, AccessDeniedError, ConflictError, TransferError, StorageError)


class UnfitMapError(RunError):
    """A map was made, and its own quality check advises against publishing it; str() says why."""

    exit_code = 3


@dataclass(frozen=True)
class DriveRecord:
    """What became of one drive."""

    status: Literal["done", "unfit", "failed"]
    reason: str | None
    sha256: str  # of the drive's files
    files: Snapshot  # as they were when the drive was begun; only a change of these is worth hashing again
    finished_ns: int


def watch_folder(
    folder: Path, map_and_publish: Callable[[Path], None], *, poll_s: float, stop: threading.Event
) -> None:
    """Map and publish every drive that is or comes into ``folder``, until ``stop`` is set.

    Drives are MCAP files and rosbag2 folders that hold one. ``map_and_publish`` raises UnfitMapError for a map
    that should not be published; ServerUnreachableError, TransferError and StorageError are tried again with
    growing pauses; any other error is the drive's own and recorded. Stopping waits for the drive under way.

    Raises:
        InputError: ``folder`` is no folder.
        StorageError: no records can be kept in it.
    """
    watcher = DriveWatcher(folder, map_and_publish, stop)
    pause_s = poll_s
    while not stop.is_set():
        settled = watcher.scan_once()
        pause_s = poll_s if settled else min(2.0 * pause_s, max(LONGEST_PAUSE_S, poll_s))
        stop.wait(pause_s)


class DriveWatcher:
    """What one look at the folder after another has shown."""

    def __init__(self, folder: Path, map_and_publish: Callable[[Path], None], stop: threading.Event) -> None:
        """Raises InputError if there is no such folder, StorageError if it takes no records."""
        if not folder.is_dir():
            raise InputError(f"cannot watch {folder}: there is no such folder")
        try:
            (folder / STATE_FOLDER).mkdir(exist_ok=True)
        except OSError as error:
            raise StorageError(f"cannot keep records in {folder / STATE_FOLDER}: {error.strerror}") from error
        self._folder, self._map_and_publish, self._stop = folder, map_and_publish, stop
        self._last_look: dict[Path, Snapshot] = {}
        self._waiting_for: dict[Path, Snapshot] = {}

    def scan_once(self) -> bool:
        """Handle the drives that have not changed since the look before.

        Returns False if one has to be tried again because the server or the disk is not at hand.
        """
        look = {drive: snapshot for drive in self._drives() if (snapshot := _snapshot(drive))}
        unchanged = [drive for drive in look if self._last_look.get(drive) == look[drive]]
        self._last_look = look
        settled = True
        for drive in unchanged:
            if self._stop.is_set():
                break
            try:
                if self._is_due(drive, look[drive]):
                    self._handle(drive, look[drive])
            except _TEMPORARY as error:
                click.echo(f"{drive.name}: {error}; will be tried again", err=True)
                settled = False
                if isinstance(error, ServerUnreachableError | AccessDeniedError):
                    break  # mapping the other drives now would be work for nothing
        return settled

    def _drives(self) -> list[Path]:
        try:
            entries = sorted(entry for entry in self._folder.iterdir() if not entry.name.startswith("."))
        except OSError as error:
            click.echo(f"cannot look into {self._folder}: {error.strerror}", err=True)
            return []
        return [entry for entry in entries if entry.is_dir() or entry.suffix == ".mcap"]

    def _handle(self, drive: Path, snapshot: Snapshot) -> None:
        """Map and publish one drive, and keep a record of the end it came to."""
        click.echo(f"{drive.name}: begun", err=True)
        sha256 = _sha256(drive, snapshot)
        status: Literal["done", "unfit", "failed"] = "done"
        reason = None
        try:
            self._map_and_publish(drive)
        except _TEMPORARY:
            raise
        except UnfitMapError as error:
            status, reason = "unfit", str(error)
        except FleetmapError as error:
            status, reason = "failed", str(error)
        except Exception as error:  # one drive that meets a defect must not stop the agent
            status, reason = "failed", f"{type(error).__name__}: {error}"
        self._write_record(drive, DriveRecord(status, reason, sha256, snapshot, time.time_ns()))
        click.echo(f"{drive.name}: {status}" + (f": {reason}" if reason else ""), err=True)

    def _is_due(self, drive: Path, snapshot: Snapshot) -> bool:
        record = self._read_record(drive)
        if record is not None and record.files == snapshot:
            return False
        if not self._is_complete(drive, snapshot):
            return False
        if record is None or record.sha256 != _sha256(drive, snapshot):
            return True
        self._write_record(drive, replace(record, files=snapshot))  # copied or touched: the same drive
        return False

    def _is_complete(self, drive: Path, snapshot: Snapshot) -> bool:
        """Whether every file ends as an MCAP does; says once which drive is waited for."""
        lacking = next((why for path in _files(drive) if (why := _lacks_its_end(path))), None)
        if lacking and self._waiting_for.get(drive) != snapshot:
            click.echo(f"{drive.name}: {lacking}; waiting for it", err=True)
            self._waiting_for[drive] = snapshot
        return lacking is None

    def _record_path(self, drive: Path) -> Path:
        return self._folder / STATE_FOLDER / f"{drive.name}.json"

    def _read_record(self, drive: Path) -> DriveRecord | None:
        path = self._record_path(drive)
        try:
            fields = json.loads(path.read_text(encoding="utf-8"))
            files = tuple((str(name), int(size), int(changed_ns)) for name, size, changed_ns in fields["files"])
            return DriveRecord(**{**fields, "files": files})
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, KeyError) as error:
            click.echo(f"record {path} cannot be read, {drive.name} is done again: {error}", err=True)
            return None

    def _write_record(self, drive: Path, record: DriveRecord) -> None:
        write_text_atomically(self._record_path(drive), json.dumps(asdict(record), indent=1) + "\n")


@contextmanager
def stop_on_signals(
    saying: str = "stopping after the drive under way; once more to stop at once",
) -> Iterator[threading.Event]:
    """An event that SIGTERM or SIGINT sets; a second signal interrupts at once. Main thread only."""
    stop = threading.Event()

    def request_stop(_signal: int, _frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        click.echo(saying, err=True)
        # Not from here: the interrupted main thread may hold the event's lock just now.
        threading.Thread(target=stop.set).start()

    previous = {number: signal.signal(number, request_stop) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _files(drive: Path) -> list[Path]:
    """The recording's own files: the MCAP itself, or those of a rosbag2 folder."""
    return sorted(drive.glob("*.mcap")) if drive.is_dir() else [drive]


def _snapshot(drive: Path) -> Snapshot:
    """Names, sizes and times of change; empty where there is no recording (any more)."""
    try:
        states = [(path.name, path.stat()) for path in _files(drive)]
    except OSError:
        return ()
    return tuple((name, state.st_size, state.st_mtime_ns) for name, state in states)


def _lacks_its_end(path: Path) -> str | None:
    """What keeps a file from being a finished MCAP, which both begins and ends with the format's magic."""
    try:
        with path.open("rb") as file:
            if file.seek(0, os.SEEK_END) >= 2 * len(MCAP_MAGIC):
                file.seek(-len(MCAP_MAGIC), os.SEEK_END)
                if file.read() == MCAP_MAGIC:
                    return None
    except OSError as error:
        return f"{path.name} cannot be read ({error.strerror})"
    return "the end of the recording is missing"


def _sha256(drive: Path, snapshot: Snapshot) -> str:
    """One hash of all files of a drive, each preceded by its name and size.

    Raises:
        StorageError: a file cannot be read.
    """
    digest = hashlib.sha256()
    for path, (name, size, _) in zip(_files(drive), snapshot, strict=False):
        digest.update(f"{name}\0{size}\0".encode())
        try:
            with path.open("rb") as file:
                while block := file.read(1 << 20):
                    digest.update(block)
        except OSError as error:
            raise StorageError(f"cannot read {path}: {error.strerror}") from error
    return digest.hexdigest()
