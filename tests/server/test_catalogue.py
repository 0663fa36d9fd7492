"""The history of maps, on both kinds of database: who wins, what is the latest, what is served."""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test

from fleetmap.catalogue import MapEntry
from fleetmap.errors import ConflictError, InputError
from fleetmap_server.catalogue import Catalogue
from fleetmap_server.database import Database
from fleetmap_server.problems import BadRequestError, GoneError, NotFoundError
from fleetmap_server.search import MapSearch

MAP = "karlsruhe"


@pytest.fixture
def open_catalogue(database_url) -> Iterator[Callable[..., Catalogue]]:
    """Servers of one database, each with connections of its own."""
    with contextlib.ExitStack() as opened:
        yield lambda **options: Catalogue(
            opened.enter_context(contextlib.closing(Database(database_url))), **options
        )


@pytest.fixture
def catalogue(open_catalogue) -> Catalogue:
    return open_catalogue()


@pytest.fixture
def contents(make_map):
    """Contents that one map may have."""
    return [make_map(MAP, part_sizes=(100 + number, 200), seed=number) for number in range(4)]


def add(catalogue: Catalogue, one, predecessor: str | None = None) -> MapEntry:
    with catalogue.database.writing() as connection:
        return catalogue.add(connection, one.manifest, one.version, len(one.manifest_bytes), predecessor)


def rollback(catalogue: Catalogue, map_id: str, version: str | int, latest: str | None = None) -> MapEntry:
    with catalogue.database.writing() as connection:
        return catalogue.rollback(connection, map_id, version, latest)


def retire(catalogue: Catalogue, map_id: str, version: str | int | None = None) -> int:
    with catalogue.database.writing() as connection:
        return catalogue.retire(connection, map_id, version)


def publish_all(catalogue: Catalogue, contents) -> list[str]:
    """One after the other; their versions."""
    versions = [one.version for one in contents]
    for one, before in zip(contents, [None, *versions], strict=False):
        add(catalogue, one, before)
    return versions


def test_a_version_knows_its_neighbours(catalogue, contents):
    versions = publish_all(catalogue, contents[:3])
    history = catalogue.versions(MAP)
    assert [entry.version for entry in history] == versions
    assert [entry.number for entry in history] == [1, 2, 3]
    assert [entry.predecessor for entry in history] == [None, *versions[:2]]
    assert [entry.successor for entry in history] == [*versions[1:], None]
    assert [entry.successor_number for entry in history] == [2, 3, None]
    assert [entry.is_latest for entry in history] == [False, False, True]
    assert retire(catalogue, MAP, 2) == 1
    first, last = catalogue.versions(MAP)
    assert (first.successor, first.successor_number) == (versions[2], 3)
    assert (last.predecessor, last.predecessor_number) == (versions[0], 1)


def test_what_the_manifest_says_is_in_the_entry(catalogue, contents):
    one = contents[0]
    entry = add(catalogue, one)
    told = MapEntry.from_manifest(one.manifest, one.version, len(one.manifest_bytes), entry.published_ns)
    assert entry == told
    assert catalogue.entry(MAP) == entry
    assert catalogue.blob_size(one.version, one.version) == len(one.manifest_bytes)
    for part in one.manifest.parts:
        assert catalogue.blob_size(one.version, part.sha256) == part.size_bytes
        assert catalogue.has_part(MAP, part.sha256)
    assert {(part.sha256, part.kind, part.cell) for part in catalogue.parts(one.version)} == {
        (part.sha256, part.kind, part.cell) for part in one.manifest.parts
    }
    assert catalogue.blob_size(one.version, "0" * 64) is None
    assert catalogue.blob_size("0" * 64, "0" * 64) is None
    assert not catalogue.has_part("elsewhere", one.manifest.parts[0].sha256)


