"""Publishers, two servers and two collectors at once, in any order of their steps: nothing needed is ever lost."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import hypothesis.strategies as st
import pytest
import sqlalchemy as sa
from hypothesis import Phase, given, settings
from sqlalchemy.engine import Connection

from fleetmap_server import receiving, uploads
from fleetmap_server.blobs import Blobs
from fleetmap_server.catalogue import Catalogue
from fleetmap_server.collection import (
    collect,
    delete_unwanted,
    doom_unreferenced,
    doomed_keys,
    forget_deleted,
    retain,
)
from fleetmap_server.database import Database
from fleetmap_server.object_store import ObjectStore

DAY_NS = 86_400 * 1_000_000_000
ABANDONED_NS = 7 * DAY_NS
MAPS, SERVERS, COLLECTORS, COLLECTION_STEPS = 4, 2, 2, 5
PIECES = 2


@dataclass(frozen=True)
class Step:
    what: str
    number: int  # of a map
    server: int
    times: int
    meanwhile: str
    before: str  # this kind of operation
    after: int  # so many of them
    other: int  # map
    collector: int


STEPS = st.builds(
    Step,
    what=st.sampled_from(
        ["send"] * 5
        + ["publish"] * 2
        + ["collect"] * 4
        + ["commit", "retire", "keep one version", "a week passes", "restart"]
    ),
    number=st.integers(0, MAPS - 1),
    server=st.integers(0, SERVERS - 1),
    times=st.integers(1, 6),
    meanwhile=st.sampled_from(["begin", "send", "commit", "retire", "die", "collect", "collect"]),
    before=st.sampled_from(["", "writing", "put", "delete", "keys"]),
    after=st.integers(0, 5),
    other=st.integers(0, MAPS - 1),
    collector=st.integers(0, COLLECTORS - 1),
)


class Died(BaseException):
    """A server or collector was killed."""


class Interruption:
    """Somebody else does something before one of the operations of store and database, once."""

    def __init__(self) -> None:
        self.meanwhile: Callable[[], None] | None = None

    def set(self, before: str, after: int, meanwhile: Callable[[], None]) -> None:
        """Have something done before an operation of a kind, or of any kind, when so many have passed."""
        self._before, self._left, self.meanwhile = before, after, meanwhile

    def pass_one(self, kind: str) -> None:
        if self.meanwhile is None or not kind.startswith(self._before):
            return
        self._left -= 1
        if self._left < 0:
            action, self.meanwhile = self.meanwhile, None
            action()


class InterruptedDatabase(Database):
    def __init__(self, url: str, interruption: Interruption) -> None:
        self._interruption = interruption
        super().__init__(url)

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        self._interruption.pass_one("reading")
        with super().reading() as connection:
            yield connection

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        self._interruption.pass_one("writing")
        with super().writing() as connection:
            yield connection


class InterruptedObjectStore(ObjectStore):
    def __init__(self, url: str, interruption: Interruption) -> None:
        self._interruption = interruption
        super().__init__(url)


def _interrupted(name: str) -> Callable[..., Any]:
    def operation(self: InterruptedObjectStore, *arguments: Any, **options: Any) -> Any:
        self._interruption.pass_one(name)
        return getattr(ObjectStore, name)(self, *arguments, **options)

    return operation


for _name in ("put", "put_stream", "read_with_state", "head", "keys", "delete"):
    setattr(InterruptedObjectStore, _name, _interrupted(_name))


class Fleet:
    """The model knows what each upload was told to be here; the real thing must have it."""

    def __init__(self, folder: str, maps: tuple[Any, ...]) -> None:
        self.maps = maps
        self.now_ns = 1_800_000_000_000_000_000
        self.other = Interruption()
        url = f"sqlite:///{Path(folder) / 'catalogue.sqlite'}"
        self.database = InterruptedDatabase(url, self.other)
        self.objects = InterruptedObjectStore(str(Path(folder) / "store"), self.other)
        self.catalogue = Catalogue(self.database, self.clock)
        self.servers = [Blobs(self.objects, self.database, self.clock) for _ in range(SERVERS + 1)]
        self.collectors: list[Generator[None]] = [self.collection() for _ in range(COLLECTORS)]
        self.counted: dict[int, set[str]] = {}  # of each upload under way, what it was told to be here
        self.claimed: dict[int, set[str]] = {}
        self.touched_ns: dict[int, int] = {}

    def close(self) -> None:
        self.database.close()

    def clock(self) -> int:
        return self.now_ns

    def collection(self) -> Generator[None]:
        """Collections without end, step by step."""
        while True:
            before_ns = self.now_ns - ABANDONED_NS
            with self.database.writing() as connection:
                uploads.end_abandoned(connection, before_ns)
            for number in [number for number in self.counted if self.touched_ns[number] < before_ns]:
                del self.counted[number], self.claimed[number]
            yield
            doom_unreferenced(self.database, self.now_ns)
            yield
            doomed = doomed_keys(self.database)
            yield
            delete_unwanted(self.database, self.objects)
            yield
            forget_deleted(self.database, doomed)
            yield

    def contents(self, number: int) -> dict[str, bytes]:
        made = self.maps[number]
        return {made.version: made.manifest_bytes, **made.parts}

    def sizes(self, number: int) -> dict[str, int]:
        return {sha256: len(data) for sha256, data in self.contents(number).items()}

    # What everybody does, as the server does it.

    def do_begin(self, number: int, server: int) -> None:
        made = self.maps[number]
        self.claim(number, server, {made.version: len(made.manifest_bytes)})
        if made.version in self.counted.get(number, ()):
            self.claim(number, server, self.sizes(number))

    def claim(self, number: int, server: int, sizes: dict[str, int]) -> None:
        with self.database.writing() as connection:
            uploads.begin(connection, self.maps[number].version, "map", "name", 1, self.now_ns)
            uploads.claim(connection, self.maps[number].version, sizes)
            self.servers[server].expect(connection, sizes)
        self.touched_ns[number] = self.now_ns
        self.claimed.setdefault(number, set()).update(sizes)
        self.counted.setdefault(number, set())
        told = self.servers[server].received(sizes)
        if number in self.counted:
            self.counted[number].update(name for name in sizes if told[name] == sizes[name])

    def do_send(self, number: int, server: int, pieces: int = PIECES) -> None:
        """One piece of the first blob that is missing; claimed or, by an upload that was given up, not."""
        sizes = self.sizes(number)
        received = self.servers[server].received(sizes)
        for name, data in self.contents(number).items():
            if received[name] < len(data):
                start = received[name]
                piece = data[start : start + -(-len(data) // pieces)]
                now = self.servers[server].append(name, len(data), start, piece)
                if now == len(data) and name in self.claimed.get(number, ()):
                    self.counted[number].add(name)
                return

    def do_publish(self, number: int, server: int) -> None:
        for _ in range(PIECES * len(self.sizes(number))):
            self.do_begin(number, server)
            self.do_send(number, server)
        self.do_commit(number)

    def end(self, number: int) -> None:
        """An upload ends without a commit."""
        with self.database.writing() as connection:
            uploads.end(connection, self.maps[number].version)
        self.counted.pop(number, None)
        self.claimed.pop(number, None)

    def do_commit(self, number: int) -> None:
        made = self.maps[number]
        with self.database.writing() as connection:
            missing = self.servers[0].missing(connection, self.sizes(number))
            if missing:
                assert not set(missing) & self.counted.get(number, set())
                return
            latest = self.catalogue.latest(connection, made.manifest.map_id)
            predecessor = latest.version if latest else None
            self.catalogue.add(connection, made.manifest, made.version, len(made.manifest_bytes), predecessor)
            uploads.end(connection, made.version)
        self.counted.pop(number, None)
        self.claimed.pop(number, None)

    def do_retire(self, number: int) -> None:
        map_id = self.maps[number].manifest.map_id
        with self.database.writing() as connection:
            if self.catalogue.latest(connection, map_id) is not None:
                self.catalogue.retire(connection, map_id)

    def interrupt(self, step: Step) -> None:
        """What interrupts has a server of its own: one server's requests for one blob wait for each other."""
        if step.meanwhile == "die":
            raise Died
        if step.meanwhile != "collect":
            self.do(step.meanwhile, step.other, SERVERS)
        elif not self.collectors[step.collector].gi_running:
            for _ in range(COLLECTION_STEPS):
                next(self.collectors[step.collector])

    def do(self, what: str, number: int, server: int) -> None:
        if what == "begin":
            self.do_begin(number, server)
        elif what == "send":
            self.do_send(number, server)
        elif what == "commit":
            self.do_commit(number)
        elif what == "retire":
            self.do_retire(number)
        elif what == "keep one version":
            with self.database.writing() as connection:
                retain(connection, 1, self.now_ns)
        elif what == "a week passes":
            self.now_ns += 8 * DAY_NS
        else:
            self.servers[server] = Blobs(self.objects, self.database, self.clock)

    def take(self, step: Step) -> None:
        """One step, in which something else happens."""
        with self.amid(step):
            if step.what == "collect":
                for _ in range(step.times):
                    next(self.collectors[step.collector])
            elif step.what == "send":
                for _ in range(step.times):
                    self.do_begin(step.number, step.server)
                    self.do_send(step.number, step.server)
            elif step.what == "publish":
                self.do_publish(step.number, step.server)
            else:
                self.do(step.what, step.number, step.server)

    @contextmanager
    def amid(self, step: Step) -> Iterator[None]:
        """Have somebody interrupt before one of the next operations of store and database."""
        self.other.set(step.before, step.after, lambda: self.interrupt(step))
        with suppress(Died):
            yield
        self.other.meanwhile = None
        self.collectors = [
            collector if collector.gi_frame is not None else self.collection() for collector in self.collectors
        ]

    def nothing_is_lost(self) -> None:
        needed = self.published() | set().union(*self.counted.values())
        assert needed <= {sha256 for sha256, _ in self.live()}
        for _, key in self.live():
            assert self.objects.head(key) is not None

    def published(self) -> set[str]:
        with self.database.reading() as connection:
            versions = set(
                connection.execute(sa.text("SELECT version FROM versions WHERE retired_ns IS NULL")).scalars()
            )
        return {
            name
            for number in range(len(self.maps))
            if self.maps[number].version in versions
            for name in self.contents(number)
        }

    def live(self) -> list[tuple[str, str]]:
        with self.database.reading() as connection:
            rows = connection.execute(sa.text("SELECT sha256, key FROM objects WHERE state = 'live'"))
            return [(sha256, key) for sha256, key in rows]

    def only_what_is_published_remains(self) -> None:
        self.now_ns += 8 * DAY_NS
        collect(self.database, self.objects, now_ns=self.now_ns)
        keys = {key for prefix in ("blobs", "uploads") for key, _ in self.objects.keys(prefix)}
        assert keys == {key for _, key in self.live()}
        assert {sha256 for sha256, _ in self.live()} == self.published()
        for name in self.published():
            assert hashlib.sha256(b"".join(self.servers[0].stream(name))).hexdigest() == name


