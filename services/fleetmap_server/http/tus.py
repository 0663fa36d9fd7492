"""What the protocol of resumable uploads says in headers.

The protocol: tus 1.0.0, https://tus.io/protocols/resumable-upload.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from email.utils import formatdate
from pathlib import PurePosixPath
from typing import Annotated, Any

from fastapi import Header, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException

from fleetmap.errors import FleetmapError
from fleetmap.jobs import MAX_DRIVE_BYTES
from fleetmap.naming import map_id_from
from fleetmap_server.http.answers import problem_answer
from fleetmap_server.problems import BadRequestError, UnauthorizedError, problem_of

TUS_VERSION = "1.0.0"
OFFSET_STREAM = "application/offset+octet-stream"
ABILITIES = {
    "Tus-Version": TUS_VERSION,
    "Tus-Max-Size": str(MAX_DRIVE_BYTES),
    "Tus-Extension": "creation,checksum,termination,expiration",
    "Tus-Checksum-Algorithm": "sha256,sha1",
}
_RESUMABLE = {"Tus-Resumable": TUS_VERSION}
_MAX_METADATA = 4096


class TusRoute(APIRoute):
    """A route all of whose answers name the version of the protocol, those that are problems too."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """As every route has one."""
        handle = super().get_route_handler()

        async def answer(request: Request) -> Response:
            try:
                response = await handle(request)
            except (UnauthorizedError, RequestValidationError):
                raise  # answered alike everywhere
            except HTTPException as error:
                error.headers = {**(error.headers or {}), **_RESUMABLE}
                raise
            except FleetmapError as error:
                response = problem_answer(problem_of(error))
            response.headers.update(_RESUMABLE)
            return response

        return answer


def check_version(tus_resumable: Annotated[str | None, Header()] = None) -> None:
    """A dependency: status 412 for a client that speaks another version of the protocol."""
    if tus_resumable != TUS_VERSION:
        raise HTTPException(
            412,
            f"send 'Tus-Resumable: {TUS_VERSION}', the version that is spoken here",
            {"Tus-Version": TUS_VERSION},
        )


@dataclass(frozen=True)
class UploadMetadata:
    """What a client says of a recording before it sends it."""

    sha256: str  # not yet checked to be one
    filename: str
    map_id: str | None  # to be mapped under; None: not to be mapped


def parse_metadata(header: str) -> UploadMetadata:
    """Pairs of a key and a value in Base64: ``sha256`` (of the recording, in hex), ``filename``, ``map_id``.

    Without ``map_id`` the map is called as the file; an empty one wants no map.

    Raises:
        BadRequestError: malformed, or without ``sha256``.
        InputError: nothing of the file's name can be a map id.
    """
    if len(header) > _MAX_METADATA:
        raise BadRequestError(f"Upload-Metadata has {len(header)} characters; {_MAX_METADATA} are the limit")
    values: dict[str, str] = {}
    for pair in header.split(","):
        key, _, value = pair.strip().partition(" ")
        values[key] = _decoded(key, value)
    sha256 = values.get("sha256", "").lower()
    if not sha256:
        raise BadRequestError(
            "Upload-Metadata lacks 'sha256', the recording's SHA-256 in hexadecimal digits: it is its name here"
        )
    filename = values.get("filename") or f"{sha256[:12]}.mcap"
    map_id = values["map_id"] if "map_id" in values else map_id_from(PurePosixPath(filename).stem)
    return UploadMetadata(sha256, filename, map_id or None)


def check_checksum(header: str, data: bytes) -> None:
    """Compare a body with its ``Upload-Checksum``; status 460 if they differ.

    Raises:
        BadRequestError: malformed, or of an algorithm that is not offered.
    """
    algorithm, _, text = header.strip().partition(" ")
    if algorithm not in ABILITIES["Tus-Checksum-Algorithm"].split(","):
        raise BadRequestError(f"Upload-Checksum by '{algorithm[:20]}' is not offered; take sha256 or sha1")
    try:
        expected = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise BadRequestError("Upload-Checksum is not an algorithm and a checksum in Base64") from error
    if not hmac.compare_digest(expected, hashlib.new(algorithm, data).digest()):
        raise HTTPException(460, "the bytes are not those of the checksum; send them again")


def expiry(touched_ns: int, kept_s: float) -> dict[str, str]:
    """The header that says when an upload is given up if nobody goes on with it."""
    return {"Upload-Expires": formatdate(touched_ns / 1e9 + kept_s, usegmt=True)}


def _decoded(key: str, value: str) -> str:
    try:
        return base64.b64decode(value.strip(), validate=True).decode()
    except (binascii.Error, ValueError) as error:
        raise BadRequestError(f"the value of '{key[:40]}' in Upload-Metadata is no text in Base64") from error
