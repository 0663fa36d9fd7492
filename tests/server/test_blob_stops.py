"""Blobs under stops, races and failing stores: always an upload to go on with, or a live blob."""

from __future__ import annotations

import hashlib
import itertools
import resource
import socket
import socketserver
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from threading import Barrier, Thread
from typing import Self, TypeVar
from urllib.parse import urlsplit

import pytest
from moto.server import ThreadedMotoServer
from sqlalchemy.engine import Connection

from fleetmap.errors import MapPackageError, StorageError
from fleetmap_server import receiving
from fleetmap_server.blobs import Blobs
from fleetmap_server.collection import collect
from fleetmap_server.database import Database
from fleetmap_server.object_store import ObjectState, ObjectStore

PIECES = 3
NEVER = -1

_Item = TypeVar("_Item")


def content(number: int, size_bytes: int = 9000) -> tuple[str, bytes]:
    data = hashlib.shake_128(str(number).encode()).digest(size_bytes)
    return hashlib.sha256(data).hexdigest(), data


def send(blobs: Blobs, name: str, data: bytes, piece_bytes: int | None = None) -> None:
    """Send what is missing of a blob, as a client does."""
    piece_bytes = piece_bytes or len(data) // PIECES
    while (received := blobs.received({name: len(data)})[name]) < len(data):
        while received < len(data):
            received = blobs.append(name, len(data), received, data[received : received + piece_bytes])


def keys_of(objects: ObjectStore) -> list[str]:
    return [key for prefix in ("blobs", "uploads") for key, _ in objects.keys(prefix)]


def collect_all(database: Database, objects: ObjectStore) -> None:
    """Nothing is published or claimed: all goes, whatever was left over."""
    collect(database, objects)
    assert keys_of(objects) == []
    with database.reading() as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM objects").scalar_one() == 0


@pytest.fixture
def moments() -> Moments:
    return Moments()


@pytest.fixture
def database(storage_urls: tuple[str, str]) -> Iterator[Database]:
    with closing(Database(storage_urls[1])) as opened:
        yield opened


@pytest.fixture
def objects(storage_urls: tuple[str, str], database: Database) -> ObjectStore:
    opened = ObjectStore(storage_urls[0])
    Blobs(opened, database)
    return opened


@pytest.fixture
def victim(storage_urls: tuple[str, str], moments: Moments, objects: ObjectStore) -> Iterator[Victim]:
    """A server that dies at a moment of our choice."""
    with closing(WatchedDatabase(storage_urls[1], moments)) as watched:
        yield Victim(WatchedObjectStore(storage_urls[0], moments), watched, moments)


@pytest.mark.parametrize(
    ("piece_bytes", "small_bytes"),
    [(3000, 0), (3000, 10**9), (9000, 10**9)],
    ids=["three pieces streamed", "three pieces in one request", "one piece"],
)
def test_a_stop_at_any_moment_leaves_an_upload_to_go_on_with_or_a_blob(
    victim, objects, database, monkeypatch, small_bytes, piece_bytes
):
    monkeypatch.setattr(receiving, "_SMALL_BYTES", small_bytes)
    for number in victim.moments_to_try(objects):
        name, data = content(number)
        is_through = victim.dies(number, lambda blobs, n=name, d=data: send(blobs, n, d, piece_bytes))
        successor = Blobs(objects, database)
        assert is_through or 0 <= successor.received({name: len(data)})[name] <= len(data)
        send(successor, name, data, piece_bytes)
        assert b"".join(successor.stream(name)) == data
        if is_through:
            break
    assert number > (5 if piece_bytes == 9000 else 15)
    collect_all(database, objects)


def test_a_stop_while_wrong_bytes_are_thrown_away_leaves_nothing_wrong(victim, objects, database):
    def send_wrongly(blobs: Blobs, name: str, data: bytes) -> None:
        with pytest.raises(MapPackageError, match="other bytes than its name says"):
            send(blobs, name, data[:-1] + bytes([data[-1] ^ 1]))

    for number in victim.moments_to_try(objects):
        name, data = content(number)
        is_through = victim.dies(number, lambda blobs, n=name, d=data: send_wrongly(blobs, n, d))
        successor = Blobs(objects, database)
        with suppress(MapPackageError):  # the wrong piece was there already
            send(successor, name, data)
        send(successor, name, data)
        assert b"".join(successor.stream(name)) == data
        if is_through:
            break
    assert number > 15
    collect_all(database, objects)


def test_a_stop_at_any_moment_of_a_collection_leaves_the_rest_to_the_next(victim, objects, database):
    blobs = Blobs(objects, database)
    for number in victim.moments_to_try(objects):
        name, data = content(number)
        send(blobs, name, data)
        begun, begun_data = content(-number)
        blobs.append(begun, len(begun_data), 0, begun_data[:100])
        is_through = victim.dies(number, lambda blobs: collect(victim.database, victim.objects))
        assert not is_through or keys_of(objects) == []
        fresh = Blobs(objects, database)
        for sent, sent_data in ((name, data), (begun, begun_data)):
            send(fresh, sent, sent_data)
            assert b"".join(fresh.stream(sent)) == sent_data
        collect_all(database, objects)
        if is_through:
            break
    assert number > 10