def test_whatever_is_published_or_counted_on_survives_and_nothing_else_does(make_map, monkeypatch):
    monkeypatch.setattr(receiving, "_SMALL_BYTES", 250)  # some are streamed
    shared = {"seed": 0, "path_lonlat": ((8.4, 49.0), (8.41, 49.0))}
    maps = (
        make_map(map_id="a", part_sizes=(300, 200), **shared),
        make_map(map_id="a", part_sizes=(300, 200, 100), **shared),
        make_map(map_id="b", part_sizes=(300,), **shared),
        make_map(map_id="b", part_sizes=(50,), **shared),
    )

    @settings(max_examples=12, deadline=None, derandomize=True, phases=(Phase.generate,), database=None)
    @given(steps=st.lists(STEPS, min_size=10, max_size=30))
    def all_is_well(steps: list[Step]) -> None:
        with TemporaryDirectory() as folder, closing(Fleet(folder, maps)) as fleet:
            for step in steps:
                fleet.take(step)
                fleet.nothing_is_lost()
            fleet.only_what_is_published_remains()

    all_is_well()


@pytest.mark.parametrize("interfering", ["a claim", "the last piece of an upload without claim"])
def test_at_any_moment_of_a_collection_others_may_interfere(make_map, tmp_path, interfering):
    with closing(Fleet(str(tmp_path), (make_map(part_sizes=(300,)),))) as fleet:
        made = fleet.maps[0]
        for moment in itertools.count():
            if interfering == "a claim":
                fleet.do_publish(0, 0)
                fleet.do_retire(0)
                fleet.other.set("", moment, lambda: fleet.do_begin(0, SERVERS))
            else:
                size = len(made.manifest_bytes)
                fleet.servers[0].append(made.version, size, 0, made.manifest_bytes[:100])
                fleet.other.set("", moment, lambda: fleet.do_send(0, 0, pieces=1))
            collect(fleet.database, fleet.objects, now_ns=fleet.now_ns)
            fleet.nothing_is_lost()
            if fleet.other.meanwhile is not None:
                break
        assert moment > 10
        fleet.other.meanwhile = None
        fleet.do_publish(0, 0)
        fleet.only_what_is_published_remains()