def test_a_version_can_be_named_by_number_hash_or_the_beginning_of_its_hash(catalogue, contents):
    versions = publish_all(catalogue, contents[:2])
    for name in (1, "1", versions[0], versions[0][:8], versions[0][:20]):
        assert catalogue.entry(MAP, name).number == 1
    for name in (3, 0, -1, 2**40, "7", "0" * 64, "abcdef012345"):
        assert catalogue.entry(MAP, name) is None
    for name in ("", "abc", "latest", "-1", "1.0", "ABCDEF0123", "é" * 8, "%" * 8, "0" * 65):
        with pytest.raises(BadRequestError, match="names no version; give its number, or 8 or more digits"):
            catalogue.entry(MAP, name)


def test_a_name_that_no_map_can_have_is_unknown_or_refused(catalogue):
    for name in ("", "Größe", "a" * 1000, "'; DROP TABLE versions; --", "%"):
        assert catalogue.entry(name) is None
    with contextlib.suppress(InputError):  # PostgreSQL holds no NUL
        assert catalogue.entry("a\0b") is None


def test_two_versions_that_begin_alike_are_told_apart(catalogue, contents):
    ours, theirs = (replace(one, manifest_bytes=b"") for one in contents[:2])
    with catalogue.database.writing() as connection:  # hashes that begin alike cannot be made in a test
        catalogue.add(connection, ours.manifest, "ab" * 32, 10, None)
        catalogue.add(connection, theirs.manifest, "ab" * 8 + "c" * 48, 10, "ab" * 32)
    with pytest.raises(BadRequestError, match="several versions of map 'karlsruhe' begin with abababab"):
        catalogue.entry(MAP, "abababab")
    assert catalogue.entry(MAP, "ab" * 9).number == 1


def test_who_did_not_see_the_latest_version_is_told_which_it_is(catalogue, contents):
    first, second, third, _ = contents
    add(catalogue, first)
    with pytest.raises(ConflictError, match=rf"version {first.version[:12]} \(number 1\) is the latest now"):
        add(catalogue, second, None)
    add(catalogue, second, first.version)
    with pytest.raises(ConflictError, match=rf"{second.version[:12]} \(number 2\).*{first.version[:12]} was when"):
        add(catalogue, third, first.version)
    with pytest.raises(ConflictError, match=f"{second.version[:12]}"):
        rollback(catalogue, MAP, first.version, latest=first.version[::-1])
    assert [entry.number for entry in catalogue.versions(MAP)] == [1, 2]


def test_an_answer_that_got_lost_can_be_asked_for_again(catalogue, contents):
    versions = publish_all(catalogue, contents[:3])
    again = add(catalogue, contents[1], versions[0])
    assert (again.number, again.is_latest, again.successor) == (2, False, versions[2])
    assert add(catalogue, contents[2], versions[1]).is_latest
    assert rollback(catalogue, MAP, 1).number == 4
    assert rollback(catalogue, MAP, 1).number == 4
    assert add(catalogue, contents[2], versions[1]).number == 3  # and does not undo what came after it
    assert [entry.number for entry in catalogue.versions(MAP)] == [1, 2, 3, 4]
    assert catalogue.last_serial() == catalogue.since(0)[-1][0]


def test_rolling_back_adds_the_old_content_under_a_new_number(catalogue, contents):
    versions = publish_all(catalogue, contents[:3])
    old = catalogue.entry(MAP, 1)
    now = rollback(catalogue, MAP, versions[0], latest=versions[2])
    assert (now.number, now.version, now.origin, now.is_latest) == (4, versions[0], "rollback", True)
    assert (now.predecessor, now.predecessor_number, now.successor) == (versions[2], 3, None)
    assert now.published_ns > catalogue.entry(MAP, 3).published_ns > old.published_ns
    told = {"number", "origin", "is_latest", "predecessor", "predecessor_number", "successor", "successor_number"}
    excluded = told | {"published_ns"}
    assert now.model_dump(exclude=excluded) == old.model_dump(exclude=excluded)
    assert catalogue.entry(MAP, versions[0]) == now  # of several numbers the last
    assert catalogue.search(MapSearch(box=(8.4, 48.9, 8.5, 49.1))).entries == (now,)


