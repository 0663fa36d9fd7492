"""How latest versions are found: a few candidates by their boxes, or many in the order that is asked for.

Boxes only choose candidates. Whether a map meets a box or a geometry is decided by its trajectory.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import shapely
import sqlalchemy as sa
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry
from sqlalchemy.engine import Connection, Row

from fleetmap.catalogue import box_corners, distances_m, search_box_lonlat
from fleetmap_server.boxes import Fragment, LonLatBox, indexed, lies_in, meets, regions_of
from fleetmap_server.keyset import Keyset, Term
from fleetmap_server.search import Key, MapField, MapSearch, Near, SearchPage, fitting, read_cursor, write_cursor
from fleetmap_server.version_rows import entries_of

_COLUMNS: dict[MapField, tuple[str, type[Key]]] = {
    "published": ("published_ns", int),
    "datetime": ("start_ns", int),
    "id": ("map_id", str),
    "length_m": ("length_m", float),
    "landmarks": ("landmarks", int),
    "size_bytes": ("size_bytes", int),
}
_FEW = 250  # so many candidates are sorted; of more, the index of the order is followed
_LARGEST_SLICE = 2000  # rows read at once while following an index
_PARTS_APART = 8  # of a geometry, whose boxes are looked for one by one
_COUNTED = 100  # so many trajectories are looked at just to tell how many match

Rows = Sequence[Row[Any]]


def find(connection: Connection, search: MapSearch) -> SearchPage:
    """One page of a search. Raises BadRequestError for a cursor that is not of this search."""
    if search.near is not None:
        return _find_near(connection, search, search.near)
    order = _order(search)
    few = _few_candidates(connection, search, order)
    pieces = _sliced(few, search.limit + 1) if few is not None else _following(connection, search, order)
    regions = regions_of(search.box, search.geometry)
    rows: list[Row[Any]] = []
    for piece in pieces:
        rows += _meeting(connection, piece, regions)
        if len(rows) > search.limit:
            break
    entries = fitting(entries_of(connection, [row.serial for row in rows[: search.limit]]), search.max_bytes)
    after = order.cursor(rows[len(entries) - 1]) if len(rows) > len(entries) else None
    if search.after is not None:
        return SearchPage(entries, after, None)
    matched = len(entries) if after is None else _matched(connection, search, few, regions)
    return SearchPage(entries, after, matched)


def _order(search: MapSearch) -> Keyset:
    """The map's id decides a tie."""
    fields = dict(search.order)
    fields.setdefault("id", list(fields.values())[-1] if fields else True)
    return Keyset("maps", [Term(*_COLUMNS[field], down) for field, down in fields.items()], search.after)


def _few_candidates(connection: Connection, search: MapSearch, order: Keyset) -> Rows | None:
    """All rows whose boxes meet what is searched, in order, if they are few; None if they are many."""
    boxes = _boxes(search)
    if not boxes:
        return None if boxes is None else []
    found, box_values = indexed(connection.dialect.name, "map_boxes", boxes)
    counted = f"SELECT count(*) FROM (SELECT serial FROM ({found}) AS found LIMIT {_FEW + 1}) AS counted"
    if connection.execute(sa.text(counted), box_values).scalar_one() > _FEW:
        return None
    sql, values = _candidates(search, order, order.begin)
    # The index of boxes holds latest versions only; not to say so keeps SQLite from following the order's index.
    sql = f"{sql} AND serial IN ({found}) ORDER BY {order.sql}"
    return _run(connection, sql, values | box_values)


def _following(connection: Connection, search: MapSearch, order: Keyset) -> Iterator[Rows]:
    """Rows whose boxes meet what is searched, in order, as many at once as will hardly be too many."""
    place, count = order.begin, search.limit + 1
    while True:
        sql, values = _candidates(search, order, place)
        rows = _run(connection, f"{sql} AND is_latest = 1 ORDER BY {order.sql} LIMIT {count}", values)
        yield rows
        if len(rows) < count:
            return
        place, count = order.keys(rows[-1]), min(2 * count, _LARGEST_SLICE)


def _sliced(rows: Rows, count: int) -> Iterator[Rows]:
    for start in range(0, len(rows), count):
        yield rows[start : start + count]


def _candidates(search: MapSearch, order: Keyset, place: tuple[Key, ...] | None) -> Fragment:
    """Serials and places in the order of rows behind a place, and whether they surely meet what is searched."""
    where, values = _conditions(search)
    behind, keys = order.behind(place)
    is_sure, box = "1", dict[str, Any]()
    if search.geometry is not None:
        is_sure = "0"
    elif search.box is not None:
        inside, box = lies_in(search.box)
        is_sure = f"CASE WHEN {inside} THEN 1 ELSE 0 END"
    columns = ", ".join(dict.fromkeys([*(_COLUMNS[field][0] for field, _ in search.order), "map_id"]))
    sql = f"SELECT serial, {is_sure} AS is_sure, {columns} FROM versions WHERE {where} AND {behind}"
    return sql, values | keys | box


