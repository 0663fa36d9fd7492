"""Pages of items out of several collections at once, in one order.

Each collection has a cursor of its own; the token of a page holds them all. A page takes what comes first from all
collections, and asks each again for as many as were taken of it, to learn its cursor there: both within one
snapshot of the catalogue, so nothing is told twice and nothing is left out.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cmp_to_key
from typing import Any

from sqlalchemy.engine import Connection

from fleetmap.catalogue import MapEntry
from fleetmap.jobs import DriveEntry
from fleetmap_server.database import Database
from fleetmap_server.drive_search import DriveField, DrivePage, DriveSearch, find_drives
from fleetmap_server.http.stac_documents import DRIVES, MAPS
from fleetmap_server.http.stac_search import ItemSearch
from fleetmap_server.map_search import find
from fleetmap_server.problems import BadRequestError
from fleetmap_server.search import MapField, MapSearch, SearchPage

MAX_PAGE_BYTES = 4 * 1024 * 1024  # of the entries of one collection, as JSON

Entry = MapEntry | DriveEntry
_Page = SearchPage | DrivePage
_Order = tuple[tuple[MapField, bool], ...]

_DRIVE_FIELDS: dict[MapField, DriveField] = {
    "published": "received", "datetime": "datetime", "id": "id", "size_bytes": "size_bytes"
}  # fmt: skip
_MAP_KEYS: dict[MapField, Callable[[MapEntry], Any]] = {
    "published": lambda entry: entry.published_ns,
    "datetime": lambda entry: entry.start_ns,
    "id": lambda entry: entry.map_id,
    "length_m": lambda entry: entry.length_m,
    "landmarks": lambda entry: entry.landmarks,
    "size_bytes": lambda entry: entry.size_bytes,
}
_DRIVE_KEYS: dict[MapField, Callable[[DriveEntry], Any]] = {
    "published": lambda entry: entry.received_ns,
    "datetime": lambda entry: entry.received_ns if entry.start_ns is None else entry.start_ns,
    "id": lambda entry: entry.sha256,
    "size_bytes": lambda entry: entry.size_bytes,
}


@dataclass(frozen=True)
class ItemPage:
    """What was found, and where to go on; ``token`` is None at the end."""

    entries: tuple[Entry, ...]
    token: str | None
    matched: int | None  # on all pages; None where it would cost too much to know


def item_page(database: Database, search: ItemSearch) -> ItemPage:
    """One page of a search. Raises BadRequestError for a token that is not of this search."""
    cursors = _cursors(search)
    if search.ids == ():
        return ItemPage((), None, 0)
    with database.reading() as connection:
        pages = {name: _ask(connection, name, search, after, search.limit) for name, after in cursors.items()}
        entries = _first(pages, search)
        taken = Counter(collection_of(entry) for entry in entries)
        further = dict[str, str]()
        for name, page in pages.items():
            count = taken[name]
            if 0 < count < len(page.entries):
                page = _ask(connection, name, search, cursors[name], count)
            after = (cursors[name] or "") if count == 0 and page.entries else page.after
            if after is not None:
                further[name] = after
    matched = _total(pages) if search.token is None else None
    return ItemPage(tuple(entries), _token(further), matched)


def _ask(connection: Connection, name: str, search: ItemSearch, after: str | None, limit: int) -> _Page:
    wanted: dict[str, Any] = {
        "box": search.box,
        "geometry": search.geometry,
        "start_ns": search.start_ns,
        "end_ns": search.end_ns,
        "ids": search.ids,
        "limit": limit,
        "max_bytes": MAX_PAGE_BYTES,
        "after": after,
    }
    if name == MAPS:
        return find(connection, MapSearch(order=search.order, **wanted))
    order = tuple((_DRIVE_FIELDS[field], down) for field, down in search.order if field in _DRIVE_FIELDS)
    return find_drives(connection, DriveSearch(**wanted | ({"order": order} if order else {})))


def _first(pages: Mapping[str, _Page], search: ItemSearch) -> list[Entry]:
    """What comes first of all pages; it ends where one of them does that is not the last of its collection."""
    left = {name: len(page.entries) for name, page in pages.items() if page.after is not None}
    taken = list[Entry]()
    for entry in _merged([page.entries for page in pages.values()], search.order):
        taken.append(entry)
        name = collection_of(entry)
        if name in left:
            left[name] -= 1
        if len(taken) == search.limit or left.get(name) == 0:
            break
    return taken


def _merged(lists: list[tuple[Entry, ...]], order: _Order) -> Iterator[Entry]:
    """Sorted lists as one; what lacks a field comes after what has it."""

    def compare(a: Entry, b: Entry) -> int:
        for field, descending in order:
            first, second = _key(a, field), _key(b, field)
            if first == second:
                continue
            if first is None or second is None:
                return 1 if first is None else -1
            return -1 if (first > second) == descending else 1
        return 0

    return heapq.merge(*lists, key=cmp_to_key(compare))


def _key(entry: Entry, field: MapField) -> Any:
    if isinstance(entry, MapEntry):
        return _MAP_KEYS[field](entry)
    return _DRIVE_KEYS[field](entry) if field in _DRIVE_KEYS else None


def collection_of(entry: Entry) -> str:
    """The collection that it is an item of."""
    return MAPS if isinstance(entry, MapEntry) else DRIVES


def _total(pages: Mapping[str, _Page]) -> int | None:
    counts = [page.matched for page in pages.values()]
    return None if None in counts else sum(count for count in counts if count is not None)


def _token(cursors: Mapping[str, str]) -> str | None:
    return ".".join(f"{name}~{cursor}" for name, cursor in cursors.items()) or None


def _cursors(search: ItemSearch) -> dict[str, str | None]:
    """Where to go on in which collection; a collection that the token does not name is at its end."""
    if search.token is None:
        return dict.fromkeys(search.collections)
    found = dict[str, str | None]()
    for one in search.token.split("."):
        name, tilde, cursor = one.partition("~")
        if not tilde or name not in search.collections or name in found:
            raise BadRequestError(f"'{search.token[:60]}' is no page of this search; begin with the first page")
        found[name] = cursor or None
    return found
