"""What a STAC client asks for: the parameters of a search, checked, as the catalogue's own search."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints
from shapely.geometry.base import BaseGeometry

from fleetmap.manifest import MAP_ID_PATTERN
from fleetmap_server.boxes import LonLatBox
from fleetmap_server.http.geojson import geometry_of
from fleetmap_server.http.stac_documents import COLLECTIONS
from fleetmap_server.problems import BadRequestError
from fleetmap_server.search import NEWEST_FIRST, MapField

DEFAULT_LIMIT, MAX_LIMIT = 10, 250  # OGC API - Features has ten by default, too

SORTABLE: dict[str, MapField] = {
    "id": "id",
    "datetime": "datetime",
    "start_datetime": "datetime",
    "published": "published",
    "updated": "published",
    "fleetmap:length_m": "length_m",
    "fleetmap:landmarks": "landmarks",
    "fleetmap:size_bytes": "size_bytes",
}

_MAX_INT64 = 2**63 - 1
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_RFC3339 = re.compile(r"(\d{4}-\d\d-\d\d)[Tt](\d\d:\d\d):(\d\d)(?:\.(\d+))?([Zz]|[+-]\d\d:\d\d)", re.ASCII)

_Bbox = Annotated[list[Annotated[float, Field(strict=True)]], Field(min_length=4, max_length=6)]
_Limit = Annotated[int, Field(ge=1, description=f"how many items a page may hold; {MAX_LIMIT} at most are given")]
_Token = Annotated[str, Field(max_length=4000, description="of the page before, as its 'next' link has it")]
_BBOX_HELP = (
    "west,south,east,north in degrees, with heights as 3rd and 6th number; west > east crosses 180 degrees"
)
_TIME_HELP = "a time of RFC 3339, or two of them with '/' between; '..' leaves an end open"
_SORT_HELP = "fields with + (ascending) or - before, for instance -properties.datetime,id"


class SearchParameters(BaseModel):
    """What narrows down a search, in the manner of GET."""

    model_config = ConfigDict(extra="forbid")

    ids: str | None = Field(default=None, description="item ids with commas between")
    collections: str | None = Field(default=None, description="collection ids with commas between")
    intersects: str | None = Field(default=None, description="a GeoJSON geometry")
    bbox: str | None = Field(default=None, description=_BBOX_HELP)
    datetime: str | None = Field(default=None, description=_TIME_HELP)
    limit: _Limit = DEFAULT_LIMIT
    sortby: str | None = Field(default=None, description=_SORT_HELP)
    token: _Token | None = None


class SortField(BaseModel):
    """One field to sort by."""

    model_config = ConfigDict(extra="forbid")

    field: Annotated[str, StringConstraints(max_length=100)]
    direction: Literal["asc", "desc"] = "asc"


class SearchBody(BaseModel):
    """What narrows down a search, in the manner of POST."""

    model_config = ConfigDict(extra="forbid")

    bbox: _Bbox | None = Field(default=None, description=_BBOX_HELP)
    intersects: dict[str, Any] | None = Field(default=None, description="a GeoJSON geometry")
    datetime: str | None = Field(default=None, description=_TIME_HELP)
    ids: list[str] | None = Field(default=None, max_length=1000)
    collections: list[str] | str | None = None
    limit: Annotated[_Limit, Field(strict=True)] = DEFAULT_LIMIT
    sortby: list[SortField] | None = Field(default=None, max_length=10)
    token: _Token | None = None


@dataclass(frozen=True)
class ItemSearch:
    """A search over some collections; what is None does not matter."""

    collections: tuple[str, ...] = COLLECTIONS
    box: LonLatBox | None = None
    geometry: BaseGeometry | None = None
    start_ns: int | None = None
    end_ns: int | None = None
    ids: tuple[str, ...] | None = None
    order: tuple[tuple[MapField, bool], ...] = NEWEST_FIRST
    limit: int = DEFAULT_LIMIT
    token: str | None = None


def search_of_parameters(parameters: SearchParameters) -> ItemSearch:
    """The search that the parameters of a GET ask for. Raises BadRequestError."""
    return _search(
        bbox=None if parameters.bbox is None else _numbers(parameters.bbox),
        intersects=None if parameters.intersects is None else _json(parameters.intersects),
        times=parameters.datetime,
        ids=_fields(parameters.ids),
        collections=_fields(parameters.collections),
        sortby=[_sort_field(field) for field in _fields(parameters.sortby) or []],
        limit=parameters.limit,
        token=parameters.token,
    )


def search_of_body(body: SearchBody) -> ItemSearch:
    """The search that the body of a POST asks for. Raises BadRequestError."""
    return _search(
        bbox=body.bbox,
        intersects=body.intersects,
        times=body.datetime,
        ids=body.ids,
        collections=[body.collections] if isinstance(body.collections, str) else body.collections,
        sortby=body.sortby or [],
        limit=body.limit,
        token=body.token,
    )


def _search(
    bbox: list[float] | None,
    intersects: object,
    times: str | None,
    ids: list[str] | None,
    collections: list[str] | None,
    sortby: list[SortField],
    limit: int,
    token: str | None,
) -> ItemSearch:
    if bbox is not None and intersects is not None:
        raise BadRequestError("a search is by bbox or by intersects, not by both")
    start_ns, end_ns = (None, None) if times is None else interval_ns(times)
    return ItemSearch(
        collections=tuple(name for name in COLLECTIONS if collections is None or name in collections),
        box=None if bbox is None else box_of(bbox),
        geometry=None if intersects is None else geometry_of(intersects),
        start_ns=start_ns,
        end_ns=end_ns,
        ids=None if ids is None else tuple(dict.fromkeys(one for one in ids if _ITEM_ID.fullmatch(one))),
        order=_order(sortby),
        limit=min(limit, MAX_LIMIT),
        token=token,
    )


_ITEM_ID = re.compile(rf"{MAP_ID_PATTERN.strip('^$')}|[0-9a-f]{{64}}")


def box_of(bbox: list[float]) -> LonLatBox:
    """A box of four numbers, or of six with heights, which do not matter. Raises BadRequestError."""
    if len(bbox) not in (4, 6):
        raise BadRequestError(f"bbox has 4 or 6 numbers, not {len(bbox)}: {_BBOX_HELP}")
    half = len(bbox) // 2
    west, south, east, north = *bbox[:2], *bbox[half : half + 2]
    if not all(-180.0 <= lon <= 180.0 for lon in (west, east)) or not -90.0 <= south <= north <= 90.0:
        raise BadRequestError("bbox does not hold: -180..180 and -90..90 degrees, south before north")
    return (west, south, east, north)


def interval_ns(times: str) -> tuple[int | None, int | None]:
    """Both ends in UTC nanoseconds since the epoch; None where one is open. Raises BadRequestError."""
    first, slash, last = times.partition("/")
    if not slash:
        return (instant_ns := _instant_ns(first)), _end_ns(instant_ns)
    start_ns, end_ns = (None if end in ("", "..") else _instant_ns(end) for end in (first, last))
    if start_ns is None and end_ns is None:
        raise BadRequestError(f"datetime '{times[:80]}' is open at both ends; leave it out instead")
    if start_ns is not None and end_ns is not None and start_ns > end_ns:
        raise BadRequestError(f"datetime '{times[:80]}' ends before it begins")
    return start_ns, None if end_ns is None else _end_ns(end_ns)


def _end_ns(stamp_ns: int) -> int:
    """Items tell whole microseconds, so one that is asked for is meant with all its nanoseconds."""
    return min(stamp_ns + 999, _MAX_INT64) if stamp_ns % 1000 == 0 else stamp_ns


def _instant_ns(text: str) -> int:
    """A time of RFC 3339, as far as 64 bits of nanoseconds reach."""
    found = _RFC3339.fullmatch(text)
    if found is None:
        raise _no_time(text)
    day, minute, second, fraction, zone = found.groups()
    try:  # a leap second is the first of the next minute
        whole = datetime.fromisoformat(f"{day}T{minute}:00{zone.upper()}") + timedelta(seconds=_second(second))
    except (ValueError, OverflowError) as error:
        raise _no_time(text) from error
    since = whole - _EPOCH
    stamp_ns = (since.days * 86_400 + since.seconds) * 1_000_000_000 + int(((fraction or "") + "0" * 9)[:9])
    return max(-_MAX_INT64, min(_MAX_INT64, stamp_ns))


def _second(text: str) -> int:
    if int(text) > 60:
        raise ValueError(text)
    return int(text)


def _no_time(text: str) -> BadRequestError:
    return BadRequestError(f"datetime '{text[:80]}' is none of RFC 3339, such as 2026-05-01T12:00:00Z")


def _order(sortby: list[SortField]) -> tuple[tuple[MapField, bool], ...]:
    order: dict[MapField, bool] = {}
    for one in sortby:
        field = SORTABLE.get(one.field.removeprefix("properties."))
        if field is None:
            raise BadRequestError(f"sortby knows no '{one.field[:60]}', but {', '.join(SORTABLE)}")
        order.setdefault(field, one.direction == "desc")
    return tuple(order.items()) or NEWEST_FIRST


def _sort_field(text: str) -> SortField:
    direction: Literal["asc", "desc"] = "desc" if text.startswith("-") else "asc"
    return SortField(field=text.lstrip(" ").removeprefix("-").removeprefix("+")[:100], direction=direction)


def _fields(text: str | None) -> list[str] | None:
    return None if text is None else [field for field in text.split(",") if field]


def _numbers(text: str) -> list[float]:
    try:
        return [float(field) for field in text.split(",")]
    except ValueError as error:
        raise BadRequestError(f"bbox '{text[:80]}' holds more than numbers: {_BBOX_HELP}") from error


def _json(text: str) -> object:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BadRequestError(f"intersects is no JSON: {error}") from error