@pytest.mark.parametrize("is_claimed", [True, False])
def test_a_collection_at_any_moment_of_an_upload_takes_nothing_that_is_claimed(make_map, tmp_path, is_claimed):
    with closing(Fleet(str(tmp_path), (make_map(part_sizes=(300,)),))) as fleet:
        made = fleet.maps[0]
        size = len(made.manifest_bytes)
        for moment in itertools.count():
            if is_claimed:
                fleet.do_begin(0, 0)
            fleet.other.set("", moment, lambda: collect(fleet.database, fleet.objects, now_ns=fleet.now_ns))
            received = fleet.servers[0].append(made.version, size, 0, made.manifest_bytes[:100])
            received = fleet.servers[0].append(made.version, size, received, made.manifest_bytes[received:])
            is_through, fleet.other.meanwhile = fleet.other.meanwhile is not None, None
            assert received == size or not is_claimed
            fleet.nothing_is_lost()
            assert not is_claimed or fleet.servers[1].read(made.version, 0, size) == made.manifest_bytes
            fleet.end(0)
            collect(fleet.database, fleet.objects, now_ns=fleet.now_ns)
            assert [*fleet.live(), *fleet.objects.keys("uploads"), *fleet.objects.keys("blobs")] == []
            if is_through:
                break
        assert moment > 5
