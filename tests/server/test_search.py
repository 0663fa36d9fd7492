"""What a search finds, in which order, on which page: the same on both databases, and what a plain look finds."""

from __future__ import annotations

import base64
import contextlib
import functools
import itertools
import json
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import shapely
import sqlalchemy as sa
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from shapely.affinity import translate

from fleetmap.catalogue import MapEntry
from fleetmap_server import map_search
from fleetmap_server.catalogue import Catalogue
from fleetmap_server.database import Database
from fleetmap_server.problems import BadRequestError
from fleetmap_server.search import MapSearch, Near

FIELDS = {
    "published": "published_ns", "datetime": "start_ns", "id": "map_id", "length_m": "length_m",
    "landmarks": "landmarks", "size_bytes": "size_bytes",
}  # fmt: skip
MAPS = 120
EVERYWHERE = (-180.0, -90.0, 180.0, 90.0)


def add(catalogue: Catalogue, one, predecessor: str | None = None, **quality: object) -> MapEntry:
    """A map whose manifest says something else about its quality or its times."""
    times = {name: quality.pop(name) for name in ("start_ns", "end_ns") if name in quality}
    manifest = one.manifest.model_copy(
        update={
            "quality": one.manifest.quality.model_copy(update=quality),
            "provenance": one.manifest.provenance.model_copy(update=times),
        }
    )
    with catalogue.database.writing() as connection:
        return catalogue.add(connection, manifest, one.version, len(one.manifest_bytes), predecessor)


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def world(request, tmp_path_factory, make_map) -> Iterator[Catalogue]:
    """Maps around a city and on either side of 180 degrees; lines, positions, and none."""
    if request.param == "sqlite":
        url = f"sqlite:///{tmp_path_factory.mktemp('search') / 'catalogue.sqlite'}"
    else:
        url = request.getfixturevalue("postgresql").new_database()
    rng = np.random.default_rng(1)
    with contextlib.closing(Database(url)) as database:
        catalogue = Catalogue(database, clock=lambda: int(rng.integers(0, 50)))  # many at the same time
        for number in range(MAPS):
            place = np.array([(8.4, 49.0), (179.97, -17.0), (-179.97, -17.0)][number % 3])
            path = place + rng.normal(0.0, 0.05, 2) + np.cumsum(rng.normal(0.0, 0.02, (1 + number % 6, 2)), axis=0)
            path[:, 0] = (path[:, 0] + 180.0) % 360.0 - 180.0
            one = make_map(
                f"map-{number:03d}", (10 + number % 7,), seed=number, path_lonlat=path.round(4).tolist()
            )
            if number % 10 == 0:
                without = one.manifest.model_copy(update={"trajectory_lonlat": ()})
                one = type(one)(without, without.to_bytes(), one.parts)
            start_ns = 50 * int(rng.integers(0, 20))
            add(
                catalogue, one, start_ns=start_ns, end_ns=start_ns + 50 * int(rng.integers(0, 3)),
                length_m=float(number % 9) / 8.0, landmarks=int(rng.integers(0, 5)),
            )  # fmt: skip
        yield catalogue


@functools.cache
def everything(catalogue: Catalogue) -> list[MapEntry]:
    return [catalogue.entry(f"map-{number:03d}") for number in range(MAPS)]


def line(entry: MapEntry) -> shapely.Geometry:
    """The trajectory, else the box, without a jump at 180 degrees."""
    path = np.array(entry.trajectory_lonlat)
    if len(path) == 0:
        west, south, east, north = entry.bbox_lonlat
        return shapely.envelope(shapely.MultiPoint([(west, south), (east + 360.0 * (west > east), north)]))
    lons = np.unwrap(path[:, 0], period=360.0)
    return shapely.Point(lons[0], path[0, 1]) if len(path) == 1 else shapely.LineString(np.c_[lons, path[:, 1]])


def unwrapped(box: tuple[float, ...]) -> shapely.Geometry:
    west, south, east, north = box
    return shapely.envelope(shapely.MultiPoint([(west, south), (east + 360.0 * (west > east), north)]))


def meets(entry: MapEntry, area: shapely.Geometry) -> bool:
    """However often one goes around the world to get from one to the other."""
    return any(shapely.intersects(translate(line(entry), turns * 360.0), area) for turns in (-2, -1, 0, 1, 2))


