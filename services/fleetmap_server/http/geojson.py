"""Geometries that a client sends (RFC 7946), checked and turned into shapely's."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import shapely
from shapely.errors import ShapelyError
from shapely.geometry.base import BaseGeometry

from fleetmap_server.problems import BadRequestError

MAX_POSITIONS = 20_000  # of one geometry

Position = tuple[float, float]

# What the coordinates of each type are nested in, from the outside to the position.
_SHAPES: dict[str, tuple[str, ...]] = {
    "Point": (),
    "MultiPoint": ("points",),
    "LineString": ("line",),
    "MultiLineString": ("lines", "line"),
    "Polygon": ("rings", "ring"),
    "MultiPolygon": ("polygons", "rings", "ring"),
}
_BUILD: dict[str, Callable[[Any], BaseGeometry]] = {
    "Point": shapely.Point,
    "MultiPoint": shapely.MultiPoint,
    "LineString": shapely.LineString,
    "MultiLineString": shapely.MultiLineString,
    "Polygon": lambda rings: shapely.Polygon(rings[0], rings[1:]),
    "MultiPolygon": lambda polygons: shapely.MultiPolygon([(rings[0], rings[1:]) for rings in polygons]),
}
_FEWEST = {"line": 2, "ring": 4}


def geometry_of(document: object) -> BaseGeometry:
    """The geometry of a GeoJSON object, in longitude and latitude; polygons that cross themselves are mended.

    Raises:
        BadRequestError: it is none, lies beyond the globe, or has more than MAX_POSITIONS positions.
    """
    geometry = _collection(document) if _type_of(document) == "GeometryCollection" else _single(document)
    return geometry if geometry.is_valid else shapely.make_valid(geometry)


def _collection(document: object) -> BaseGeometry:
    members = document.get("geometries") if isinstance(document, dict) else None
    if not isinstance(members, list) or not members:
        raise _wrong("a GeometryCollection has a list of 'geometries'")
    return shapely.GeometryCollection([_single(member) for member in members])


def _single(document: object) -> BaseGeometry:
    kind = _type_of(document)
    if kind not in _SHAPES or not isinstance(document, dict):
        raise _wrong(f"its type must be one of {', '.join(_SHAPES)}, or a GeometryCollection of these")
    coordinates = _checked(document.get("coordinates"), _SHAPES[kind])
    if sum(1 for _ in _positions(coordinates)) > MAX_POSITIONS:
        raise _wrong(f"more than {MAX_POSITIONS} positions; simplify it")
    try:
        return _BUILD[kind](coordinates)
    except (ShapelyError, ValueError) as error:
        raise _wrong(" ".join(str(error).split())) from error


def _type_of(document: object) -> object:
    kind = document.get("type") if isinstance(document, dict) else None
    return kind if isinstance(kind, str) else None


def _checked(coordinates: object, shape: tuple[str, ...]) -> Any:
    """The coordinates as nested lists of positions, none of them empty."""
    if not isinstance(coordinates, list) or not coordinates:
        raise _wrong("its coordinates are no list, or an empty one")
    if not shape:
        return _position(coordinates)
    inside = [_checked(part, shape[1:]) for part in coordinates]
    if len(inside) < _FEWEST.get(shape[0], 1):
        raise _wrong(f"a {shape[0]} has at least {_FEWEST[shape[0]]} positions")
    if shape[0] == "ring" and inside[0] != inside[-1]:
        raise _wrong("a ring ends where it began")
    return inside


def _position(numbers: list[Any]) -> Position:
    """Longitude and latitude; a height does not matter here."""
    if len(numbers) < 2 or any(type(number) not in (int, float) for number in numbers[:2]):
        raise _wrong("a position is longitude and latitude in degrees")
    lon, lat = numbers[:2]
    if not (-180.0 <= lon <= 180.0 and -90.0 <= lat <= 90.0):
        raise _wrong("a position lies beyond -180..180 and -90..90 degrees")
    return (float(lon), float(lat))


def _positions(coordinates: Any) -> Iterator[Position]:
    if isinstance(coordinates, tuple):
        yield coordinates
        return
    for part in coordinates:
        yield from _positions(part)


def _wrong(reason: str) -> BadRequestError:
    return BadRequestError(f"the GeoJSON geometry does not hold: {reason}")
