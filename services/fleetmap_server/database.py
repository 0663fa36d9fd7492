"""The catalogue's database, SQLite or PostgreSQL with PostGIS: one way of reading, one way of writing.

Writers take turns: of all processes on one database only one is inside ``writing()`` at a time (SQLite's
``BEGIN IMMEDIATE``, an advisory lock of PostgreSQL). A map catalogue is written rarely and read often, and what
need not be thought about in pairs cannot go wrong in pairs. Readers never wait and see one snapshot.
"""

from __future__ import annotations

import socket
import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Literal, get_args

import pg8000.dbapi
import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.engine import URL, Connection, Engine, make_url

from fleetmap.errors import FleetmapError, InputError, StorageError
from fleetmap_server.migrations import migrate

Dialect = Literal["sqlite", "postgresql"]

_WRITER_LOCK = 7_140_447_310_331_001  # any number that nobody else takes in this database
_BUSY_S = 30.0  # how long a writer waits for its turn
_CONNECT_S = 10.0
_SILENT_WRITER_S = 60.0  # so long a writer may think, or a statement of it take, before it loses its turn
_CONNECTIONS = 16


class Database:
    """An open database whose schema is the one this fleetmap writes; safe to use from several threads.

    Args:
        url: ``sqlite:///FILE`` or ``postgresql://USER:PASSWORD@HOST/NAME``.

    Raises:
        InputError: no such kind of database, no catalogue, or one that a newer fleetmap wrote.
        StorageError: it cannot be reached, or not be written.
    """

    def __init__(self, url: str) -> None:
        parsed = _parse(url)
        self.shown = _shown(parsed)
        self.dialect: Dialect = "sqlite" if parsed.drivername == "sqlite" else "postgresql"
        self._engine = _engine(parsed, self.dialect)
        try:
            with self.writing() as connection:
                migrate(connection, self.dialect, self.shown)
        except BaseException:
            self.close()
            raise

    @property
    def file(self) -> Path | None:
        """The file of an SQLite database."""
        return Path(str(self._engine.url.database)) if self.dialect == "sqlite" else None

    def close(self) -> None:
        """Let go of all connections."""
        self._engine.dispose()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """One snapshot of everything; raises StorageError if the database fails."""
        with self._errors(), self._engine.connect() as connection:
            connection.execute(sa.text("BEGIN" if self.dialect == "sqlite" else _READ_SNAPSHOT))
            try:
                yield connection
            finally:
                connection.rollback()

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """A transaction alone with the database; after an error nothing of it holds. Raises as ``reading``."""
        with self._errors(), self._engine.connect() as connection:
            if self.dialect == "sqlite":
                connection.execute(sa.text("BEGIN IMMEDIATE"))
            else:
                connection.execute(sa.text(_TAKE_TURN))
            try:
                yield connection
                connection.commit()
            except BaseException:
                connection.rollback()
                raise

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sa.exc.IntegrityError:
            raise  # the mistake is ours
        except sa.exc.SQLAlchemyError as error:
            raise _told(self.shown, error) from error


def _told(shown: str, error: sa.exc.SQLAlchemyError) -> FleetmapError:
    """What went wrong, in one line."""
    code, reason = _code(error), _reason(error)
    if code.startswith(("28", "3D")) or code == "42501":
        return InputError(f"{shown} cannot be used: {reason}; check its name, the user and the user's rights")
    if code.startswith("42") or (not code and not isinstance(error, _FAILURES)):
        return InputError(f"{shown} is no catalogue of maps: {reason}; give another")
    if code.startswith("22"):
        return InputError(f"no catalogue can hold such a value: {reason}")
    if code == _LOCK_TIMEOUT:
        return StorageError(f"{shown}: another server has been writing for {_BUSY_S:.0f} s; try again")
    return StorageError(f"{shown}: {reason}; is it up, with room and permission?")