def sure(entry: MapEntry, area: shapely.Geometry) -> bool:
    """Whether rounding cannot decide it."""
    wide, narrow = shapely.buffer(area, 1e-9), shapely.buffer(area, -1e-9)
    return meets(entry, wide) == meets(entry, narrow if not narrow.is_empty else area)


def all_pages(catalogue: Catalogue, search: MapSearch) -> list[MapEntry]:
    found: list[MapEntry] = []
    after: str | None = None
    while True:
        page = catalogue.search(search.model_copy(update={"after": after}))
        assert len(page.entries) <= search.limit
        assert page.entries or page.after is None
        found += page.entries
        if page.after is None:
            return found
        after = page.after


lons = st.one_of(st.floats(8.2, 8.6), st.floats(179.8, 180.0), st.floats(-180.0, -179.8), st.floats(-180.0, 180.0))
lats = st.one_of(st.floats(48.8, 49.2), st.floats(-17.2, -16.8), st.floats(-90.0, 90.0))
boxes = st.builds(
    lambda west, east, lats: (west, min(lats), east, max(lats)), lons, lons, st.tuples(lats, lats)
)  # fmt: skip
polygon = st.builds(
    lambda lon, lat, size, corners: shapely.convex_hull(
        shapely.MultiPoint([(lon + size * x, lat + size * y) for x, y in corners])
    ),
    st.floats(8.3, 8.5), st.floats(48.9, 49.1), st.floats(0.001, 0.3),
    st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=1, max_size=6),
)  # fmt: skip
polygons = st.lists(polygon, min_size=1, max_size=3).map(shapely.union_all) | st.sampled_from(
    [
        shapely.union_all([shapely.box(179.9, -18.0, 180.0, -16.0), shapely.box(-180.0, -18.0, -179.95, -16.0)]),
        shapely.MultiPoint([(8.3 + 0.02 * number, 49.0) for number in range(12)]),
    ]
)
times = st.none() | st.integers(-1, 23).map(lambda number: 50 * number)  # ends of surveys, too
orders = st.lists(st.tuples(st.sampled_from(list(FIELDS)), st.booleans()), max_size=3).map(tuple)


