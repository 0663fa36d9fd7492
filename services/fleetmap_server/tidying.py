"""A thread that keeps the store tidy while the server serves."""

from __future__ import annotations

import logging
import random
import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread

from fleetmap.errors import FleetmapError
from fleetmap_server.collection import Collected, collect, retain
from fleetmap_server.library import MapLibrary

_EVERY_S, _FIRST_AFTER_S = 3600.0, 300.0
_CLOSING_S = 3.0

_log = logging.getLogger(__name__)


@contextmanager
def tidying(library: MapLibrary, every_s: float = _EVERY_S) -> Iterator[None]:
    """While the block runs, retire what is not to be kept and delete what nothing refers to, again and again.

    Servers of one store take different moments, so that they do not all look for the same at once.
    """
    stop = Event()
    thread = Thread(target=_tidy, args=(library, every_s, stop), name="tidying", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(_CLOSING_S)  # wherever it is cut off, the next time goes on


def tidy(library: MapLibrary) -> Collected:
    """Do it once. Raises StorageError."""
    database, now_ns = library.storage.database, time.time_ns()
    if library.settings.keep_versions is not None:
        with database.writing() as connection:
            retain(connection, library.settings.keep_versions, now_ns)
    return collect(database, library.storage.objects, now_ns=now_ns)


def _tidy(library: MapLibrary, every_s: float, stop: Event) -> None:
    wait_s = min(every_s, _FIRST_AFTER_S)
    while not stop.wait(wait_s * random.uniform(0.5, 1.0)):
        wait_s = every_s
        try:
            collected = tidy(library)
        except FleetmapError as error:
            _log.warning("the store could not be tidied: %s", error)
        else:
            _log.info("deleted %d objects of %d bytes", collected.objects, collected.bytes)
