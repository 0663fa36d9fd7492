"""The list of drives: each once, found by place, time and name, page by page."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from threading import Barrier

import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fleetmap.jobs import DriveEntry, DriveSummary
from fleetmap_server.boxes import LonLatBox, outline, region
from fleetmap_server.database import Database
from fleetmap_server.drive_search import DriveSearch
from fleetmap_server.drives import Drives
from fleetmap_server.problems import BadRequestError, GoneError, NotFoundError

KARLSRUHE = ((8.40, 49.00), (8.41, 49.005), (8.42, 49.00))
FIJI = ((179.98, -17.0), (179.999, -17.01), (-179.99, -17.02))
SECOND_NS = 1_000_000_000


def sha256(name: str) -> str:
    return hashlib.sha256(name.encode()).hexdigest()


@pytest.fixture
def database(database_url: str) -> Iterator[Database]:
    with closing(Database(database_url)) as opened:
        yield opened


@pytest.fixture
def drives(database: Database) -> Drives:
    times_ns = iter(range(1, 10_000))
    return Drives(database, lambda: next(times_ns))


@pytest.fixture
def add(database: Database, drives: Drives) -> Callable[..., DriveEntry]:
    def add(name: str, size_bytes: int = 1000, checked: bool = False, **summary: object) -> DriveEntry:
        with database.writing() as connection:
            entry = drives.add(connection, sha256(name), f"{name}.mcap", size_bytes)
            if not summary:
                return entry
            told = DriveSummary(verdict="yes", **summary)
            return drives.summarise(connection, sha256(name), told, checked=checked)

    return add


def names(drives: Drives, **search: object) -> list[str]:
    return [entry.name.removesuffix(".mcap") for entry in drives.search(DriveSearch(**search)).entries]


def test_the_same_recording_is_one_drive_with_its_first_name(database, drives):
    with database.writing() as connection:
        first = drives.add(connection, sha256("a"), "first.mcap", 1000, 5, 9)
        again = drives.add(connection, sha256("a"), "again.mcap", 1000)
    assert first == again == drives.get(sha256("a"))
    assert (first.name, first.start_ns, first.end_ns, first.state) == ("first.mcap", 5, 9, "received")
    assert drives.count() == 1


def test_a_worker_knows_better_than_the_sender(database, drives):
    with database.writing() as connection:
        drives.add(connection, sha256("a"), "a.mcap", 1000, 5, 9)

    def note(checked: bool, **values: object) -> DriveEntry:
        with database.writing() as connection:
            told = DriveSummary(verdict="yes", **values)
            return drives.summarise(connection, sha256("a"), told, checked=checked)

    sent = note(False, trajectory_lonlat=KARLSRUHE, image_count=10)
    assert (sent.state, sent.summary.image_count, sent.start_ns) == ("received", 10, 5)
    assert sent.bbox_lonlat == (8.40, 49.00, 8.42, 49.005)
    checked = note(True, trajectory_lonlat=FIJI, image_count=11, start_ns=6, end_ns=8)
    assert (checked.state, checked.summary.image_count, checked.start_ns, checked.end_ns) == ("checked", 11, 6, 8)
    assert note(False, image_count=12) == checked == drives.get(sha256("a"))
    assert names(drives, box=(8.0, 48.0, 9.0, 50.0)) == []
    assert names(drives, box=(179.0, -18.0, -179.0, -16.0)) == ["a"]


def test_drives_are_found_by_place_and_time(drives, add):
    add("nowhere")
    add("karlsruhe", trajectory_lonlat=KARLSRUHE, start_ns=100, end_ns=200)
    add("fiji", trajectory_lonlat=FIJI, start_ns=300, end_ns=400)
    assert names(drives) == ["fiji", "karlsruhe", "nowhere"]
    assert names(drives, box=(8.0, 48.0, 8.405, 50.0)) == ["karlsruhe"]
    assert names(drives, box=(8.415, 49.004, 8.42, 49.005)) == []  # inside the box, beside the way
    assert names(drives, box=(-180.0, -18.0, -179.995, -16.0)) == ["fiji"]
    assert names(drives, box=(170.0, -18.0, 10.0, 50.0)) == ["fiji", "karlsruhe"]
    triangle = shapely.Polygon([(8.40, 49.1), (8.42, 49.1), (8.41, 49.004)])
    assert names(drives, geometry=triangle) == ["karlsruhe"]
    assert names(drives, geometry=shapely.Polygon()) == []
    assert names(drives, start_ns=200, end_ns=300) == ["fiji", "karlsruhe"]
    assert names(drives, start_ns=201) == ["fiji"]
    assert names(drives, end_ns=299) == ["karlsruhe", "nowhere"]  # without a time of its own: when it came
    assert names(drives, start_ns=100, end_ns=299) == ["karlsruhe"]
    assert names(drives, ids=(sha256("fiji"), sha256("atlantis"))) == ["fiji"]
    assert names(drives, ids=()) == []
    assert names(drives, prefix=sha256("nowhere")[:8]) == ["nowhere"]
    assert drives.search(DriveSearch(start_ns=100, limit=1)).matched == 2


def test_drives_are_ordered_as_wished(drives, add):
    add("b", size_bytes=10, start_ns=3)
    add("a", size_bytes=30, start_ns=2)
    add("c", size_bytes=10, start_ns=1)
    assert names(drives, order=(("received", False),)) == ["b", "a", "c"]
    assert names(drives, order=(("datetime", False),)) == ["c", "a", "b"]
    assert names(drives, order=(("size_bytes", True), ("received", True))) == ["a", "c", "b"]
    by_id = sorted("abc", key=sha256)
    assert names(drives, order=(("id", False),)) == by_id
    assert names(drives, order=(("size_bytes", False),)) == [*(n for n in by_id if n != "a"), "a"]


def test_pages_neither_lose_nor_repeat_a_drive_whatever_comes_between(drives, add):
    expected = [f"drive {number}" for number in range(11)]
    for name in expected:
        add(name, trajectory_lonlat=KARLSRUHE)
    found, after = [], None
    for number in range(20):
        search = DriveSearch(box=(8.0, 48.0, 9.0, 50.0), limit=3, after=after)
        page = drives.search(search)
        found += [entry.name.removesuffix(".mcap") for entry in page.entries]
        add(f"later {number}", trajectory_lonlat=KARLSRUHE)
        if (after := page.after) is None:
            break
    assert found == expected[::-1]
    for wrong in ("nonsense", drives.search(DriveSearch(limit=1, order=(("id", True),))).after):
        with pytest.raises(BadRequestError):
            drives.search(DriveSearch(after=wrong))


def test_a_page_keeps_to_its_size_and_holds_one_drive_at_least(drives, add):
    for name in "abc":
        add(name, trajectory_lonlat=KARLSRUHE)
    one_bytes = len(drives.get(sha256("a")).model_dump_json())
    assert names(drives, max_bytes=2 * one_bytes + 10) == ["c", "b"]
    page = drives.search(DriveSearch(max_bytes=1))
    assert [entry.name for entry in page.entries] == ["c.mcap"]
    assert names(drives, max_bytes=2 * one_bytes + 10, after=page.after) == ["b", "a"]


def test_the_first_digits_name_a_drive(drives, add):
    entry = add("a")
    assert drives.get(entry.sha256[:8]) == entry
    for prefix, error in (
        ("0" * 8, NotFoundError),
        ("0" * 64, NotFoundError),
        (entry.sha256[:7], BadRequestError),
    ):
        with pytest.raises(error):
            drives.get(prefix)


def test_a_retired_drive_is_gone_until_it_is_sent_again(database, drives, add):
    before = add("a", trajectory_lonlat=KARLSRUHE)
    everywhere = (-180.0, -90.0, 180.0, 90.0)
    for _ in range(2):
        with database.writing() as connection:
            drives.retire(connection, sha256("a"))
    assert names(drives) == names(drives, box=everywhere) == []
    assert (drives.count(), drives.find(sha256("a"))) == (0, None)
    with pytest.raises(GoneError, match="upload it again"):
        drives.get(sha256("a"))
    again = add("a")
    assert again == before.model_copy(update={"received_ns": again.received_ns})
    assert again.received_ns > before.received_ns
    assert names(drives, box=everywhere) == ["a"]
    with database.writing() as connection, pytest.raises(NotFoundError):
        drives.retire(connection, sha256("unheard of"))


def test_many_senders_of_one_recording_make_one_drive(database_url, drives):
    start = Barrier(4)

    def send(number: int) -> DriveEntry:
        with closing(Database(database_url)) as own:
            start.wait(30)
            with own.writing() as connection:
                return Drives(own).add(connection, sha256("a"), f"sender {number}.mcap", 1000)

    with ThreadPoolExecutor(4) as pool:
        told = list(pool.map(send, range(4)))
    assert set(told) == {drives.get(sha256("a"))}


LONS = st.integers(-1800, 1800).map(lambda tenths: tenths / 10)
LATS = st.integers(-900, 900).map(lambda tenths: tenths / 10)
STEPS = st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))


@st.composite
def paths(draw: st.DrawFn) -> tuple[tuple[float, float], ...]:
    lon, lat = draw(LONS), draw(LATS)
    path = [(lon, lat)]
    for east, north in draw(st.lists(STEPS, max_size=4)):
        lon = (lon + east + 180.0) % 360.0 - 180.0
        lat = min(max(lat + north, -90.0), 90.0)
        path.append((lon, lat))
    return tuple(path)


@st.composite
def boxes(draw: st.DrawFn) -> LonLatBox:
    south, north = sorted((draw(LATS), draw(LATS)))
    return (draw(LONS), south, draw(LONS), north)


def test_whatever_was_driven_is_found_in_the_boxes_that_it_meets(database, drives):
    count = 0

    @settings(
        max_examples=25,
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    )
    @given(st.lists(paths(), min_size=1, max_size=5), st.lists(boxes(), min_size=1, max_size=5))
    def check(driven, asked):
        nonlocal count
        with database.writing() as connection:
            ids = [sha256(f"{count}/{number}") for number in range(len(driven))]
            count += 1
            for one, path in zip(ids, driven, strict=True):
                drives.add(connection, one, "drive.mcap", 1000)
                drives.summarise(
                    connection, one, DriveSummary(verdict="yes", trajectory_lonlat=path), checked=True
                )
        for box in asked:
            found = {entry.sha256 for entry in drives.search(DriveSearch(box=box, ids=tuple(ids))).entries}
            lines = {one: outline(path, (0, 0, 0, 0)) for one, path in zip(ids, driven, strict=True)}
            assert found == {one for one, line in lines.items() if shapely.intersects(region(box), line)}

    check()
