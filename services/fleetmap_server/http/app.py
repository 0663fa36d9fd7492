"""The web application: every router, one way of explaining errors, one description of it all."""

from __future__ import annotations

from urllib.parse import urlsplit

from fastapi import APIRouter, Depends, FastAPI, Request
from fastapi.middleware.cors import CORSMiddleware

from fleetmap import __version__
from fleetmap.transport.localizers import LocalizerPool
from fleetmap_server.access import Access
from fleetmap_server.http.answers import describe, explain_errors
from fleetmap_server.http.blobs import blob_router
from fleetmap_server.http.body_limit import MAX_SEARCH_BYTES, BodyLimit
from fleetmap_server.http.drive_uploads import drive_upload_router
from fleetmap_server.http.drives import drive_router
from fleetmap_server.http.guard import Guard, right_of
from fleetmap_server.http.localizing import MAX_LOCALIZE_BYTES, localize_router
from fleetmap_server.http.metrics import health_router, metrics_router
from fleetmap_server.http.pages import page_router
from fleetmap_server.http.preview_routes import preview_router
from fleetmap_server.http.request_log import RequestLog
from fleetmap_server.http.stac_routes import stac_router
from fleetmap_server.library import MapLibrary
from fleetmap_server.metrics import ServerMetrics
from fleetmap_server.problems import BadRequestError, ForbiddenError
from fleetmap_server.readiness import Readiness


def create_app(
    library: MapLibrary,
    access: Access | None = None,
    metrics: ServerMetrics | None = None,
    readiness: Readiness | None = None,
    localizers: LocalizerPool | None = None,
) -> FastAPI:
    """The web application over a library that is open; routes raise, and one place turns errors into answers.

    Args:
        library: what to serve.
        access: what tokens may do; None: everybody may do everything.
        metrics: what is counted; None: nobody else counts.
        readiness: what ``/readyz`` asks; None: nothing.
        localizers: what images are handed on to; None: there is nobody.
    """
    access, metrics = access or Access(), metrics or ServerMetrics()
    private = not access.is_open
    app = FastAPI(
        title="fleetmap map server",
        version=__version__,
        description="Visual maps anchored in UTM as a STAC API, their blobs, survey drives and the jobs of them.",
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
        dependencies=[Depends(Guard(access)), Depends(_whole_text), Depends(_own_pages)],
    )
    explain_errors(app)
    for router in _routers(library, private, metrics, readiness or Readiness({})):
        app.include_router(router)
    app.include_router(localize_router(localizers or LocalizerPool(())))
    describe(app)
    app.add_middleware(BodyLimit, limits_bytes={"/search": MAX_SEARCH_BYTES, "/localize": MAX_LOCALIZE_BYTES})
    app.add_middleware(
        CORSMiddleware, allow_origins=["*"], allow_methods=["GET", "HEAD", "POST"], allow_headers=["*"]
    )
    app.add_middleware(RequestLog, metrics=metrics)
    return app


def _routers(
    library: MapLibrary, private: bool, metrics: ServerMetrics, readiness: Readiness
) -> tuple[APIRouter, ...]:
    """Pages come first: they are there only for those who ask for HTML."""
    return (
        page_router(library, library.settings.zenoh_endpoint),
        stac_router(library.catalogue, library.drives),
        blob_router(library, private),
        preview_router(library, private),
        drive_upload_router(library),
        drive_router(library),
        metrics_router(metrics),
        health_router(readiness),
    )


async def _whole_text(request: Request) -> None:
    """Raise BadRequestError for NUL, which no name has and not every database takes for text."""
    if "\0" in request.url.path or "%00" in request.url.query:
        raise BadRequestError("there is a NUL in the address")


async def _own_pages(request: Request) -> None:
    """Raise ForbiddenError for a change that a page of another site asks a browser for, with its user's rights."""
    origin = urlsplit(request.headers.get("origin", "")).netloc
    if origin and origin != request.url.netloc and right_of(request.method, request.url.path) == "write":
        raise ForbiddenError(f"a page of {origin} may read here, but change nothing")