def test_while_one_server_settles_another_may_do_so_at_any_moment(victim, objects, database, monkeypatch):
    monkeypatch.setattr(receiving, "_SMALL_BYTES", 0)
    first, second = Blobs(victim.objects, victim.database), Blobs(objects, database)
    interfered = [0]
    for number in victim.moments_to_try(objects):
        name, data = content(number)
        first.append(name, len(data), 0, data[:6000])

        def interfere(number: int = number, name: str = name, data: bytes = data) -> None:
            interfered.append(number)
            assert second.append(name, len(data), 6000, data[6000:]) == len(data)

        victim.moments.at(number, interfere)
        assert first.append(name, len(data), 6000, data[6000:]) == len(data)
        victim.moments.at(NEVER, stop)
        assert b"".join(second.stream(name)) == b"".join(first.stream(name)) == data
        assert [key.split("/")[2].split(".")[0] for key in keys_of(objects)] == [name]
        collect_all(database, objects)
        if interfered[-1] != number:
            break
    assert number > 8


def test_two_servers_that_receive_the_same_blobs_at_once_end_with_one_of_each(storage_urls, objects, database):
    contents = [content(number, 2000) for number in range(12)]
    start = Barrier(2)

    def serve(served: Database) -> None:
        blobs = Blobs(ObjectStore(storage_urls[0]), served)
        for name, data in contents:
            start.wait(timeout=30)
            send(blobs, name, data)

    with closing(Database(storage_urls[1])) as another, ThreadPoolExecutor(2) as pool:
        for done in [pool.submit(serve, database), pool.submit(serve, another)]:
            done.result(timeout=60)
    names = sorted(key.split("/")[2].split(".")[0] for key in keys_of(objects))
    assert names == sorted(name for name, _ in contents)
    collect_all(database, objects)


def test_a_store_that_is_down_is_told_and_the_upload_goes_on_when_it_is_back(s3_bucket, tmp_path, monkeypatch):
    service = ThreadedMotoServer(
        ip_address="127.0.0.1", port=0, verbose=False
    )  # shares its buckets with the other
    service.start()
    host, port = service.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    objects = ObjectStore(f"s3://{s3_bucket}")
    with closing(Database(f"sqlite:///{tmp_path / 'catalogue.sqlite'}")) as database:
        blobs = Blobs(objects, database)
        name, data = content(1)
        assert blobs.append(name, len(data), 0, data[:5000]) == 5000
        service.stop()
        with pytest.raises(StorageError, match=f"cannot write s3://{s3_bucket}: .*Connection refused"):
            blobs.append(name, len(data), 5000, data[5000:])
        service = ThreadedMotoServer(ip_address="127.0.0.1", port=port, verbose=False)
        service.start()
        assert Blobs(objects, database).received({name: len(data)}) == {name: 5000}
        send(blobs, name, data)
        assert blobs.read(name, 0, len(data)) == data
        assert len(keys_of(objects)) == 1
    service.stop()


def test_a_large_blob_cut_on_its_way_into_the_bucket_is_not_there_and_settles_later(
    s3_bucket, s3_endpoint, tmp_path, monkeypatch
):
    name, data = content(1, 20_000_000)
    with (
        CuttingProxy(s3_endpoint) as proxy,
        closing(Database(f"sqlite:///{tmp_path / 'catalogue.sqlite'}")) as database,
    ):
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.url)
        objects = ObjectStore(f"s3://{s3_bucket}")
        blobs = Blobs(objects, database)
        for start in range(0, 15_000_000, 5_000_000):
            blobs.append(name, len(data), start, data[start : start + 5_000_000])
        proxy.cut_after_bytes = 6_000_000  # the pieces come through, but no part of the whole
        with pytest.raises(StorageError, match="cannot write s3://"):
            blobs.append(name, len(data), 15_000_000, data[15_000_000:])
        assert [key for key, _ in objects.keys("blobs")] == []
        assert blobs.received({name: len(data)}) == {name: 15_000_000}
        proxy.cut_after_bytes = None
        send(blobs, name, data, 5_000_000)
        assert b"".join(blobs.stream(name)) == data
        assert [key.split("/")[0] for key in keys_of(objects)] == ["blobs"]


def test_a_full_disk_is_told_and_the_upload_goes_on_when_there_is_room(tmp_path, monkeypatch):
    monkeypatch.setattr(receiving, "_SMALL_BYTES", 0)
    objects = ObjectStore(str(tmp_path / "store"))
    with closing(Database(f"sqlite:///{tmp_path / 'catalogue.sqlite'}")) as database:
        blobs = Blobs(objects, database)
        name, data = content(1, 6_000_000)
        with files_of_at_most(4_000_000):
            assert blobs.append(name, len(data), 0, data[:3_000_000]) == 3_000_000
            for _ in range(2):
                with pytest.raises(StorageError, match=r"cannot write .*: File too large; free some space"):
                    blobs.append(name, len(data), 3_000_000, data[3_000_000:])
        assert [key for key, _ in objects.keys("blobs")] == []
        assert list((tmp_path / "store" / "drafts").iterdir()) == []
        assert blobs.received({name: len(data)}) == {name: 3_000_000}  # the last piece settles it
        send(blobs, name, data)
        assert b"".join(blobs.stream(name)) == data