_LOCK_TIMEOUT = "55P03"
_FAILURES = (sa.exc.OperationalError, sa.exc.InterfaceError, sa.exc.InternalError, sa.exc.TimeoutError)
_TAKE_TURN = f"""
SELECT pg_advisory_xact_lock({_WRITER_LOCK}),
    set_config('idle_in_transaction_session_timeout', '{_SILENT_WRITER_S:.0f}s', true),
    set_config('statement_timeout', '{_SILENT_WRITER_S:.0f}s', true)
"""
_READ_SNAPSHOT = "SET TRANSACTION ISOLATION LEVEL REPEATABLE READ READ ONLY"


def _parse(url: str) -> URL:
    try:
        parsed = make_url(url)
    except sa.exc.ArgumentError:
        parsed = None
    if parsed is None or parsed.drivername not in get_args(Dialect) or not parsed.database:
        raise InputError(
            f"'{url}' is no catalogue; write sqlite:///FILE or postgresql://USER:PASSWORD@HOST:5432/DATABASE"
        )
    return parsed


def _shown(url: URL) -> str:
    return str(url.database) if url.drivername == "sqlite" else url.render_as_string(hide_password=True)


def _engine(url: URL, dialect: Dialect) -> Engine:
    return _sqlite_engine(url) if dialect == "sqlite" else _postgresql_engine(url)


def _sqlite_engine(url: URL) -> Engine:
    engine = sa.create_engine(
        url.set(drivername="sqlite+pysqlite"),
        poolclass=sa.pool.QueuePool,
        pool_size=_CONNECTIONS,
        connect_args={"check_same_thread": False, "isolation_level": None, "timeout": _BUSY_S},
    )

    @event.listens_for(engine, "connect")
    def prepare(connection: sqlite3.Connection, record: object) -> None:
        for pragma in ("journal_mode = WAL", "synchronous = FULL", "foreign_keys = ON", "cache_size = -16000"):
            connection.execute(f"PRAGMA {pragma}").close()

    return engine


# PostgreSQL finds out within a minute that a client's machine is gone.
_KEEPALIVE = {"tcp_keepalives_idle": "30", "tcp_keepalives_interval": "10", "tcp_keepalives_count": "3"}


def _postgresql_engine(url: URL) -> Engine:
    """Nobody waits for ever: neither for a machine that is gone, nor for one that died while it wrote."""
    settings = {"lock_timeout": f"{1000 * _BUSY_S:.0f}", **_KEEPALIVE}
    engine = sa.create_engine(
        url.set(drivername="postgresql+pg8000"),
        pool_size=_CONNECTIONS,
        pool_pre_ping=True,
        connect_args={"startup_params": settings},
    )

    @event.listens_for(engine, "do_connect")
    def connect(
        dialect: object, record: object, arguments: object, options: dict[str, Any]
    ) -> pg8000.dbapi.Connection:
        with ExitStack() as opened:
            try:
                stream = socket.create_connection((url.host or "localhost", url.port or 5432), _CONNECT_S)
                opened.callback(stream.close)
                stream.settimeout(3 * _BUSY_S)
                stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                connection = pg8000.dbapi.connect(**options, sock=stream)
            except OSError as error:
                raise StorageError(f"{_shown(url)}: {error.strerror or error}; is it up?") from error
            opened.pop_all()
            return connection

    return engine


def _code(error: sa.exc.SQLAlchemyError) -> str:
    """SQLSTATE, where PostgreSQL gives one."""
    details = _details(error)
    return str(details.get("C", "")) if isinstance(details, dict) else ""


def _reason(error: sa.exc.SQLAlchemyError) -> str:
    """The database's own words, in one line."""
    details = _details(error)
    return " ".join(str(details.get("M", details) if isinstance(details, dict) else details).split())


def _details(error: sa.exc.SQLAlchemyError) -> object:
    """A message, or the fields that pg8000 makes of PostgreSQL's."""
    cause = error.orig if isinstance(error, sa.exc.DBAPIError) else error
    return cause.args[0] if cause is not None and cause.args else error
