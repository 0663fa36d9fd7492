"""The STAC API: landing page, collections, items and search."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import JSONResponse

from fleetmap.catalogue import MapEntry
from fleetmap.manifest import MAP_ID_PATTERN
from fleetmap_server.catalogue import Catalogue
from fleetmap_server.drives import Drives
from fleetmap_server.extents import Extent, Extents
from fleetmap_server.http.addresses import base_address, page_links
from fleetmap_server.http.answers import GeoJsonAnswer, problems
from fleetmap_server.http.item_pages import Entry, item_page
from fleetmap_server.http.stac_documents import (
    COLLECTIONS,
    CONFORMS_TO,
    DRIVES,
    MAPS,
    collection,
    collections_page,
    landing_page,
)
from fleetmap_server.http.stac_items import EXTENSION_PATH, drive_item, map_item
from fleetmap_server.http.stac_schema import extension_schema
from fleetmap_server.http.stac_search import (
    ItemSearch,
    SearchBody,
    SearchParameters,
    search_of_body,
    search_of_parameters,
)
from fleetmap_server.problems import NotFoundError

_MAP_ITEM_ID = re.compile(rf"({MAP_ID_PATTERN.strip('^$')})(?:\.v([1-9][0-9]{{0,8}}))?")
_SHA256 = re.compile(r"[0-9a-f]{64}")

CollectionId = Annotated[str, Path(description="maps or drives", examples=[MAPS, DRIVES])]


def stac_router(catalogue: Catalogue, drives: Drives) -> APIRouter:
    """The routes over one catalogue; they raise what ``answers.explain_errors`` turns into problems."""
    stac = _Stac(catalogue, drives)
    router = APIRouter(tags=["STAC"])
    _add_entrance(router)
    _add_collections(router, stac)
    _add_items(router, stac)
    return router


def _add_entrance(router: APIRouter) -> None:
    @router.get("/")
    def landing(request: Request, response: Response) -> dict[str, Any]:
        """Where everything is."""
        response.headers["Vary"] = "Accept"  # who prefers HTML gets a page
        return landing_page(base_address(request))

    @router.get("/conformance")
    def conformance() -> dict[str, Any]:
        """What this interface conforms to."""
        return {"conformsTo": list(CONFORMS_TO)}

    @router.get(EXTENSION_PATH)
    def schema(request: Request) -> dict[str, Any]:
        """The JSON schema of what items hold beyond STAC's core."""
        return extension_schema(f"{base_address(request)}{EXTENSION_PATH}")


def _add_collections(router: APIRouter, stac: _Stac) -> None:
    @router.get("/collections")
    def collections(request: Request) -> dict[str, Any]:
        """All collections."""
        return collections_page(base_address(request), {name: stac.extent(name) for name in COLLECTIONS})

    @router.get("/collections/{collection_id}", responses=problems(404))
    def one_collection(request: Request, collection_id: CollectionId) -> dict[str, Any]:
        """One collection."""
        return collection(base_address(request), checked(collection_id), stac.extent(collection_id))


def _add_items(router: APIRouter, stac: _Stac) -> None:
    @router.get("/collections/{collection_id}/items", response_class=GeoJsonAnswer, responses=problems(404))
    def items(
        request: Request, collection_id: CollectionId, parameters: Annotated[SearchParameters, Query()]
    ) -> JSONResponse:
        """A page of a collection's items."""
        search = search_of_parameters(parameters)
        here = tuple(name for name in search.collections if name == checked(collection_id))
        return stac.page(request, replace(search, collections=here))

    @router.get(
        "/collections/{collection_id}/items/{item_id}", response_class=GeoJsonAnswer, responses=problems(404, 410)
    )
    def item(request: Request, collection_id: CollectionId, item_id: str) -> JSONResponse:
        """One item; a map's older versions have ids such as karlsruhe.v3."""
        return GeoJsonAnswer(stac.item(checked(collection_id), item_id, base_address(request)))

    @router.get("/search", response_class=GeoJsonAnswer)
    def search(request: Request, parameters: Annotated[SearchParameters, Query()]) -> JSONResponse:
        """A page of items of all collections, or of some."""
        return stac.page(request, search_of_parameters(parameters))

    @router.post("/search", response_class=GeoJsonAnswer, responses=problems(413))
    def search_by_post(request: Request, body: SearchBody) -> JSONResponse:
        """A page of items of all collections, or of some."""
        return stac.page(request, search_of_body(body), body.model_dump(mode="json", exclude_none=True))


class _Stac:
    """The catalogue, asked for documents."""

    def __init__(self, catalogue: Catalogue, drives: Drives) -> None:
        self._catalogue = catalogue
        self._drives = drives
        self._extents = Extents(catalogue.database)

    def extent(self, name: str) -> Extent:
        return self._extents.maps() if name == MAPS else self._extents.drives()

    def page(self, request: Request, search: ItemSearch, body: dict[str, Any] | None = None) -> JSONResponse:
        found = item_page(self._catalogue.database, search)
        document: dict[str, Any] = {
            "type": "FeatureCollection",
            "features": self._documents(found.entries, base_address(request)),
            "numberReturned": len(found.entries),
            "links": page_links(request, found.token, body),
        }
        if found.matched is not None:
            document["numberMatched"] = found.matched
        return GeoJsonAnswer(document)

    def item(self, name: str, item_id: str, base: str) -> dict[str, Any]:
        """Raises NotFoundError, GoneError."""
        if name == DRIVES:
            if not _SHA256.fullmatch(item_id):
                raise _no_item(name, item_id)
            return drive_item(self._drives.get(item_id), base)
        found = _MAP_ITEM_ID.fullmatch(item_id)
        if found is None:
            raise _no_item(name, item_id)
        map_id, number = found.groups()
        entry = self._catalogue.entry(map_id, None if number is None else int(number))
        if entry is None:
            raise _no_item(name, item_id)
        return map_item(entry, self._catalogue.parts(entry.version), base)

    def _documents(self, entries: tuple[Entry, ...], base: str) -> list[dict[str, Any]]:
        versions = {entry.version for entry in entries if isinstance(entry, MapEntry)}
        parts = self._catalogue.parts_of(versions) if versions else {}
        return [
            map_item(entry, parts[entry.version], base) if isinstance(entry, MapEntry) else drive_item(entry, base)
            for entry in entries
        ]


def checked(collection_id: str) -> str:
    """The id of a collection that there is. Raises NotFoundError."""
    if collection_id not in COLLECTIONS:
        raise NotFoundError(f"there is no collection '{collection_id[:60]}', but {' and '.join(COLLECTIONS)}")
    return collection_id


def _no_item(collection_id: str, item_id: str) -> NotFoundError:
    return NotFoundError(f"collection '{collection_id}' has no item '{item_id[:80]}'")
