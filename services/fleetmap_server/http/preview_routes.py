"""The preview of a map over HTTP: made when it is first asked for, and kept in memory for a while."""

from __future__ import annotations

from collections import OrderedDict
from threading import BoundedSemaphore, Lock
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from fleetmap.errors import MapPackageError
from fleetmap.manifest import parse_manifest
from fleetmap_server.blobs import Blobs
from fleetmap_server.http.answers import problems
from fleetmap_server.http.blob_answer import asked_for_again, bytes_answer, cached_for_ever
from fleetmap_server.http.stac_items import PLY
from fleetmap_server.library import MapLibrary
from fleetmap_server.preview import preview_ply
from fleetmap_server.problems import BusyError, NotFoundError

PLACES = 4  # for those who wait for a preview, the one being made included
_KEPT = 64  # previews of at most 120 kB

Version = Annotated[
    str | None, Query(description="a version's number, or 8 or more digits of its hash; the latest if not given")
]


class _PlyAnswer(Response):
    media_type = PLY


def preview_router(library: MapLibrary, private: bool = False) -> APIRouter:
    """The route; ``private``: not everyone may read, so no shared cache may keep the answer."""
    router = APIRouter(tags=["maps"])
    previews = Previews(library.blobs)

    @router.get(
        "/maps/{map_id}/preview.ply",
        response_class=_PlyAnswer,
        responses=problems(404, 410) | {304: {"description": "What the client has is still right"}},
    )
    def preview(request: Request, map_id: str, version: Version = None) -> Response:
        """Some thousand landmarks of a map in UTM, to look at."""
        entry = library.entry(map_id, version)
        caching = cached_for_ever(private) if version == entry.version else asked_for_again(private)
        return bytes_answer(request, previews.of(entry.version), PLY, caching)

    return router


class Previews:
    """Those asked for last. They are made one at a time, which bounds the memory that they take."""

    def __init__(self, blobs: Blobs) -> None:
        self._blobs = blobs
        self._kept: OrderedDict[str, bytes] = OrderedDict()
        self._places, self._making = BoundedSemaphore(PLACES), Lock()

    def of(self, version: str) -> bytes:
        """The preview of a published version.

        Raises:
            NotFoundError: its parts are nothing that can be looked at.
            BusyError: enough others wait already, and whoever serves them has more to do.
        """
        if (known := self._kept.get(version)) is not None:
            return known
        if not self._places.acquire(blocking=False):
            raise BusyError("other previews are being made; ask again")
        try:
            with self._making:
                if version not in self._kept:
                    self._kept[version] = self._made(version)
                    while len(self._kept) > _KEPT:
                        self._kept.popitem(last=False)
                return self._kept[version]
        finally:
            self._places.release()

    def _made(self, version: str) -> bytes:
        manifest = parse_manifest(self._whole(version), f"version {version[:12]}")
        try:
            return preview_ply(manifest, lambda record: self._whole(record.sha256))
        except MapPackageError as error:
            raise NotFoundError(f"there is no preview of this map: {error}") from error

    def _whole(self, sha256: str) -> bytes:
        return b"".join(self._blobs.stream(sha256))