def _conditions(search: MapSearch) -> tuple[str, dict[str, Any]]:
    """What rows have to fulfil, as far as SQL can tell."""
    terms, values = ["1 = 1"], dict[str, Any]()
    boxes = _boxes(search)
    if boxes is not None:
        fragments = [meets(box, f"b{number}") for number, box in enumerate(boxes)]
        terms.append("(" + " OR ".join(sql for sql, _ in fragments) + ")" if fragments else "1 = 0")
        for _, named in fragments:
            values |= named
    if search.start_ns is not None:
        terms.append("end_ns >= :start_ns")
        values["start_ns"] = search.start_ns
    if search.end_ns is not None:
        terms.append("start_ns <= :end_ns")
        values["end_ns"] = search.end_ns
    if search.ids is not None:
        terms.append("map_id IN :ids" if search.ids else "1 = 0")
        values |= {"ids": list(search.ids)} if search.ids else {}
    return " AND ".join(terms), values


def _boxes(search: MapSearch) -> list[LonLatBox] | None:
    """Boxes of which a map's must meet one, to be looked at; None for everywhere."""
    if search.geometry is None:
        return None if search.box is None else [search.box]
    parts = [part for part in shapely.get_parts(search.geometry) if not part.is_empty]
    return [part.bounds for part in (parts if len(parts) <= _PARTS_APART else [search.geometry])]


def _meeting(connection: Connection, rows: Rows, regions: Sequence[BaseGeometry]) -> Rows:
    """Those rows whose trajectories meet all regions."""
    unsure = [row for row in rows if not row.is_sure]
    if not unsure:
        return rows
    found = _run(
        connection, "SELECT serial, outline FROM versions WHERE serial IN :serials",
        {"serials": [row.serial for row in unsure]},
    )  # fmt: skip
    outlines = shapely.from_wkb([row.outline for row in found])
    misses: set[int] = set()
    for one in regions:
        meeting = shapely.intersects(one, outlines)
        misses |= {row.serial for row, meets_it in zip(found, meeting, strict=True) if not meets_it}
    return [row for row in rows if row.serial not in misses]


def _matched(
    connection: Connection, search: MapSearch, few: Rows | None, regions: Sequence[BaseGeometry]
) -> int | None:
    """How many maps are found on all pages, where that is quickly known."""
    if few is not None:
        unsure = sum(not row.is_sure for row in few)
        return None if unsure > _COUNTED else len(_meeting(connection, few, regions))
    if regions or search.start_ns is not None or search.end_ns is not None:
        return None
    where, values = _conditions(search)
    return int(_run(connection, f"SELECT count(*) FROM versions WHERE is_latest = 1 AND {where}", values)[0][0])


def _find_near(connection: Connection, search: MapSearch, near: Near) -> SearchPage:
    """Nearest first, within the radius."""
    order = f"maps near {near}"
    begin = read_cursor(order, search.after, (float, str)) if search.after is not None else None
    placed = sorted(_placed_near(connection, search, near))
    within = [(key, serial) for key, serial in placed if begin is None or key > begin]
    entries = fitting(entries_of(connection, [serial for _, serial in within[: search.limit]]), search.max_bytes)
    after = write_cursor(order, within[len(entries) - 1][0]) if len(within) > len(entries) else None
    return SearchPage(entries, after, len(within) if begin is None else None)


def _placed_near(connection: Connection, search: MapSearch, near: Near) -> Iterator[tuple[tuple[float, str], int]]:
    """Distance and id, and the serial, of maps within the radius; never many trajectories in memory at once."""
    regions = regions_of(search.box, search.geometry)
    for piece in _sliced(_around(connection, search, near), _LARGEST_SLICE):
        rows = _run(connection, _NEAR, {"serials": [row.serial for row in _meeting(connection, piece, regions)]})
        distances = distances_m([_path_lonlat(row) for row in rows], near.lat_deg, near.lon_deg)
        for distance_m, row in zip(map(float, distances), rows, strict=True):
            if distance_m <= near.radius_m:
                yield (distance_m, row.map_id), row.serial


_NEAR = "SELECT serial, map_id, west, south, east, north, outline FROM versions WHERE serial IN :serials"


def _around(connection: Connection, search: MapSearch, near: Near) -> Rows:
    """Serials of what may lie within the radius."""
    around = search_box_lonlat(near.lat_deg, near.lon_deg, near.radius_m)
    where, values = _conditions(search)
    meets_it, around_values = meets(around, "near")
    found, box_values = indexed(connection.dialect.name, "map_boxes", [around])
    is_sure = int(search.box is None and search.geometry is None)
    sql = f"SELECT serial, {is_sure} AS is_sure FROM versions WHERE serial IN ({found}) AND {where} AND {meets_it}"
    return _run(connection, sql, values | around_values | box_values)


def _path_lonlat(row: Row[Any]) -> NDArray[np.float64]:
    """What MapEntry.distance_m measures from: the trajectory, or the box of a map without one; (N, 2)."""
    path = shapely.from_wkb(row.outline)
    if shapely.get_dimensions(path) == 2:
        return np.array(box_corners((row.west, row.south, row.east, row.north)))
    return np.asarray(shapely.get_coordinates(path), dtype=np.float64)


def _run(connection: Connection, sql: str, values: dict[str, Any]) -> Rows:
    """All rows; values that are lists stand for lists in SQL."""
    lists = [name for name, value in values.items() if isinstance(value, list)]
    statement = sa.text(sql).bindparams(*(sa.bindparam(name, expanding=True) for name in lists))
    return connection.execute(statement, values).all()
