"""The operations of ``fleetmap.transport.protocol``, each a function of parameters and payload.

Parameters are checked by the protocol's models; whatever is raised here becomes a problem document.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

from pydantic import BaseModel

from fleetmap import __version__
from fleetmap.transport import protocol
from fleetmap.transport.service import Handler, RequestService
from fleetmap_server.library import MapLibrary
from fleetmap_server.problems import BadRequestError, problem_of

Request = TypeVar("Request", bound=BaseModel)


def serve_zenoh(library: MapLibrary, endpoint: str) -> RequestService:
    """Answer the protocol's requests at ``endpoint`` until the service is closed.

    Raises:
        InputError: the endpoint is malformed.
        RunError: it cannot be listened on.
    """
    return RequestService(endpoint, _handlers(library), problem_of)


def _handlers(library: MapLibrary) -> dict[str, Handler]:
    def hello(request: protocol.HelloRequest, payload: bytes) -> BaseModel:
        return protocol.Hello(
            service="fleetmap-server", protocol=protocol.PROTOCOL_VERSION, fleetmap_version=__version__
        )

    def maps(request: protocol.MapsRequest, payload: bytes) -> BaseModel:
        if request.lat_deg is None and request.lon_deg is None:
            return library.page(request.offset)
        if request.lat_deg is None or request.lon_deg is None:
            raise BadRequestError("lat_deg and lon_deg go together")
        return library.page_near(request.lat_deg, request.lon_deg, request.radius_m, request.offset)

    def manifest(request: protocol.ManifestRequest, payload: bytes) -> BaseModel:
        return library.manifest_ticket(request.map_id, request.version)

    def chunk(request: protocol.ChunkRequest, payload: bytes) -> bytes:
        return library.chunk(request.version, request.sha256, request.offset)

    def begin(request: protocol.BeginRequest, payload: bytes) -> BaseModel:
        return library.begin(request.version, request.size_bytes)

    def receive(request: protocol.UploadChunkRequest, payload: bytes) -> BaseModel:
        if not 0 < len(payload) <= protocol.UPLOAD_CHUNK_BYTES:
            raise BadRequestError(f"a chunk has 1 to {protocol.UPLOAD_CHUNK_BYTES} bytes, not {len(payload)}")
        received = library.receive(request.version, request.sha256, request.size_bytes, request.offset, payload)
        return protocol.Received(received_bytes=received)

    def commit(request: protocol.CommitRequest, payload: bytes) -> BaseModel:
        return library.commit(request.version)

    return {
        protocol.HELLO: _handler(protocol.HelloRequest, hello),
        protocol.MAPS: _handler(protocol.MapsRequest, maps),
        protocol.MANIFEST: _handler(protocol.ManifestRequest, manifest),
        protocol.CHUNK: _handler(protocol.ChunkRequest, chunk),
        protocol.UPLOAD_BEGIN: _handler(protocol.BeginRequest, begin),
        protocol.UPLOAD_CHUNK: _handler(protocol.UploadChunkRequest, receive),
        protocol.UPLOAD_COMMIT: _handler(protocol.CommitRequest, commit),
    }


def _handler(request: type[Request], serve: Callable[[Request, bytes], BaseModel | bytes]) -> Handler:
    """A function of checked parameters as one of words and bytes."""

    def handle(parameters: Mapping[str, str], payload: bytes) -> bytes:
        answer = serve(request.model_validate(dict(parameters)), payload)
        return answer if isinstance(answer, bytes) else answer.model_dump_json().encode()

    return handle
