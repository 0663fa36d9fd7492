"""The catalogue's schema, one numbered step after the other; a newer one than this fleetmap knows is refused.

The tables:

``versions``  every version a map ever had, numbered from 1 in each map; ``is_latest`` marks the one that counts.
              ``predecessor`` is the version that was the latest when it came, ``outline`` its trajectory as WKB.
``parts``     what blobs a version's manifest names.
``drives``    recordings that were uploaded, with what is known of them.
``objects``   what lies in the object store under which key: being received, live, or doomed to be deleted.
``uploads``   transfers under way; what they count on stands in ``claims`` and is not collected.
``jobs``      drives to be mapped: who is at it, until when, how far.
``facts``     single values, such as the identity of this catalogue.

Boxes (west, south, east, north in degrees; west > east crosses 180 degrees) of latest versions and of drives are
indexed in ``map_boxes`` and ``drive_boxes``: an R*Tree in SQLite, which has one row more for a box that crosses
180 degrees, a GiST index over PostGIS polygons in PostgreSQL. SQLite's keeps single precision, rounded outwards,
so what it finds is checked again.
"""

from __future__ import annotations

import uuid
from pathlib import Path

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from fleetmap.errors import InputError
from fleetmap_server.carry_over import carry_over

SCHEMA_VERSION = 2


def migrate(connection: Connection, dialect: str, shown: str) -> None:
    """Bring a database to the present schema, inside the caller's transaction.

    Raises:
        InputError: a newer fleetmap wrote it, something else did, or PostgreSQL lacks PostGIS.
    """
    found = _schema_of(connection, dialect)
    if found > SCHEMA_VERSION:
        raise InputError(
            f"{shown} was written by a newer fleetmap (schema {found}, this one reads {SCHEMA_VERSION}); "
            "upgrade fleetmap or give another catalogue"
        )
    if found == 0 and dialect == "sqlite":
        _need_an_empty_file(connection, shown)
    if found < 2:
        _to_schema_2(connection, dialect, found, shown)
    if found < SCHEMA_VERSION:
        _set_schema(connection, dialect)


def _schema_of(connection: Connection, dialect: str) -> int:
    if dialect == "sqlite":
        return int(connection.execute(sa.text("PRAGMA user_version")).scalar_one())
    if connection.execute(sa.text("SELECT to_regclass('fleetmap_schema')")).scalar_one() is None:
        return 0
    return int(connection.execute(sa.text("SELECT version FROM fleetmap_schema")).scalar_one())


def _set_schema(connection: Connection, dialect: str) -> None:
    if dialect == "sqlite":
        connection.execute(sa.text(f"PRAGMA user_version = {SCHEMA_VERSION}"))
        return
    connection.execute(sa.text("CREATE TABLE IF NOT EXISTS fleetmap_schema (version INTEGER NOT NULL)"))
    connection.execute(sa.text("DELETE FROM fleetmap_schema"))
    connection.execute(sa.text("INSERT INTO fleetmap_schema VALUES (:version)"), {"version": SCHEMA_VERSION})


def _to_schema_2(connection: Connection, dialect: str, found: int, shown: str) -> None:
    """From nothing, or from the one-file catalogue that came before (schema 1, SQLite only)."""
    if found == 1:
        connection.execute(sa.text("DROP VIEW latest"))
        for table in ("versions", "parts"):
            connection.execute(sa.text(f"ALTER TABLE {table} RENAME TO {table}_1"))
        connection.execute(sa.text("DROP INDEX versions_of_map"))
    if dialect == "postgresql":
        _need_postgis(connection, shown)
    for statement in (_TABLES_2.format(**_TYPES_2[dialect]) + _BOXES_2[dialect]).split(";"):
        if statement.strip():
            connection.execute(sa.text(statement))
    connection.execute(sa.text("INSERT INTO facts VALUES ('catalogue_id', :value)"), {"value": uuid.uuid4().hex})
    if found == 1:
        carry_over(connection, Path(str(connection.engine.url.database)).parent / "blobs")


def _need_an_empty_file(connection: Connection, shown: str) -> None:
    other = connection.execute(sa.text("SELECT name FROM sqlite_master LIMIT 1")).scalar()
    if other is not None:
        raise InputError(f"{shown} is no catalogue of maps: it has a table '{other}'; give another")


def _need_postgis(connection: Connection, shown: str) -> None:
    try:
        with connection.begin_nested():
            connection.execute(sa.text("CREATE EXTENSION IF NOT EXISTS postgis"))
    except sa.exc.DBAPIError as error:
        raise InputError(
            f"{shown} has no PostGIS, and it cannot be switched on: install it on the database's machine, and "
            "have an administrator run CREATE EXTENSION postgis"
        ) from error


_TYPES_2 = {
    "sqlite": {"serial": "INTEGER PRIMARY KEY AUTOINCREMENT", "text": "TEXT", "bytes": "BLOB"},
    "postgresql": {"serial": "BIGSERIAL PRIMARY KEY", "text": 'TEXT COLLATE "C"', "bytes": "BYTEA"},
}

_BOX_2 = """
    west DOUBLE PRECISION{null}, south DOUBLE PRECISION{null},
    east DOUBLE PRECISION{null}, north DOUBLE PRECISION{null}
"""

