"""What one may ask of the catalogue, and the pages in which it answers.

A page ends with a cursor that names the last item by what the search orders by. The next page begins behind that
place, so nothing is told twice and nothing is left out, whatever is added meanwhile. A map that gets a new version
meanwhile counts as removed at its old place and added at its new one.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field
from shapely.geometry.base import BaseGeometry

from fleetmap.catalogue import MapEntry
from fleetmap_server.boxes import LonLatBox
from fleetmap_server.problems import BadRequestError

MapField = Literal["published", "datetime", "id", "length_m", "landmarks", "size_bytes"]
NEWEST_FIRST: tuple[tuple[MapField, bool], ...] = (("published", True),)
MAX_PAGE = 10_000

Key = float | int | str


@dataclass(frozen=True)
class Near:
    """A place, and how far from it a map's trajectory may pass."""

    lat_deg: float
    lon_deg: float
    radius_m: float


class MapSearch(BaseModel):
    """Which latest versions to find, and in which order; what is None does not matter."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    box: LonLatBox | None = None  # that the trajectory meets
    geometry: BaseGeometry | None = None  # in longitude and latitude, that the trajectory meets
    near: Near | None = None  # the nearest come first; ``order`` is not looked at then
    start_ns: int | None = None  # of an interval that the survey overlaps, both ends included
    end_ns: int | None = None
    ids: tuple[str, ...] | None = None
    order: tuple[tuple[MapField, bool], ...] = NEWEST_FIRST  # (field, whether descending); the id decides a tie
    limit: int = Field(default=50, ge=1, le=MAX_PAGE)
    max_bytes: int | None = None  # of all entries as JSON; the first counts whatever its size
    after: str | None = None  # the cursor of the page before


@dataclass(frozen=True)
class SearchPage:
    """One page of what was found."""

    entries: tuple[MapEntry, ...]
    after: str | None  # the cursor for the next page, None at the end
    matched: int | None  # on all pages, told with the first; None where it would cost too much to know


def fitting(entries: Sequence[MapEntry], max_bytes: int | None) -> tuple[MapEntry, ...]:
    """As many entries as so many bytes of JSON hold, one at least."""
    if max_bytes is None:
        return tuple(entries)
    ends = accumulate(len(entry.model_dump_json()) for entry in entries)
    return tuple(entries[: max(sum(end <= max_bytes for end in ends), 1)])


def write_cursor(order: str, keys: tuple[Key, ...]) -> str:
    """An opaque, URL-safe name of a place in an order; ``order`` says which, for ``read_cursor`` to check."""
    text = json.dumps([_digest(order), *keys], separators=(",", ":"))
    return _encoded(text.encode())


def read_cursor(order: str, cursor: str, kinds: tuple[type, ...]) -> tuple[Key, ...]:
    """The place that a cursor names, as values of the given types (float, int, str).

    Raises:
        BadRequestError: it is no cursor, or one of a search in another order.
    """
    try:
        text = base64.b64decode(cursor.encode("ascii") + b"=" * (-len(cursor) % 4), altchars=b"-_", validate=True)
        found = json.loads(text, parse_constant=_refuse_constant)
    except (UnicodeEncodeError, binascii.Error, ValueError, RecursionError) as error:
        raise _no_cursor(cursor) from error
    is_ours = _encoded(text) == cursor and isinstance(found, list) and found[:1] == [_digest(order)]
    if not is_ours or len(found) != 1 + len(kinds):
        raise _no_cursor(cursor)
    return tuple(_key(value, kind, cursor) for value, kind in zip(found[1:], kinds, strict=True))


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no place in an order")


def _key(value: object, kind: type, cursor: str) -> Key:
    if kind is float and isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**53:
        return float(value)
    if type(value) is not kind or not isinstance(value, (int, float, str)):
        raise _no_cursor(cursor)
    if (isinstance(value, int) and abs(value) >= 2**63) or (isinstance(value, str) and "\0" in value):
        raise _no_cursor(cursor)
    return value


def _encoded(text: bytes) -> str:
    return base64.urlsafe_b64encode(text).decode().rstrip("=")


def _digest(order: str) -> str:
    return hashlib.sha256(order.encode()).hexdigest()[:8]


def _no_cursor(cursor: str) -> BadRequestError:
    return BadRequestError(f"'{cursor[:60]}' is no page of this search; begin again with the first page")