def test_what_is_retired_is_neither_listed_nor_served(catalogue, contents):
    versions = publish_all(catalogue, contents[:3])
    shared = {part.sha256 for part in contents[0].manifest.parts} & {
        part.sha256 for part in contents[1].manifest.parts
    }
    own = next(part.sha256 for part in contents[0].manifest.parts if part.sha256 not in shared)
    with pytest.raises(BadRequestError, match="is the latest of map 'karlsruhe'; publish or roll back"):
        retire(catalogue, MAP, 3)
    assert retire(catalogue, MAP, versions[0][:9]) == 1
    assert retire(catalogue, MAP, 1) == 0
    for name in (1, versions[0]):
        with pytest.raises(GoneError, match="of map 'karlsruhe' was retired"):
            catalogue.entry(MAP, name)
    assert catalogue.blob_size(versions[0], versions[0]) is None
    assert catalogue.blob_size(versions[0], own) is None
    assert not catalogue.has_part(MAP, own)
    with pytest.raises(GoneError):
        rollback(catalogue, MAP, 1)
    for missing in ((MAP, 9), ("elsewhere", None), ("elsewhere", 1)):
        with pytest.raises(NotFoundError):
            retire(catalogue, *missing)
    assert [(entry.number, entry.retired) for _, entry in catalogue.since(0)] == [
        (1, True), (2, False), (3, False)
    ]  # fmt: skip


def test_a_content_that_is_the_latest_again_can_only_be_retired_by_its_old_number(catalogue, contents):
    versions = publish_all(catalogue, contents[:2])
    rollback(catalogue, MAP, 1)
    with pytest.raises(BadRequestError, match="is the latest"):
        retire(catalogue, MAP, versions[0])
    assert retire(catalogue, MAP, 1) == 1
    assert catalogue.entry(MAP, versions[0]).number == 3
    assert catalogue.blob_size(versions[0], versions[0]) is not None


def test_a_map_published_again_after_it_was_retired_goes_on_numbering(catalogue, contents):
    versions = publish_all(catalogue, contents[:2])
    assert retire(catalogue, MAP) == 2
    assert retire(catalogue, MAP) == 0
    assert (catalogue.count(), catalogue.versions(MAP)) == (0, [])
    assert catalogue.search(MapSearch(box=(-180, -90, 180, 90))).entries == ()
    with pytest.raises(GoneError, match="map 'karlsruhe' was retired"):
        catalogue.entry(MAP)
    again = add(catalogue, contents[0], None)
    assert (again.number, again.is_latest, again.predecessor, again.successor) == (3, True, None, None)
    assert catalogue.entry(MAP) == catalogue.entry(MAP, versions[0]) == again
    with pytest.raises(GoneError):
        catalogue.entry(MAP, 1)


def test_time_does_not_go_back_in_a_map_when_the_clock_does(open_catalogue, contents):
    times = itertools.count(1_000, -10)
    catalogue = open_catalogue(clock=lambda: next(times))
    publish_all(catalogue, contents)
    published_ns = [entry.published_ns for entry in catalogue.versions(MAP)]
    assert published_ns == sorted(set(published_ns))


def test_of_publishers_at_once_exactly_one_wins_and_the_others_are_told(open_catalogue, make_map):
    servers = [open_catalogue() for _ in range(3)]
    latest: str | None = None
    for turn in range(8):
        ready = threading.Barrier(len(servers))

        def publish(server: Catalogue, one, seen: str | None, ready=ready) -> MapEntry | ConflictError:
            ready.wait()
            try:
                return add(server, one, seen)
            except ConflictError as error:
                return error

        offered = [make_map(MAP, part_sizes=(10,), seed=100 * turn + number) for number in range(len(servers))]
        with ThreadPoolExecutor(len(servers)) as pool:
            came = list(pool.map(publish, servers, offered, [latest] * len(servers)))
        (won,) = [one for one in came if isinstance(one, MapEntry)]
        assert won.number == turn + 1
        for other in came:
            assert other is won or f"version {won.version[:12]} (number {won.number}) is the latest" in str(other)
        for server in servers:  # at once, on all of them
            assert server.entry(MAP) == won
        latest = won.version