# A page in some order is read from the order's index alone, boxes and times too, until it is full.
_SEARCHED_2 = "west, south, east, north, start_ns, end_ns"
_ORDERS_2 = "".join(
    f"CREATE INDEX maps_by_{column} ON versions ({key}, {_SEARCHED_2}) WHERE is_latest = 1;\n"
    for column, key in {
        "id": "map_id",
        "published": "published_ns, map_id",
        "start": "start_ns, map_id",
        "length": "length_m, map_id",
        "landmarks": "landmarks, map_id",
        "size": "size_bytes, map_id",
    }.items()
)

_TABLES_2 = f"""
CREATE TABLE facts (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE versions (
    serial {{serial}},
    map_id {{text}} NOT NULL,
    number INTEGER NOT NULL,
    version TEXT NOT NULL,
    predecessor TEXT,
    origin TEXT NOT NULL CHECK (origin IN ('published', 'rollback')),
    published_ns BIGINT NOT NULL,
    manifest_bytes BIGINT NOT NULL,
    start_ns BIGINT NOT NULL, end_ns BIGINT NOT NULL, {_BOX_2.format(null=" NOT NULL")},
    length_m DOUBLE PRECISION NOT NULL, landmarks BIGINT NOT NULL, size_bytes BIGINT NOT NULL,
    is_latest INTEGER NOT NULL,
    retired_ns BIGINT,
    outline {{bytes}} NOT NULL,
    entry TEXT NOT NULL,
    UNIQUE (map_id, number)
);
CREATE UNIQUE INDEX latest_of_map ON versions (map_id) WHERE is_latest = 1;
{_ORDERS_2}
CREATE INDEX versions_by_hash ON versions (version);
CREATE TABLE parts (
    version TEXT NOT NULL,
    sha256 TEXT NOT NULL,
    size_bytes BIGINT NOT NULL,
    kind TEXT NOT NULL,
    cell_east INTEGER, cell_north INTEGER,
    PRIMARY KEY (version, sha256)
);
CREATE INDEX versions_of_part ON parts (sha256);
CREATE TABLE drives (
    serial {{serial}},
    sha256 {{text}} NOT NULL UNIQUE,
    name TEXT NOT NULL,
    size_bytes BIGINT NOT NULL,
    received_ns BIGINT NOT NULL,
    start_ns BIGINT, end_ns BIGINT, {_BOX_2.format(null="")},
    summary TEXT,
    retired_ns BIGINT
);
CREATE INDEX newest_drives ON drives (received_ns, sha256);
CREATE TABLE objects (
    key TEXT PRIMARY KEY,
    sha256 TEXT NOT NULL,
    size_bytes BIGINT NOT NULL,
    state TEXT NOT NULL CHECK (state IN ('receiving', 'live', 'doomed')),
    touched_ns BIGINT NOT NULL
);
CREATE UNIQUE INDEX receiving_objects ON objects (sha256) WHERE state = 'receiving';
CREATE UNIQUE INDEX live_objects ON objects (sha256) WHERE state = 'live';
CREATE INDEX objects_by_state ON objects (state, touched_ns);
CREATE TABLE uploads (
    upload TEXT PRIMARY KEY,
    kind TEXT NOT NULL CHECK (kind IN ('map', 'drive', 'backup')),
    name TEXT NOT NULL,
    size_bytes BIGINT NOT NULL,
    touched_ns BIGINT NOT NULL
);
CREATE TABLE claims (
    upload TEXT NOT NULL REFERENCES uploads (upload) ON DELETE CASCADE,
    sha256 TEXT NOT NULL,
    PRIMARY KEY (upload, sha256)
);
CREATE INDEX claims_on_blob ON claims (sha256);
CREATE TABLE jobs (
    job_id TEXT PRIMARY KEY,
    drive TEXT NOT NULL REFERENCES drives (sha256),
    map_id TEXT NOT NULL,
    state TEXT NOT NULL CHECK (state IN ('queued', 'running', 'done', 'failed', 'cancelled')),
    stage TEXT NOT NULL,
    percent INTEGER NOT NULL,
    reason TEXT NOT NULL,
    attempts INTEGER NOT NULL,
    fence BIGINT NOT NULL,
    worker TEXT NOT NULL,
    lease_until_ns BIGINT NOT NULL,
    cancel_requested INTEGER NOT NULL,
    version TEXT,
    created_ns BIGINT NOT NULL,
    updated_ns BIGINT NOT NULL
);
CREATE UNIQUE INDEX open_job_of_drive ON jobs (drive, map_id) WHERE state IN ('queued', 'running');
CREATE INDEX jobs_in_turn ON jobs (state, created_ns);
CREATE INDEX newest_jobs ON jobs (created_ns, job_id);
CREATE INDEX jobs_of_drive ON jobs (drive, created_ns)
"""

_BOXES_2 = {
    "sqlite": """;
        CREATE VIRTUAL TABLE map_boxes USING rtree(id, west, east, south, north, +serial INTEGER);
        CREATE VIRTUAL TABLE drive_boxes USING rtree(id, west, east, south, north, +serial INTEGER)
    """,
    "postgresql": """;
        CREATE TABLE map_boxes (
            serial BIGINT PRIMARY KEY REFERENCES versions (serial) ON DELETE CASCADE,
            box geometry(MultiPolygon, 4326) NOT NULL
        );
        CREATE INDEX map_boxes_by_place ON map_boxes USING gist (box);
        CREATE TABLE drive_boxes (
            serial BIGINT PRIMARY KEY REFERENCES drives (serial) ON DELETE CASCADE,
            box geometry(MultiPolygon, 4326) NOT NULL
        );
        CREATE INDEX drive_boxes_by_place ON drive_boxes USING gist (box)
    """,
}
