"""A worker of the map server's queue: it takes one job after the other, for as long as it is left to."""

from __future__ import annotations

import fcntl
import os
import re
import socket
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager

from fleetmap.errors import RunError, StorageError
from fleetmap.jobs import JobEntry
from fleetmap_cli.mapping_job import Workplace, clear_remains, run_job
from fleetmap_cli.patient_server import PatientServer

_IDLE_S = 2.0  # between two questions whether there is work
_AFTER_GIVING_BACK_S = 30.0  # another worker may be luckier
_FORGET_AFTER_S = 7 * 86_400.0  # recordings that were begun, and nobody came back for


class _StoppedError(Exception):
    """The worker was asked to stop while it waited."""


def run_worker(place: Workplace, stop: threading.Event, *, once: bool = False) -> None:
    """Take jobs and see them through, until ``stop`` is set; with ``once`` one job, or none if there is none.

    A server that is away is waited for.

    Raises:
        RunError: another worker uses the folder.
        StorageError: the folder cannot be written.
        ServerRefusedError: the server does not let us work, for instance without a token.
    """

    def check() -> None:
        if stop.is_set():
            raise _StoppedError

    name = _worker_name()
    with _only_worker(place), PatientServer(place.connect, check) as server:
        clear_remains(place, _FORGET_AFTER_S, time.time())
        try:
            while not stop.is_set():
                job = server.ask(lambda client: client.take_job(name))
                pause_s = _work(job, place, stop)
                if once:
                    return
                stop.wait(pause_s)
        except _StoppedError:
            return


def _work(job: JobEntry | None, place: Workplace, stop: threading.Event) -> float:
    """See a job through if there is one; how long to pause afterwards."""
    if job is None:
        return _IDLE_S
    return _AFTER_GIVING_BACK_S if run_job(job, place, stop) == "given back" else 0.0


def _worker_name() -> str:
    """Who we are, new each time: the machine, the process, and something that nobody else has."""
    machine = re.sub(r"[^A-Za-z0-9._-]", "-", socket.gethostname())[:64]
    return f"{machine}:{os.getpid()}:{uuid.uuid4().hex[:8]}"


@contextmanager
def _only_worker(place: Workplace) -> Iterator[None]:
    """The folder for this process alone."""
    lock = place.folder / "worker.lock"
    try:
        place.folder.mkdir(parents=True, exist_ok=True)
        file = lock.open("w")
    except OSError as error:
        raise StorageError(f"cannot work in {place.folder}: {error.strerror}; give another --folder") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise RunError(f"another worker works in {place.folder}; give each a --folder of its own") from error
        yield
