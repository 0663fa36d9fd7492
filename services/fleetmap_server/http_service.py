"""The HTTP face: the maps as GeoJSON features in the manner of a STAC API, their manifests and parts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import FastAPI, Header, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse
from starlette.exceptions import HTTPException

from fleetmap import __version__
from fleetmap.errors import FleetmapError
from fleetmap.transport.protocol import Problem
from fleetmap_server.catalogue import LonLatBox
from fleetmap_server.features import collection, feature, landing_page
from fleetmap_server.library import MapLibrary
from fleetmap_server.problems import PROBLEM_MEDIA_TYPE, BadRequestError, NotFoundError, problem_of

MAX_LIMIT, DEFAULT_LIMIT = 1000, 100
_GEOJSON = "application/geo+json"


def create_app(library: MapLibrary) -> FastAPI:
    """The web application over a library that is open; routes raise, and one place turns errors into answers."""
    app = FastAPI(
        title="fleetmap map server", version=__version__, openapi_url="/api", docs_url=None, redoc_url=None
    )
    _explain_errors(app)
    _add_catalogue(app, library)
    _add_packages(app, library)
    return app


def _add_catalogue(app: FastAPI, library: MapLibrary) -> None:
    @app.get("/")
    def landing(request: Request) -> dict[str, Any]:
        return landing_page(_base(request))

    @app.get("/healthz")
    def health() -> dict[str, Any]:
        return {"status": "ok", "maps": library.count(), "version": __version__}

    @app.get("/collections")
    def collections(request: Request) -> dict[str, Any]:
        base = _base(request)
        return {"collections": [collection(base)], "links": [{"rel": "self", "href": f"{base}/collections"}]}

    @app.get("/collections/maps")
    def maps(request: Request) -> dict[str, Any]:
        return collection(_base(request))

    @app.get("/collections/maps/items")
    def items(
        request: Request,
        bbox: str | None = None,
        limit: Annotated[int, Query(ge=1)] = DEFAULT_LIMIT,
        offset: Annotated[int, Query(ge=0, le=2**31)] = 0,
    ) -> Response:
        box = None if bbox is None else _parse_bbox(bbox)
        limit = min(limit, MAX_LIMIT)
        found, matched = library.maps(box, limit, offset), library.count(box)
        return JSONResponse(
            {
                "type": "FeatureCollection",
                "features": [feature(entry, _base(request)) for entry in found],
                "numberMatched": matched,
                "numberReturned": len(found),
                "links": _page_links(request, offset + limit if offset + limit < matched else None),
            },
            media_type=_GEOJSON,
        )

    @app.get("/collections/maps/items/{map_id}")
    def item(request: Request, map_id: str) -> Response:
        return JSONResponse(feature(library.entry(map_id), _base(request)), media_type=_GEOJSON)


def _add_packages(app: FastAPI, library: MapLibrary) -> None:
    @app.get("/maps/{map_id}/manifest.json")
    def manifest(map_id: str, if_none_match: Annotated[str | None, Header()] = None) -> Response:
        path, version = library.manifest_path(map_id)
        headers = {"ETag": f'"{version}"', "Cache-Control": "no-cache"}
        if _has_tag(if_none_match, version):
            return Response(status_code=304, headers=headers)
        return FileResponse(path, media_type="application/json", headers=headers)

    @app.get("/maps/{map_id}/parts/{sha256}")
    def part(map_id: str, sha256: str, if_none_match: Annotated[str | None, Header()] = None) -> Response:
        path = library.part_path(map_id, sha256)
        headers = {"ETag": f'"{sha256}"', "Cache-Control": "public, max-age=31536000, immutable"}
        if _has_tag(if_none_match, sha256):
            return Response(status_code=304, headers=headers)
        return FileResponse(path, media_type="application/octet-stream", headers=headers)


def _explain_errors(app: FastAPI) -> None:
    """Every error leaves as a problem document."""

    @app.exception_handler(FleetmapError)
    @app.exception_handler(Exception)
    def failed(request: Request, error: Exception) -> Response:
        return _problem(problem_of(error))

    @app.exception_handler(RequestValidationError)
    def invalid(request: Request, error: RequestValidationError) -> Response:
        first = error.errors()[0]
        return _problem(problem_of(BadRequestError(f"'{first['loc'][-1]}' does not hold: {first['msg']}")))

    @app.exception_handler(HTTPException)
    def refused(request: Request, error: HTTPException) -> Response:
        if error.status_code == 404:
            return _problem(problem_of(NotFoundError(f"there is nothing at {request.url.path}")))
        return _problem(Problem(title=error.detail, status=error.status_code, detail=error.detail), error.headers)


def _problem(problem: Problem, headers: Mapping[str, str] | None = None) -> Response:
    return JSONResponse(problem.model_dump(), problem.status, headers, media_type=PROBLEM_MEDIA_TYPE)


def _base(request: Request) -> str:
    return str(request.base_url).rstrip("/")


def _page_links(request: Request, next_offset: int | None) -> list[dict[str, str]]:
    links = [{"rel": "self", "href": str(request.url), "type": _GEOJSON}]
    if next_offset is not None:
        further = str(request.url.include_query_params(offset=next_offset))
        links.append({"rel": "next", "href": further, "type": _GEOJSON})
    return links


def _parse_bbox(text: str) -> LonLatBox:
    """``west,south,east,north`` in degrees; west > east crosses 180 degrees."""
    try:
        west, south, east, north = (float(field) for field in text.split(","))
    except ValueError as error:
        raise BadRequestError(f"bbox '{text}' is not west,south,east,north in degrees") from error
    in_range = all(-180.0 <= lon <= 180.0 for lon in (west, east)) and -90.0 <= south <= north <= 90.0
    if not in_range:
        raise BadRequestError(f"bbox '{text}' does not hold: -180..180 and -90..90 degrees, south before north")
    return (west, south, east, north)


def _has_tag(if_none_match: str | None, sha256: str) -> bool:
    """Whether the client already has this content (RFC 9110, 13.1.2)."""
    if if_none_match is None:
        return False
    tags = [tag.strip().removeprefix("W/").strip('"') for tag in if_none_match.split(",")]
    return sha256 in tags or "*" in tags