def test_every_change_is_told_once_and_in_order_while_writers_interleave(open_catalogue, make_map):
    maps = {f"map-{number}": [make_map(f"map-{number}", (10,), seed=s) for s in range(6)] for number in range(4)}
    expected = sum(map(len, maps.values())) + len(maps)

    def write(map_id: str) -> None:
        catalogue = open_catalogue()
        publish_all(catalogue, maps[map_id])
        rollback(catalogue, map_id, 2)
        retire(catalogue, map_id, 1)

    told: list[tuple[int, MapEntry]] = []
    reader = open_catalogue()
    with ThreadPoolExecutor(len(maps)) as pool:
        writing = [pool.submit(write, map_id) for map_id in maps]
        while len(told) < expected and not any(one.done() and one.exception() for one in writing):
            told += reader.since(told[-1][0] if told else 0, limit=3)
        for one in writing:
            one.result()
    assert [serial for serial, _ in told] == sorted({serial for serial, _ in told})
    for map_id in maps:
        assert [entry.number for _, entry in told if entry.map_id == map_id] == list(range(1, 8))
    assert reader.since(told[-1][0]) == []
    assert [entry.map_id for _, entry in reader.since(0, 100)] == [entry.map_id for _, entry in told]


@dataclass(frozen=True)
class ModelVersion:
    number: int
    version: str
    seen: str | None
    origin: str = "published"
    retired: bool = False


