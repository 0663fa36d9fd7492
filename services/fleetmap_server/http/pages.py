"""The catalogue to look at in a browser, without any script: maps, drives and jobs.

The pages are there for those who ask for HTML; to others the same addresses are data, or nothing.
"""

from __future__ import annotations

from typing import Annotated
from urllib.parse import urlsplit

from fastapi import APIRouter, Path, Query, Request
from fastapi.responses import HTMLResponse

from fleetmap.catalogue import NEAR_RADIUS_M
from fleetmap.manifest import MAP_ID_PATTERN
from fleetmap_server.drive_search import DriveSearch
from fleetmap_server.http.addresses import base_address
from fleetmap_server.http.drive_pages import drive_page, drives_page, jobs_page
from fleetmap_server.http.front_page import front_page
from fleetmap_server.http.map_pages import Asked, map_page, maps_page
from fleetmap_server.http.negotiation import PageRoute
from fleetmap_server.library import MapLibrary
from fleetmap_server.map_names import map_ids_with
from fleetmap_server.problems import BadRequestError
from fleetmap_server.search import MapSearch, Near, SearchPage

_ROWS, _NEWEST = 50, 10

_Cursor = Annotated[str | None, Query(max_length=4000)]
_Words = Annotated[str, Query(max_length=200)]
_MapId = Annotated[str, Path(pattern=MAP_ID_PATTERN)]
_Sha256 = Annotated[str, Path(pattern="^[0-9a-f]{64}$")]


def page_router(library: MapLibrary, zenoh_endpoint: str) -> APIRouter:
    """All pages; ``zenoh_endpoint`` is where the server listens."""
    router = APIRouter(route_class=PageRoute, include_in_schema=False)

    @router.api_route("/", methods=["GET", "HEAD"])
    def front(request: Request) -> HTMLResponse:
        newest = library.search(MapSearch(limit=_NEWEST)).entries
        drives, jobs = library.drives.count(), library.jobs.counts()
        return front_page(newest, library.count(), drives, jobs, _reached(request, zenoh_endpoint))

    @router.api_route("/maps", methods=["GET", "HEAD"])
    def maps(name: _Words = "", place: _Words = "", radius_km: _Words = "", after: _Cursor = None) -> HTMLResponse:
        asked = Asked(name.strip(), place.strip(), radius_km.strip())
        found = _find(library, asked, after)
        return maps_page(found.entries, found.after, asked, further=after is not None)

    @router.api_route("/maps/{map_id}", methods=["GET", "HEAD"])
    def one_map(request: Request, map_id: _MapId, version: _Words = "") -> HTMLResponse:
        entry = library.entry(map_id, version or None)
        return map_page(
            entry,
            library.versions(map_id),
            library.catalogue.parts(entry.version),
            library.manifest(entry.version),
            _reached(request, zenoh_endpoint),
            base_address(request),
        )

    @router.api_route("/drives", methods=["GET", "HEAD"])
    def drives(after: _Cursor = None) -> HTMLResponse:
        found = library.drives.search(DriveSearch(limit=_ROWS, after=after))
        return drives_page(found.entries, found.after)

    @router.api_route("/drives/{sha256}", methods=["GET", "HEAD"])
    def drive(sha256: _Sha256) -> HTMLResponse:
        return drive_page(library.drives.get(sha256), library.jobs.page(drive=sha256).jobs)

    @router.api_route("/jobs", methods=["GET", "HEAD"])
    def jobs(after: _Cursor = None) -> HTMLResponse:
        found = library.jobs.page(limit=_ROWS, after=after)
        return jobs_page(found.jobs, library.jobs.counts(), found.next_after)

    return router


def _find(library: MapLibrary, asked: Asked, after: str | None) -> SearchPage:
    ids = map_ids_with(library.storage.database, asked.name) if asked.name else None
    if ids == ():
        return SearchPage((), None, 0)
    return library.search(MapSearch(near=_near(asked), ids=ids, limit=_ROWS, after=after))


def _near(asked: Asked) -> Near | None:
    if not asked.place:
        return None
    try:
        lat_deg, lon_deg = (float(field) for field in asked.place.replace(",", " ").split())
        radius_m = 1000.0 * float(asked.radius_km) if asked.radius_km else NEAR_RADIUS_M
    except ValueError as error:
        raise _no_place(asked) from error
    if not (-90.0 <= lat_deg <= 90.0 and -180.0 <= lon_deg <= 180.0 and 0.0 < radius_m <= 20_000_000.0):
        raise _no_place(asked)
    return Near(lat_deg, lon_deg, radius_m)


def _no_place(asked: Asked) -> BadRequestError:
    within = f" within {asked.radius_km} km" if asked.radius_km else ""
    return BadRequestError(
        f"'{asked.place}'{within} is no place; write latitude and longitude in degrees, for instance 49.011, 8.417"
    )


def _reached(request: Request, zenoh_endpoint: str) -> str:
    """The endpoint as a reader of the page reaches it: by the name that was asked for."""
    protocol, _, address = zenoh_endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if host.strip("[]") not in ("0.0.0.0", "::"):
        return zenoh_endpoint
    name = urlsplit(base_address(request)).hostname or "127.0.0.1"
    return f"{protocol}/[{name}]:{port}" if ":" in name else f"{protocol}/{name}:{port}"