def test_a_folder_that_refuses_is_told(tmp_path):
    objects = ObjectStore(str(tmp_path / "store"))
    with closing(Database(f"sqlite:///{tmp_path / 'catalogue.sqlite'}")) as database:
        blobs = Blobs(objects, database)
        (tmp_path / "store" / "uploads").write_text("in the way")
        name, data = content(1)
        with pytest.raises(StorageError, match=r"cannot (write|list) .*: .*(Not a directory|File exists)"):
            blobs.append(name, len(data), 0, data[:10])
        (tmp_path / "store" / "uploads").unlink()
        send(blobs, name, data)
        assert blobs.read(name, 0, len(data)) == data


@contextmanager
def files_of_at_most(size_bytes: int) -> Iterator[None]:
    """The system refuses this process to make a file larger."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


class Stop(BaseException):
    """The process dies here: nothing catches it."""


class Moments:
    """Counts the moments between operations, and acts at one of them."""

    def __init__(self) -> None:
        self._left = -1
        self._action: Callable[[], None] = stop

    def at(self, number: int, action: Callable[[], None]) -> None:
        """Act at the ``number``-th moment from now on, once."""
        self._left, self._action = number, action

    def pass_one(self) -> None:
        self._left -= 1
        if self._left == 0:
            self._action()


def stop() -> None:
    raise Stop


@dataclass(frozen=True)
class Victim:
    """A server's store and database, and the moments at which it may die."""

    objects: ObjectStore
    database: Database
    moments: Moments

    def moments_to_try(self, objects: ObjectStore) -> Iterable[int]:
        """All of them where that is quick."""
        return itertools.count(1) if objects.local_path("any") else itertools.count(1, 9)

    def dies(self, number: int, doing: Callable[[Blobs], object]) -> bool:
        """Do something and die at a moment; True if it was through before."""
        blobs = Blobs(self.objects, self.database)
        self.moments.at(number, stop)
        try:
            doing(blobs)
            return True
        except Stop:
            return False
        finally:
            self.moments.at(NEVER, stop)


class WatchedObjectStore(ObjectStore):
    """A moment before each operation, and amid what is written or listed in turn."""

    def __init__(self, url_or_folder: str, moments: Moments) -> None:
        super().__init__(url_or_folder)
        self._moments = moments

    def put(self, key: str, data: bytes) -> ObjectState:
        self._moments.pass_one()
        return super().put(key, data)

    def put_stream(self, key: str, pieces: Iterable[bytes]) -> ObjectState:
        self._moments.pass_one()
        return super().put_stream(key, self._watched(pieces))

    def read_with_state(self, key: str, offset: int, length: int) -> tuple[bytes, ObjectState]:
        self._moments.pass_one()
        return super().read_with_state(key, offset, length)

    def head(self, key: str) -> ObjectState | None:
        self._moments.pass_one()
        return super().head(key)

    def keys(self, prefix: str) -> Iterator[tuple[str, int]]:
        return self._watched(super().keys(prefix))

    def delete(self, keys: Iterable[str]) -> None:
        for key in keys:
            self._moments.pass_one()
            super().delete([key])

    def _watched(self, items: Iterable[_Item]) -> Iterator[_Item]:
        self._moments.pass_one()
        for item in items:
            yield item
            self._moments.pass_one()


class WatchedDatabase(Database):
    """A moment before each transaction."""

    def __init__(self, url: str, moments: Moments) -> None:
        self._moments = moments
        super().__init__(url)

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        self._moments.pass_one()
        with super().reading() as connection:
            yield connection

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        self._moments.pass_one()
        with super().writing() as connection:
            yield connection


class CuttingProxy:
    """Hands requests through, and cuts connections that have sent more than they may."""

    def __init__(self, endpoint: str) -> None:
        target = urlsplit(endpoint)
        proxy = self
        self.cut_after_bytes: int | None = None

        class Handler(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                with socket.create_connection((target.hostname, target.port)) as upstream:
                    back = Thread(target=proxy.hand_on, args=(upstream, self.request, False))
                    back.start()
                    proxy.hand_on(self.request, upstream, True)
                    back.join()

        self._server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"

    def hand_on(self, source: socket.socket, sink: socket.socket, may_cut: bool) -> None:
        passed = 0
        with suppress(OSError):
            while data := source.recv(1 << 16):
                passed += len(data)
                if may_cut and self.cut_after_bytes is not None and passed > self.cut_after_bytes:
                    break
                sink.sendall(data)
        for end in (source, sink):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def __enter__(self) -> Self:
        Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.05}).start()
        return self

    def __exit__(self, *error: object) -> None:
        self._server.shutdown()
        self._server.server_close()