class History(RuleBasedStateMachine):
    """Two servers against lists in memory."""

    new_database: Callable[[], str]
    maps: dict[str, list]

    def __init__(self) -> None:
        super().__init__()
        url = self.new_database()
        self.servers = [Catalogue(Database(url)) for _ in range(2)]
        self.model: dict[str, list[ModelVersion]] = {map_id: [] for map_id in self.maps}
        self.has_latest = dict.fromkeys(self.maps, False)
        self.told: list[tuple[str, int]] = []

    def teardown(self) -> None:
        for server in self.servers:
            server.database.close()

    def latest(self, map_id: str) -> ModelVersion | None:
        return self.model[map_id][-1] if self.has_latest[map_id] else None

    def append(self, map_id: str, version: str, seen: str | None, origin: str) -> int:
        number = len(self.model[map_id]) + 1
        self.model[map_id].append(ModelVersion(number, version, seen, origin))
        self.has_latest[map_id] = True
        self.told.append((map_id, number))
        return number

    def served(self, map_id: str) -> list[ModelVersion]:
        return [one for one in self.model[map_id] if not one.retired]

    map_ids = st.sampled_from(["here", "there"])
    servers_of = st.integers(0, 1)
    sights = st.sampled_from(["latest", "latest", "none", "old"])
    numbers = st.integers(1, 8)

    @rule(map_id=map_ids, content=st.integers(0, 3), at=servers_of, saw=sights)
    def publish(self, map_id: str, content: int, at: int, saw: str) -> None:
        one, history, latest = self.maps[map_id][content], self.model[map_id], self.latest(map_id)
        seen = {"latest": latest and latest.version, "none": None, "old": history[0].version if history else None}[
            saw
        ]
        same = [
            old.number for old in self.served(map_id)
            if (old.version, old.seen, old.origin) == (one.version, seen, "published")
        ]  # fmt: skip
        if latest is not None and latest.version == one.version:
            expected = latest.number
        elif same:
            expected = same[-1]
        elif seen != (latest and latest.version):
            with pytest.raises(ConflictError):
                add(self.servers[at], one, seen)
            return
        else:
            expected = self.append(map_id, one.version, seen, "published")
        assert add(self.servers[at], one, seen).number == expected

    @rule(map_id=map_ids, number=numbers, at=servers_of, guarded=st.booleans())
    def roll_back(self, map_id: str, number: int, at: int, guarded: bool) -> None:
        history, latest = self.model[map_id], self.latest(map_id)
        if number > len(history) or history[number - 1].retired:
            with pytest.raises(NotFoundError if number > len(history) else GoneError):
                rollback(self.servers[at], map_id, number)
            return
        assert latest is not None
        old = history[number - 1]
        if old.version == latest.version:
            expected = latest.number
        else:
            expected = self.append(map_id, old.version, latest.version, "rollback")
        entry = rollback(self.servers[at], map_id, number, latest.version if guarded else None)
        assert entry.number == expected

    @rule(map_id=map_ids, number=numbers, at=servers_of)
    def retire_one(self, map_id: str, number: int, at: int) -> None:
        history, latest = self.model[map_id], self.latest(map_id)
        if number > len(history) or (latest is not None and latest.number == number):
            with pytest.raises(NotFoundError if number > len(history) else BadRequestError):
                retire(self.servers[at], map_id, number)
            return
        assert retire(self.servers[at], map_id, number) == (not history[number - 1].retired)
        history[number - 1] = replace(history[number - 1], retired=True)

    @rule(map_id=map_ids, at=servers_of)
    def retire_all(self, map_id: str, at: int) -> None:
        if not self.model[map_id]:
            with pytest.raises(NotFoundError):
                retire(self.servers[at], map_id)
            return
        assert retire(self.servers[at], map_id) == len(self.served(map_id))
        self.model[map_id] = [replace(one, retired=True) for one in self.model[map_id]]
        self.has_latest[map_id] = False

    @invariant()
    def the_servers_tell_what_the_model_tells(self) -> None:
        self.servers.reverse()  # each is asked every other time
        server = self.servers[0]
        listed = {map_id: one.number for map_id in self.maps if (one := self.latest(map_id)) is not None}
        found = server.search(MapSearch(box=(-180.0, -90.0, 180.0, 90.0))).entries
        assert {entry.map_id: entry.number for entry in found} == listed
        assert server.count() == len(listed)
        for map_id in self.maps:
            self.check_history(server, map_id)
        assert [(entry.map_id, entry.number) for _, entry in server.since(0)] == self.told

    def check_history(self, server: Catalogue, map_id: str) -> None:
        served, latest = self.served(map_id), self.latest(map_id)
        entries = server.versions(map_id)
        assert [(entry.number, entry.version, entry.origin) for entry in entries] == [
            (one.number, one.version, one.origin) for one in served
        ]
        assert [entry.is_latest for entry in entries] == [one is latest for one in served]
        numbers = [one.number for one in served]
        assert [entry.predecessor_number for entry in entries] == [None, *numbers][: len(numbers)]
        assert [entry.successor_number for entry in entries] == [*numbers, None][1 : len(numbers) + 1]
        for one in self.maps[map_id]:
            is_served = any(version.version == one.version for version in served)
            assert (server.blob_size(one.version, one.version) is not None) == is_served
            assert server.has_part(map_id, one.manifest.parts[0].sha256) == is_served


@pytest.mark.parametrize(("kind", "examples"), [("sqlite", 10), ("postgresql", 3)])
def test_any_history_is_what_a_plain_model_says(kind, examples, request, tmp_path, make_map):
    files = itertools.count()

    def new_database() -> str:
        if kind == "sqlite":
            return f"sqlite:///{Path(tmp_path) / f'{next(files)}.sqlite'}"
        return request.getfixturevalue("postgresql").new_database()

    new_database()  # skips where there is no PostgreSQL
    maps = {name: [make_map(name, (10 + n,), seed=n) for n in range(4)] for name in ("here", "there")}
    machine = type("Machine", (History,), {"new_database": staticmethod(new_database), "maps": maps})
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=examples,
            stateful_step_count=20,
            deadline=None,
            derandomize=True,
            suppress_health_check=list(HealthCheck),
        ),
    )
