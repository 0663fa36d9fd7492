"""What one may ask of the list of drives, and how they are found: by place, time and name, page by page."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import shapely
import sqlalchemy as sa
from pydantic import BaseModel, ConfigDict, Field
from shapely.geometry.base import BaseGeometry
from sqlalchemy.engine import Connection, Row

from fleetmap.jobs import DriveEntry
from fleetmap_server.boxes import LonLatBox, indexed, outline, regions_of
from fleetmap_server.drive_rows import COLUMNS, drive_entry
from fleetmap_server.keyset import Keyset, Term

DriveField = Literal["received", "datetime", "id", "size_bytes"]
NEWEST_DRIVES_FIRST: tuple[tuple[DriveField, bool], ...] = (("received", True),)
MAX_DRIVES = 10_000

_SLICE = 200  # rows read at once
_TERMS: dict[DriveField, Term] = {
    "received": Term("received_ns", int, True),
    "datetime": Term("begins_ns", int, True, sql="COALESCE(start_ns, received_ns)"),
    "id": Term("sha256", str, True),
    "size_bytes": Term("size_bytes", int, True),
}


class DriveSearch(BaseModel):
    """Which drives to find, and in which order; what is None does not matter."""

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True)

    box: LonLatBox | None = None  # that the trajectory meets
    geometry: BaseGeometry | None = None  # in longitude and latitude, that the trajectory meets
    start_ns: int | None = None  # of an interval that the drive, or else its arrival, overlaps; both ends included
    end_ns: int | None = None
    ids: tuple[str, ...] | None = None
    prefix: str | None = None  # of the id
    order: tuple[tuple[DriveField, bool], ...] = NEWEST_DRIVES_FIRST  # (field, whether descending)
    limit: int = Field(default=50, ge=1, le=MAX_DRIVES)
    max_bytes: int | None = None  # of all entries as JSON; the first counts whatever its size
    after: str | None = None  # the cursor of the page before


@dataclass(frozen=True)
class DrivePage:
    """One page of what was found."""

    entries: tuple[DriveEntry, ...]
    after: str | None  # the cursor for the next page, None at the end
    matched: int | None  # on all pages; None where it would cost too much to know


@dataclass(frozen=True)
class _Found:
    row: Row[Any]
    entry: DriveEntry


def find_drives(connection: Connection, search: DriveSearch) -> DrivePage:
    """One page of a search. Raises BadRequestError for a cursor that is not of this search."""
    order = _order(search)
    page: list[_Found] = []
    size_bytes = 0
    for found in _meeting(_in_order(connection, search, order), search):
        size_bytes += len(found.entry.model_dump_json())
        is_too_much = search.max_bytes is not None and size_bytes > search.max_bytes and bool(page)
        if is_too_much or len(page) == search.limit:
            return _page(page, order.cursor(page[-1].row), _matched(connection, search))
        page.append(found)
    return _page(page, None, _matched(connection, search))


def _page(page: list[_Found], after: str | None, matched: int | None) -> DrivePage:
    return DrivePage(tuple(found.entry for found in page), after, matched)


def _order(search: DriveSearch) -> Keyset:
    fields = dict(search.order)
    fields.setdefault("id", list(fields.values())[-1] if fields else True)
    terms = [Term(_TERMS[f].name, _TERMS[f].kind, down, _TERMS[f].sql) for f, down in fields.items()]
    return Keyset("drives", terms, search.after)


def _in_order(connection: Connection, search: DriveSearch, order: Keyset) -> Iterator[_Found]:
    """Drives whose boxes meet what is searched, however many there are."""
    where, values = _conditions(connection, search)
    place, count = order.begin, min(search.limit + 1, _SLICE)
    while True:
        behind, keys = order.behind(place)
        sql = f"{_SELECTED} WHERE {where} AND {behind} ORDER BY {order.sql} LIMIT {count}"
        rows = connection.execute(_statement(sql, search), values | keys).all()
        for row in rows:
            yield _Found(row, drive_entry(row))
        if len(rows) < count:
            return
        place, count = order.keys(rows[-1]), _SLICE


_SELECTED = f"SELECT {COLUMNS}, {_TERMS['datetime'].sql} AS begins_ns FROM drives"


def _conditions(connection: Connection, search: DriveSearch) -> tuple[str, dict[str, Any]]:
    terms, values = ["retired_ns IS NULL"], dict[str, Any]()
    if (boxes := _boxes(search)) is not None:
        found, box_values = indexed(connection.dialect.name, "drive_boxes", boxes)
        terms.append(f"serial IN ({found})" if found else "1 = 0")
        values |= box_values
    if search.start_ns is not None:
        terms.append("COALESCE(end_ns, received_ns) >= :start_ns")
        values["start_ns"] = search.start_ns
    if search.end_ns is not None:
        terms.append("COALESCE(start_ns, received_ns) <= :end_ns")
        values["end_ns"] = search.end_ns
    if search.ids is not None:
        terms.append("sha256 IN :ids" if search.ids else "1 = 0")
        values["ids"] = list(search.ids)
    if search.prefix is not None:
        terms.append("sha256 >= :prefix AND sha256 < :prefix_end")
        values |= {"prefix": search.prefix, "prefix_end": search.prefix + "g"}
    return " AND ".join(terms), values


def _boxes(search: DriveSearch) -> list[LonLatBox] | None:
    """Boxes of which a drive's must meet one, to be looked at; None for everywhere."""
    if search.geometry is not None:
        return [] if search.geometry.is_empty else [search.geometry.bounds]
    return None if search.box is None else [search.box]


def _meeting(drives: Iterator[_Found], search: DriveSearch) -> Iterator[_Found]:
    """Those drives whose trajectories meet what is searched; boxes only choose candidates."""
    regions = regions_of(search.box, search.geometry)
    for found in drives:
        box = found.entry.bbox_lonlat
        path = outline(found.entry.trajectory_lonlat, box) if regions and box is not None else None
        if all(path is not None and shapely.intersects(one, path) for one in regions):
            yield found


def _matched(connection: Connection, search: DriveSearch) -> int | None:
    if _boxes(search) is not None:
        return None
    where, values = _conditions(connection, search)
    return int(
        connection.execute(_statement(f"SELECT count(*) FROM drives WHERE {where}", search), values).scalar_one()
    )


def _statement(sql: str, search: DriveSearch) -> sa.TextClause:
    statement = sa.text(sql)
    return statement if not search.ids else statement.bindparams(sa.bindparam("ids", expanding=True))
