"""Manifests, parts and recordings over HTTP, by their maps or by their hashes alone."""

from __future__ import annotations

import json
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from shapely.geometry import mapping

from fleetmap.catalogue import MapEntry
from fleetmap_server.boxes import outline
from fleetmap_server.http.answers import problems
from fleetmap_server.http.blob_answer import asked_for_again, blob_answer, bytes_answer, cached_for_ever
from fleetmap_server.library import MapLibrary
from fleetmap_server.problems import NotFoundError

_JSON, _GEOJSON, _BYTES = "application/json", "application/geo+json", "application/octet-stream"
Version = Annotated[
    str | None, Query(description="A version's number, or 8 or more digits of its hash; the latest if not given.")
]


def blob_router(library: MapLibrary, private: bool = False) -> APIRouter:
    """The routes; ``private``: not everyone may read, so no shared cache may keep what one was told."""
    router = APIRouter(tags=["blobs"])

    @router.get("/maps/{map_id}/manifest.json", responses=_may_answer(_JSON))
    @router.head("/maps/{map_id}/manifest.json", responses=_may_answer(_JSON))
    def manifest(request: Request, map_id: str, version: Version = None) -> Response:
        """What a map's parts are."""
        found = library.entry(map_id, version).version
        return blob_answer(request, library.blobs, found, _JSON, _caching(found, version, private))

    @router.get("/maps/{map_id}/parts/{sha256}", responses=_may_answer(_BYTES))
    @router.head("/maps/{map_id}/parts/{sha256}", responses=_may_answer(_BYTES))
    def part(request: Request, map_id: str, sha256: str) -> Response:
        """A part of any version of a map."""
        library.check_part(map_id, sha256)
        return blob_answer(request, library.blobs, sha256, _BYTES, cached_for_ever(private))

    @router.get("/maps/{map_id}/trajectory.geojson", responses=_may_answer(_GEOJSON, in_part=False))
    @router.head("/maps/{map_id}/trajectory.geojson", responses=_may_answer(_GEOJSON, in_part=False))
    def trajectory(request: Request, map_id: str, version: Version = None) -> Response:
        """The way of the survey drive that a map was made of."""
        entry = library.entry(map_id, version)
        data = json.dumps(_trajectory(entry)).encode()
        return bytes_answer(request, data, _GEOJSON, _caching(entry.version, version, private))

    @router.get("/blobs/{sha256}", responses=_may_answer(_BYTES))
    @router.head("/blobs/{sha256}", responses=_may_answer(_BYTES))
    def blob(request: Request, sha256: str) -> Response:
        """A manifest, part or recording by its hash, as long as it is published."""
        if not library.serves(sha256):
            raise NotFoundError(f"the server has no data named {sha256[:64]}")
        return blob_answer(request, library.blobs, sha256, _BYTES, cached_for_ever(private))

    return router


def _caching(found: str, asked: str | None, private: bool) -> dict[str, str]:
    """A version that was asked for by its whole hash stays what it is."""
    return cached_for_ever(private) if found == asked else asked_for_again(private)


def _may_answer(media_type: str, in_part: bool = True) -> dict[int | str, dict[str, Any]]:
    """What OpenAPI says of a route's answers."""
    schema = {"type": "string", "format": "binary"} if media_type == _BYTES else {"type": "object"}
    content = {"content": {media_type: {"schema": schema}}}
    answers: dict[int | str, dict[str, Any]] = {
        200: {"description": "All of it", **content},
        304: {"description": "What the client has is still right"},
        **problems(404, 410),
    }
    if in_part:
        answers |= {206: {"description": "The range that was asked for", **content}, **problems(416)}
    return answers


def _trajectory(entry: MapEntry) -> dict[str, Any]:
    """A GeoJSON feature, the way cut where it crosses 180 degrees (RFC 7946, 3.1.9)."""
    return {
        "type": "Feature",
        "id": entry.map_id,
        "bbox": entry.bbox_lonlat,
        "geometry": mapping(outline(entry.trajectory_lonlat, entry.bbox_lonlat)),
        "properties": {"version": entry.version, "number": entry.number, "length_m": entry.length_m},
    }
