"""A store and its catalogue, opened together: what the server and the ``store`` commands work on."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from fleetmap.errors import InputError, StorageError
from fleetmap_server.blobs import Blobs
from fleetmap_server.database import Database
from fleetmap_server.object_store import ObjectStore
from fleetmap_server.settings import ServerSettings

Clock = Callable[[], int]  # UTC nanoseconds since the epoch


@dataclass(frozen=True)
class Storage:
    """Objects, the database that knows what they are, and both together as blobs."""

    objects: ObjectStore
    database: Database
    blobs: Blobs


@contextmanager
def open_storage(settings: ServerSettings, clock: Clock = time.time_ns) -> Iterator[Storage]:
    """The store and catalogue of a server's settings while the block runs; an empty place becomes an empty store.

    Raises:
        InputError: no store, no catalogue, or a bucket without a catalogue.
        StorageError: it cannot be reached or written.
    """
    catalogue_url = settings.catalogue_url
    if settings.store_is_folder:
        _make(Path(settings.store))
    objects = ObjectStore(str(settings.store))
    objects.check()
    with closing(Database(catalogue_url)) as database:
        yield Storage(objects, database, Blobs(objects, database, clock))


def _make(folder: Path) -> None:
    if folder.is_file():
        raise InputError(f"the store '{folder}' is a file; give a folder, or a URL such as s3://BUCKET/PREFIX")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot make the store {folder}: {error.strerror or error}") from error
