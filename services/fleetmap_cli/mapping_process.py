"""Checking and mapping one drive in a process of its own, which can be stopped at any instant.

The mapper's solver does not let other threads run while it works, so whoever must answer a server in the meantime
has to be another process. The child dies with its parent, however that ends.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

from fleetmap.errors import FleetmapError, StorageError
from fleetmap.jobs import DriveSummary
from fleetmap_mapper.settings import MapperSettings

_TELL_EVERY_S = 0.2
_PR_SET_PDEATHSIG = 1  # prctl(2)


@dataclass(frozen=True)
class MappingTask:
    """What to map, and where the package goes."""

    recording: Path
    drive_name: str  # as the manifest is to name it
    output: Path
    map_id: str
    settings: MapperSettings


@dataclass(frozen=True)
class Stage:
    """How far the child is: ``done`` of ``total`` steps of a stage."""

    name: str
    done: int
    total: int

    @property
    def percent(self) -> int:
        """0 to 100."""
        return min(100, 100 * self.done // self.total) if self.total > 0 else 0


@dataclass(frozen=True)
class Checked:
    """What the full check of the recording found; unless the verdict is "no", mapping follows."""

    summary: DriveSummary


@dataclass(frozen=True)
class Mapped:
    """The package is written."""


@dataclass(frozen=True)
class Failed:
    """The end without a map."""

    reason: str
    is_own_fault: bool  # of this machine (its disk is full), not of the drive


Message = Stage | Checked | Mapped | Failed


@contextmanager
def mapping_process(task: MappingTask) -> Iterator[MappingProcess]:
    """A child at work on a task; it is killed when the block ends before it does."""
    context = multiprocessing.get_context("spawn")  # a fork would copy our threads' locks as they just are
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=_run, args=(task, theirs, os.getpid()), name="mapping", daemon=True)
    child.start()
    theirs.close()
    try:
        yield MappingProcess(child, ours)
    finally:
        child.kill()
        child.join()
        child.close()
        ours.close()


class MappingProcess:
    """What is to be heard of the child."""

    def __init__(self, child: BaseProcess, pipe: Connection) -> None:
        self._child, self._pipe = child, pipe

    @property
    def pid(self) -> int:
        """The process."""
        assert self._child.pid is not None
        return self._child.pid

    def next_message(self, timeout_s: float) -> Message | None:
        """The next message, or None if there is none within ``timeout_s``. A dead child has ``Failed``."""
        if not connection.wait([self._pipe], timeout_s):
            return None
        try:
            message: Message = self._pipe.recv()
        except (EOFError, OSError):
            self._child.join()
            return Failed(_death(self._child.exitcode), is_own_fault=False)
        return message


def _death(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        reason = f"was killed by {signal.Signals(-exit_code).name}; is there enough memory?"
    else:
        reason = f"ended with exit code {exit_code}"
    return f"the process that mapped the drive {reason}"


def _run(task: MappingTask, pipe: Connection, parent: int) -> None:
    """The child."""
    for number in (signal.SIGINT, signal.SIGTERM):  # sent to a whole group; the parent decides
        signal.signal(number, signal.SIG_IGN)
    _die_with(parent)
    try:
        _check_and_map(task, pipe.send)
    except StorageError as error:
        pipe.send(Failed(str(error), is_own_fault=True))
    except FleetmapError as error:
        pipe.send(Failed(str(error), is_own_fault=False))
    except Exception as error:  # a drive that meets a defect must not stop the worker
        traceback.print_exc()
        pipe.send(Failed(f"{type(error).__name__}: {error}", is_own_fault=False))


def _check_and_map(task: MappingTask, tell: Callable[[Message], None]) -> None:
    from fleetmap_cli.drive_summary import summarise_drive  # here, so that the parent starts quickly
    from fleetmap_cli.mapping import DriveChoice, map_recording

    progress = _Throttled(tell)
    summary = summarise_drive(task.recording, progress)
    tell(Checked(summary))
    if summary.verdict == "no":
        return
    map_recording(
        task.recording,
        task.output,
        settings=task.settings,
        choice=DriveChoice(),
        map_id=task.map_id,
        drive_name=task.drive_name,
        progress=progress,
        force=True,
    )
    tell(Mapped())


class _Throttled:
    """Progress that is told often enough for the eye, and not for every image."""

    def __init__(self, tell: Callable[[Message], None]) -> None:
        self._tell, self._stage, self._told_s = tell, "", 0.0

    def __call__(self, stage: str, done: int, total: int) -> None:
        now_s = time.monotonic()
        if stage != self._stage or now_s - self._told_s >= _TELL_EVERY_S:
            self._stage, self._told_s = stage, now_s
            self._tell(Stage(stage, done, total))


def _die_with(parent: int) -> None:
    """Have this process end when its parent does, also while compiled code lets no thread run."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it was gone before
            os._exit(1)
    watched = multiprocessing.parent_process()
    assert watched is not None

    def wait_and_end() -> None:
        watched.join()
        os._exit(1)

    threading.Thread(target=wait_and_end, daemon=True).start()
