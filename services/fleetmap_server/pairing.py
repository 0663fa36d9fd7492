"""One object store belongs to one catalogue, and says which.

Without that a wrong ``--store`` would look like a store that lost everything, and a collection would take another
catalogue's blobs for rubbish.
"""

from __future__ import annotations

import sqlalchemy as sa

from fleetmap.errors import InputError, StorageError
from fleetmap_server.database import Database
from fleetmap_server.object_store import ObjectExistsError, ObjectMissingError, ObjectStore

MARK = "catalogue-id"
_SAMPLE = 20


def check_pairing(objects: ObjectStore, database: Database) -> None:
    """Mark a new store with its catalogue's identity; an old one must carry it already.

    Raises:
        InputError: the store is another catalogue's, or has nothing of what this one lists.
        StorageError: the store cannot be reached, or not be written.
    """
    objects.check()
    with database.reading() as connection:
        catalogue_id = str(
            connection.execute(sa.text("SELECT value FROM facts WHERE name = 'catalogue_id'")).scalar_one()
        )
        sample = connection.execute(
            sa.text("SELECT key FROM objects WHERE state = 'live' LIMIT :count"), {"count": _SAMPLE}
        ).scalars()
        keys = list(sample)
    marked = _mark_of(objects)
    if marked is None:
        if keys and all(objects.head(key) is None for key in keys):
            raise InputError(
                f"{objects.shown} has nothing of what the catalogue {database.shown} lists; "
                "give the store and the catalogue that belong together"
            )
        try:
            objects.put(MARK, catalogue_id.encode())
            marked = catalogue_id
        except ObjectExistsError:  # another server is opening it as well
            marked = _mark_of(objects)
    if marked != catalogue_id:
        raise InputError(
            f"{objects.shown} is the store of another catalogue than {database.shown}; "
            "give the store and the catalogue that belong together"
        )


def still_paired(objects: ObjectStore) -> None:
    """Raise StorageError if the store has lost its mark: then what is missing may only be out of reach."""
    if _mark_of(objects) is None:
        raise StorageError(f"{objects.shown} is not what it was when it was opened; is it mounted?")


def _mark_of(objects: ObjectStore) -> str | None:
    try:
        return objects.read(MARK, 0, 200).decode(errors="replace")
    except ObjectMissingError:
        return None
