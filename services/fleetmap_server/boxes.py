"""Boxes and outlines on the globe: what meets what, in SQL for the candidates and in shapely to be exact.

A box is (west, south, east, north) in degrees; west > east crosses 180 degrees.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import shapely
import sqlalchemy as sa
from shapely.geometry.base import BaseGeometry
from sqlalchemy.engine import Connection

LonLatBox = tuple[float, float, float, float]
Fragment = tuple[str, dict[str, Any]]  # SQL and the values of the names in it


def halves(box: LonLatBox) -> tuple[LonLatBox, ...]:
    """The box itself, or, if it crosses 180 degrees, what lies on either side."""
    west, south, east, north = box
    if west <= east:
        return (box,)
    return ((west, south, 180.0, north), (-180.0, south, east, north))


def region(box: LonLatBox) -> BaseGeometry:
    """The box as a shapely geometry in longitude and latitude; a point or line where it has no extent."""
    return shapely.union_all([shapely.envelope(shapely.MultiPoint([half[:2], half[2:]])) for half in halves(box)])


def regions_of(box: LonLatBox | None, geometry: BaseGeometry | None) -> list[BaseGeometry]:
    """What a trajectory has to meet, all of them, prepared for being asked often."""
    regions = [region(box)] if box is not None else []
    if geometry is not None:
        regions.append(geometry)
    for one in regions:
        shapely.prepare(one)
    return regions


def outline(path_lonlat: Sequence[tuple[float, float]], box: LonLatBox) -> BaseGeometry:
    """A trajectory as lines, cut where it crosses 180 degrees; its box if there is no trajectory."""
    if not path_lonlat:
        return region(box)
    pieces = _cut_at_180(path_lonlat)
    if len(pieces) == 1:
        return shapely.Point(pieces[0]) if len(pieces[0]) == 1 else shapely.LineString(pieces[0])
    return shapely.MultiLineString([piece if len(piece) > 1 else piece * 2 for piece in pieces])


def meets(box: LonLatBox, name: str = "box") -> Fragment:
    """SQL that holds for rows whose columns west, south, east, north meet ``box``.

    Two intervals of longitude meet if each begins before the other ends. If one of them crosses 180 degrees,
    one of these is enough; if both do, they meet there.
    """
    west, south, east, north = box
    begins, ends = f"west <= :{name}_east", f"east >= :{name}_west"
    if west <= east:
        longitudes = f"(CASE WHEN west <= east THEN {begins} AND {ends} ELSE {begins} OR {ends} END)"
    else:
        longitudes = f"(west > east OR {begins} OR {ends})"
    sql = f"{longitudes} AND south <= :{name}_north AND north >= :{name}_south"
    return sql, {f"{name}_west": west, f"{name}_south": south, f"{name}_east": east, f"{name}_north": north}


def lies_in(box: LonLatBox, name: str = "box") -> Fragment:
    """SQL that holds for rows whose boxes lie in ``box``; never for those that cross 180 degrees."""
    terms, values = list[str](), dict[str, Any]()
    for number, half in enumerate(halves(box)):
        w, s, e, n = names = [f"{name}_in{number}{side}" for side in "wsen"]
        terms.append(f"(west >= :{w} AND south >= :{s} AND east <= :{e} AND north <= :{n})")
        values |= dict(zip(names, half, strict=True))
    return f"(west <= east AND ({' OR '.join(terms)}))", values


def indexed(dialect: str, table: str, boxes: Iterable[LonLatBox]) -> Fragment:
    """A query of the serials whose indexed boxes meet any of some; a few too many, and possibly some twice."""
    parts, values = list[str](), dict[str, Any]()
    for number, (west, south, east, north) in enumerate(half for box in boxes for half in halves(box)):
        names = [f"i{number}_{side}" for side in "wsen"]
        values |= dict(zip(names, (west, south, east, north), strict=True))
        w, s, e, n = (f"CAST(:{name} AS DOUBLE PRECISION)" for name in names)
        if dialect == "sqlite":
            where = f"west <= {e} AND east >= {w} AND south <= {n} AND north >= {s}"
        else:
            where = f"box && ST_MakeEnvelope({w}, {s}, {e}, {n}, 4326)"
        parts.append(f"SELECT serial FROM {table} WHERE {where}")
    return " UNION ALL ".join(parts), values


def add_to_index(connection: Connection, table: str, serial: int, box: LonLatBox) -> None:
    """Make ``indexed`` find a row of ``versions`` or ``drives`` by its box."""
    both = [dict(zip("wsen", half, strict=True)) for half in halves(box)]
    if connection.dialect.name == "sqlite":
        sql = f"INSERT INTO {table} (west, south, east, north, serial) VALUES (:w, :s, :e, :n, :serial)"
        connection.execute(sa.text(sql), [half | {"serial": serial} for half in both])
        return
    polygons = ", ".join(f"ST_MakeEnvelope(:w{k}, :s{k}, :e{k}, :n{k}, 4326)" for k in range(len(both)))
    values = {f"{side}{k}": degrees for k, half in enumerate(both) for side, degrees in half.items()}
    sql = f"INSERT INTO {table} (serial, box) VALUES (:serial, ST_Collect(ARRAY[{polygons}]))"
    connection.execute(sa.text(sql), values | {"serial": serial})


def remove_from_index(connection: Connection, table: str, serial: int, box: LonLatBox) -> None:
    """Undo ``add_to_index``."""
    if connection.dialect.name == "sqlite":  # by place: the serial is not what the R*Tree is ordered by
        found, values = indexed("sqlite", table, [box])
        rows = found.replace("SELECT serial", "SELECT id, serial")
        sql = f"DELETE FROM {table} WHERE id IN (SELECT id FROM ({rows}) AS found WHERE serial = :serial)"
        connection.execute(sa.text(sql), values | {"serial": serial})
        return
    connection.execute(sa.text(f"DELETE FROM {table} WHERE serial = :serial"), {"serial": serial})


def _cut_at_180(path: Sequence[tuple[float, float]]) -> list[list[tuple[float, float]]]:
    pieces = [[path[0]]]
    for (lon, lat), (next_lon, next_lat) in pairwise(path):
        if abs(next_lon - lon) > 180.0:
            side = 180.0 if lon > 0.0 else -180.0
            ahead = next_lon + 2.0 * side  # the next longitude as it would be without the jump
            along = (side - lon) / (ahead - lon) if ahead != lon else 0.0
            crossing_lat = lat + along * (next_lat - lat)
            pieces[-1].append((side, crossing_lat))
            pieces.append([(-side, crossing_lat)])
        pieces[-1].append((next_lon, next_lat))
    return pieces
