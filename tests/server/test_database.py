"""The catalogue's database: turns of writers, snapshots of readers, and what is told when it fails."""

from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest
import sqlalchemy as sa

from fleetmap.errors import InputError, StorageError
from fleetmap_server import database as database_module
from fleetmap_server.database import Database


@pytest.fixture
def open_database() -> Iterator:
    with contextlib.ExitStack() as opened:

        def open_one(url: str) -> Database:
            return opened.enter_context(contextlib.closing(Database(url)))

        yield open_one


def put(connection: sa.Connection, name: str, value: object) -> None:
    connection.execute(sa.text("DELETE FROM facts WHERE name = :name"), {"name": name})
    connection.execute(sa.text("INSERT INTO facts VALUES (:name, :value)"), {"name": name, "value": str(value)})


def get(connection: sa.Connection, name: str) -> str | None:
    return connection.execute(sa.text("SELECT value FROM facts WHERE name = :name"), {"name": name}).scalar()


def test_writers_of_several_servers_take_turns(database_url, open_database):
    servers = [open_database(database_url) for _ in range(3)]
    with servers[0].writing() as connection:
        put(connection, "counter", 0)

    def count(server: Database) -> None:
        for _ in range(8):
            with server.writing() as connection:
                put(connection, "counter", int(get(connection, "counter") or 0) + 1)

    threads = [threading.Thread(target=count, args=(server,)) for server in servers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with servers[0].reading() as connection:
        assert get(connection, "counter") == "24"


def test_a_reader_sees_one_moment_and_does_not_wait(database_url, open_database):
    server, other = open_database(database_url), open_database(database_url)
    with server.reading() as reader:
        assert get(reader, "news") is None
        with other.writing() as writer:
            put(writer, "news", 1)
            assert get(reader, "news") is None
        assert get(reader, "news") is None
    with server.reading() as reader:
        assert get(reader, "news") == "1"


def test_nothing_holds_of_a_transaction_that_fails(database_url, open_database):
    server = open_database(database_url)

    def write_and_fail() -> None:
        with server.writing() as connection:
            put(connection, "news", 1)
            raise OSError("the caller's own")

    with pytest.raises(OSError, match="the caller's own"):
        write_and_fail()
    with server.writing() as connection:
        assert get(connection, "news") is None


def test_a_reader_cannot_write_on_postgresql(postgresql, open_database):
    server = open_database(postgresql.new_database())
    with pytest.raises(StorageError, match="read-only transaction"), server.reading() as connection:
        put(connection, "news", 1)


def test_both_kinds_keep_their_identity(database_url, open_database):
    identities = []
    for _ in range(2):
        with open_database(database_url).reading() as connection:
            identities.append(get(connection, "catalogue_id"))
    assert identities[0] == identities[1]
    assert len(identities[0] or "") == 32


KILLED_WRITER = """
import os, signal, sys
import sqlalchemy as sa
from fleetmap_server.database import Database
with Database(sys.argv[1]).writing() as connection:
    connection.execute(sa.text("INSERT INTO facts VALUES ('news', '1')"))
    print("inside", flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_writer_that_is_killed_neither_writes_nor_blocks(database_url, open_database):
    server = open_database(database_url)
    died = subprocess.run([sys.executable, "-c", KILLED_WRITER, database_url], capture_output=True, timeout=60)
    assert (died.returncode, died.stdout) == (-signal.SIGKILL, b"inside\n"), died.stderr
    with server.writing() as connection:
        assert get(connection, "news") is None
        put(connection, "news", 2)


@pytest.mark.parametrize(
    "url",
    ["", "maps", "mysql://localhost/maps", "sqlite://", "sqlite:///", "postgresql://localhost", "postgresql://"],
)
def test_what_is_no_address_of_a_catalogue_is_refused(url):
    with pytest.raises(InputError, match=r"is no catalogue; write sqlite:///FILE or postgresql://"):
        Database(url)


def test_a_file_that_is_no_database_or_another_one_is_refused_and_left_alone(tmp_path):
    text = tmp_path / "text.sqlite"
    text.write_text("something else entirely " * 100)
    with pytest.raises(InputError, match=r"text\.sqlite is no catalogue of maps: file is not a database"):
        Database(f"sqlite:///{text}")
    assert text.read_text() == "something else entirely " * 100
    with contextlib.closing(sa.create_engine(f"sqlite:///{tmp_path / 'other.sqlite'}").raw_connection()) as other:
        other.cursor().execute("CREATE TABLE songs (title TEXT)")
        other.commit()
    with pytest.raises(InputError, match="is no catalogue of maps: it has a table 'songs'"):
        Database(f"sqlite:///{tmp_path / 'other.sqlite'}")


def test_a_folder_that_is_not_there_is_told(tmp_path):
    with pytest.raises(StorageError, match="unable to open database file"):
        Database(f"sqlite:///{tmp_path / 'no' / 'catalogue.sqlite'}")


def test_a_database_that_cannot_be_used_is_told_in_one_line_without_the_password(postgresql):
    at = f"127.0.0.1:{postgresql.port}"
    with pytest.raises(InputError, match='database "nowhere" does not exist') as told:
        Database(f"postgresql://fleetmap:secret@{at}/nowhere")
    assert "secret" not in str(told.value)
    assert "\n" not in str(told.value)
    with pytest.raises(InputError, match='role "nobody" does not exist'):
        Database(f"postgresql://nobody@{at}/postgres")
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        with pytest.raises(StorageError, match=r"Connection refused; is it up\?"):
            Database(f"postgresql://fleetmap@127.0.0.1:{closed.getsockname()[1]}/maps")


def test_a_user_without_rights_is_told(postgresql):
    url = postgresql.new_database()
    name = url.rpartition("/")[2]
    postgresql.execute(f"CREATE ROLE guest_{name} LOGIN")
    with pytest.raises(InputError, match="permission denied for schema public; check its name, the user"):
        Database(url.replace("fleetmap@", f"guest_{name}@"))


def test_a_database_without_postgis_is_told_what_to_install(postgresql):
    url = postgresql.new_database(postgis=False)
    name = url.rpartition("/")[2]
    postgresql.execute(f"CREATE ROLE owner_{name} LOGIN")
    postgresql.execute(f"ALTER DATABASE {name} OWNER TO owner_{name}")
    with pytest.raises(InputError, match="has no PostGIS, and it cannot be switched on"):
        Database(url.replace("fleetmap@", f"owner_{name}@"))


def test_a_connection_that_the_database_ends_fails_one_request_only(postgresql, open_database):
    url = postgresql.new_database()
    server = open_database(url)
    mine = sa.text("SELECT pg_backend_pid()")
    ended: list[int] = []

    def write_until_it_is_ended() -> None:
        with server.writing() as connection:
            put(connection, "news", 1)
            ended.append(connection.execute(mine).scalar_one())
            postgresql.execute(f"SELECT pg_terminate_backend({ended[0]})")
            put(connection, "news", 2)

    with pytest.raises(StorageError, match="is it up"):
        write_until_it_is_ended()
    with server.writing() as connection:
        assert connection.execute(mine).scalar_one() != ended[0]
        assert get(connection, "news") is None


def test_a_writer_does_not_wait_for_ever_for_its_turn(database_url, monkeypatch):
    monkeypatch.setattr(database_module, "_BUSY_S", 0.2)
    with contextlib.closing(Database(database_url)) as one, contextlib.closing(Database(database_url)) as other:
        with one.writing(), pytest.raises(StorageError, match=r"locked|has been writing"), other.writing():
            pytest.fail("two writers at once")
        with other.writing() as connection:
            put(connection, "news", 1)


def test_a_writer_that_falls_silent_loses_its_turn_and_a_reader_may_take_its_time(postgresql, open_database):
    server, other = open_database(url := postgresql.new_database()), open_database(url)
    limits = sa.text(
        "SELECT current_setting('idle_in_transaction_session_timeout'), current_setting('statement_timeout')"
    )
    with server.writing() as connection:
        assert tuple(connection.execute(limits).one()) == ("1min", "1min")
    with server.reading() as connection:
        assert tuple(connection.execute(limits).one()) == ("0", "0")

    def think_too_long() -> None:
        with server.writing() as connection:
            put(connection, "news", 1)
            connection.execute(sa.text("SET LOCAL idle_in_transaction_session_timeout = '1ms'"))
            with other.writing() as waiting:  # comes to its turn when the other has lost it
                put(waiting, "news", 2)
            put(connection, "news", 3)

    with pytest.raises(StorageError, match="is it up"):
        think_too_long()
    with server.reading() as connection:
        assert get(connection, "news") == "2"


def test_a_full_disk_is_told_and_leaves_the_catalogue_as_it_was(tmp_path, open_database):
    server = open_database(f"sqlite:///{tmp_path / 'catalogue.sqlite'}")

    def write_much() -> None:
        with server.writing() as connection:
            connection.execute(sa.text("PRAGMA max_page_count = 60"))  # as if the disk had no more
            for number in range(1000):
                put(connection, f"fact {number}", "x" * 1000)

    with pytest.raises(StorageError, match="database or disk is full"):
        write_much()
    with open_database(f"sqlite:///{tmp_path / 'catalogue.sqlite'}").reading() as connection:
        assert get(connection, "fact 0") is None