@pytest.mark.parametrize("few", [0, 10**6], ids=["order first", "boxes first"])
@settings(max_examples=20, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(
    box=st.none() | boxes, area=st.none() | polygons, start_ns=times, end_ns=times,
    ids=st.none() | st.lists(st.integers(0, MAPS + 5).map(lambda n: f"map-{n:03d}"), max_size=40).map(tuple),
    order=orders, limit=st.integers(3, 50),
)  # fmt: skip
@example(
    box=(179.9, -90.0, -179.9, 90.0), area=None, start_ns=None, end_ns=None, ids=None, order=(), limit=7
)  # fmt: skip
def test_all_pages_together_are_what_a_plain_look_finds(
    world, few, box, area, start_ns, end_ns, ids, order, limit
):
    search = MapSearch(
        box=box, geometry=area, start_ns=start_ns, end_ns=end_ns, ids=ids, order=order, limit=limit
    )  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(map_search, "_FEW", few)
        found = all_pages(world, search)
        matched = world.search(search).matched
    areas = ([unwrapped(box)] if box else []) + ([area] if area is not None else [])
    known = [
        entry for entry in everything(world)
        if (start_ns is None or entry.end_ns >= start_ns)
        and (end_ns is None or entry.start_ns <= end_ns)
        and (ids is None or entry.map_id in ids)
    ]  # fmt: skip
    unsure = {entry.map_id for entry in known if not all(sure(entry, area) for area in areas)}
    expected = {entry.map_id for entry in known if all(meets(entry, area) for area in areas)}
    names = [entry.map_id for entry in found]
    assert set(names) - unsure == expected - unsure
    assert len(set(names)) == len(names)
    assert matched in ((None, len(names)) if len(names) > search.limit else (len(names),))
    assert matched is not None or areas or start_ns is not None or end_ns is not None
    for before, behind in itertools.pairwise(found):
        assert _comes_before(before, behind, order)


def test_an_interval_and_a_radius_hold_their_ends(world):
    one = everything(world)[6]

    def finds(**asked: object) -> bool:
        return bool(world.search(MapSearch(ids=(one.map_id,), **asked)).entries)

    assert [finds(start_ns=one.end_ns + after_ns) for after_ns in (0, 1)] == [True, False]
    assert [finds(end_ns=one.start_ns - before_ns) for before_ns in (0, 1)] == [True, False]
    distance_m = one.distance_m(49.0, 8.4)
    assert [finds(near=Near(49.0, 8.4, distance_m * size)) for size in (1.0, 1.0 - 1e-9)] == [True, False]


def _comes_before(one: MapEntry, other: MapEntry, order: tuple[tuple[str, bool], ...]) -> bool:
    fields = dict(order)
    fields.setdefault("id", list(fields.values())[-1] if fields else True)
    for field, descending in fields.items():
        first, second = getattr(one, FIELDS[field]), getattr(other, FIELDS[field])
        if first != second:
            return bool((first > second) == descending)
    return False


@settings(max_examples=20, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(lat=st.floats(48.9, 49.1) | st.floats(-17.1, -16.9), lon=lons, radius_m=st.floats(10.0, 50_000.0))
@example(lat=-17.0, lon=180.0, radius_m=20_000.0)
@example(lat=49.0, lon=8.4, radius_m=1_000_000.0)
def test_near_finds_what_passes_within_the_radius_nearest_first(world, lat, lon, radius_m):
    found = all_pages(world, MapSearch(near=Near(lat, lon, radius_m), limit=7))
    distances_m = {entry.map_id: entry.distance_m(lat, lon) for entry in everything(world)}
    names = [entry.map_id for entry in found]
    # On the far side of the world a box's reach and a distance differ; within the radius they must not.
    assert names == [
        name for name, distance_m in sorted(distances_m.items(), key=lambda item: (item[1], item[0]))
        if distance_m <= radius_m
    ]  # fmt: skip


def test_near_goes_together_with_times_and_names(world):
    near = Near(49.0, 8.4, 100_000.0)
    found = all_pages(world, MapSearch(near=near, limit=10))
    some = tuple(entry.map_id for entry in found[::2])
    assert [e.map_id for e in all_pages(world, MapSearch(near=near, ids=some, limit=10))] == list(some)
    late = [entry for entry in found if entry.end_ns >= 500]
    assert all_pages(world, MapSearch(near=near, start_ns=500, limit=3)) == late
    page = world.search(MapSearch(near=near, limit=3))
    assert page.matched == len(found)


@pytest.mark.parametrize("order", [(("id", False),), (("published", True),), (("landmarks", True), ("id", False))])
def test_maps_that_are_added_between_pages_change_nothing_about_the_others(database_url, make_map, order):
    with contextlib.closing(Database(database_url)) as database:
        catalogue = Catalogue(database)
        for number in range(0, 60, 2):
            add(catalogue, make_map(f"map-{number:02d}", (10,), seed=number), landmarks=number % 3)
        told: list[str] = []
        page = catalogue.search(MapSearch(order=order, limit=4))
        for number in range(1, 60, 2):
            told += [entry.map_id for entry in page.entries]
            if page.after is None:
                break
            add(catalogue, make_map(f"map-{number:02d}", (10,), seed=number), landmarks=number % 3)
            page = catalogue.search(MapSearch(order=order, limit=4, after=page.after))
    assert len(set(told)) == len(told)
    assert {f"map-{number:02d}" for number in range(0, 60, 2)} <= set(told)


def made_cursor(*fields: object) -> str:
    return base64.urlsafe_b64encode(json.dumps(fields).encode()).decode().rstrip("=")


def test_a_cursor_that_is_not_of_the_search_is_refused(world):
    by_id = world.search(MapSearch(order=(("id", False),), limit=5)).after
    by_length = world.search(MapSearch(order=(("length_m", True),), limit=5)).after
    near = world.search(MapSearch(near=Near(49.0, 8.4, 90_000.0), limit=5)).after
    digest = json.loads(base64.urlsafe_b64decode(by_id + "=" * (-len(by_id) % 4)))[0]
    assert digest.isalnum()
    forged = [
        made_cursor(digest), made_cursor(digest, 1), made_cursor(digest, "a", "b"), made_cursor(digest, None),
        made_cursor(digest, True), made_cursor(digest, ["map"]), made_cursor(digest, "a\0b"), made_cursor(),
        made_cursor("0" * 8, "map-001"), "", "x", "%%%", "é", by_id[:-3], by_id + "A", by_id + "=",
        by_length, near,
    ]  # fmt: skip
    for cursor in forged:
        with pytest.raises(BadRequestError, match="is no page of this search; begin again with the first page"):
            world.search(MapSearch(order=(("id", False),), after=cursor))
    lengths = json.loads(base64.urlsafe_b64decode(by_length + "=" * (-len(by_length) % 4)))[0]
    for number in (float("nan"), float("inf"), 2**63, "1.0"):
        with pytest.raises(BadRequestError):
            world.search(MapSearch(order=(("length_m", True),), after=made_cursor(lengths, number, "map-001")))
    with pytest.raises(BadRequestError):
        world.search(MapSearch(near=Near(49.0, 8.4, 90_001.0), after=near))


@given(st.text())
@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
def test_no_text_is_worse_than_a_bad_request(cursor):
    with pytest.raises(BadRequestError):
        map_search._order(MapSearch(after=cursor))


def test_a_page_holds_as_many_bytes_as_it_may_but_one_entry_at_least(world):
    whole = world.search(MapSearch(limit=20))
    sizes = [len(entry.model_dump_json()) for entry in whole.entries]
    for count in (1, 3, 19, 20):
        page = world.search(MapSearch(limit=20, max_bytes=sum(sizes[:count])))
        assert page.entries == whole.entries[:count]
        assert all_pages(world, MapSearch(limit=20, max_bytes=sum(sizes[:count]))) == all_pages(
            world, MapSearch(limit=50)
        )
    assert world.search(MapSearch(limit=20, max_bytes=1)).entries == whole.entries[:1]
    near = MapSearch(near=Near(49.0, 8.4, 90_000.0), limit=20)
    assert all_pages(world, near.model_copy(update={"max_bytes": 1})) == all_pages(world, near)


def test_what_nobody_can_mean_is_refused():
    for wrong in ({"limit": 0}, {"limit": 10**9}, {"order": (("colour", True),)}, {"boxx": EVERYWHERE}):
        with pytest.raises(ValidationError):
            MapSearch(**wrong)
    assert MapSearch(geometry=shapely.Point()).geometry.is_empty


@pytest.mark.parametrize("nothing", [{"geometry": shapely.Polygon()}, {"ids": ()}], ids=["geometry", "names"])
def test_who_asks_for_nothing_gets_nothing(world, nothing):
    page = world.search(MapSearch(**nothing))
    assert (page.entries, page.after, page.matched) == ((), None, 0)
    assert world.search(MapSearch(near=Near(49.0, 8.4, 1e6), **nothing)).entries == ()
    assert world.parts_of([]) == {}


def statements(database: Database, work: Callable[[], object]) -> list[tuple[str, object]]:
    """The SQL that reaches SQLite while some work is done."""
    seen: list[tuple[str, object]] = []

    def note(connection, cursor, statement, parameters, context, many) -> None:
        seen.append((statement, parameters))

    sa.event.listen(database._engine, "before_cursor_execute", note)
    work()
    sa.event.remove(database._engine, "before_cursor_execute", note)
    return [(statement, parameters) for statement, parameters in seen if "SELECT" in statement]


@pytest.mark.parametrize("world", ["sqlite"], indirect=True)
@pytest.mark.parametrize("descending", [False, True])
@pytest.mark.parametrize("field", FIELDS)
def test_a_first_page_reads_an_index_and_sorts_nothing(world, field, descending, monkeypatch):
    monkeypatch.setattr(map_search, "_matched", lambda *_: None)
    asked = statements(world.database, lambda: world.search(MapSearch(order=((field, descending),), limit=10)))
    with world.database.reading() as connection:
        plans = [
            " ".join(str(row.detail) for row in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {sql}", values))
            for sql, values in asked
        ]
    assert len(plans) == 2
    assert "USING INDEX" in plans[0]
    assert "TEMP B-TREE" not in plans[0]
    assert "SCAN" not in plans[1]
