"""Blobs as HTTP answers: whole or in part, cached for ever, with digests (RFC 9110, 9111, 9530)."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import BinaryIO

from fastapi import Request, Response
from fastapi.responses import StreamingResponse
from starlette.concurrency import iterate_in_threadpool

from fleetmap.errors import StorageError
from fleetmap.transport.protocol import Problem
from fleetmap_server.blobs import Blobs
from fleetmap_server.http.answers import problem_answer
from fleetmap_server.http.ranges import (
    ByteRange,
    UnsatisfiableRangeError,
    has_tag,
    range_still_holds,
    requested_range,
)
from fleetmap_server.problems import DamagedBlobError, NotFoundError

_PIECE_BYTES = 1024 * 1024
_DIGESTED_BYTES = 8 * 1024 * 1024  # a longer range is not read twice only to tell its digest
_YEAR_S = 31_536_000


def blob_answer(
    request: Request, blobs: Blobs, sha256: str, media_type: str, headers: Mapping[str, str]
) -> Response:
    """A blob, or the part of it that is asked for.

    Args:
        request: GET or HEAD.
        blobs: where it is.
        sha256: its name, which is its entity tag.
        media_type: its content type.
        headers: how it may be cached, and what else is to be told.

    Raises:
        NotFoundError: there is no such blob.
        DamagedBlobError: its bytes are not what its name says.
        StorageError: the store fails.
    """
    size_bytes = blobs.size(sha256)
    if size_bytes is None:
        raise NotFoundError(f"the server has no data named {sha256}")
    told = {**headers, "ETag": f'"{sha256}"', "Accept-Ranges": "bytes", "X-Content-Type-Options": "nosniff"}
    if has_tag(request.headers.get("if-none-match"), sha256):
        return Response(status_code=304, headers=told)
    told["Repr-Digest"] = _digest(bytes.fromhex(sha256))
    if request.method == "HEAD":
        return Response(headers={**told, "Content-Length": str(size_bytes)}, media_type=media_type)
    try:
        wanted = _wanted(request, sha256, size_bytes)
    except UnsatisfiableRangeError:
        return _unsatisfiable(size_bytes)
    if wanted is None:
        told["Content-Digest"] = told["Repr-Digest"]
        return _streamed(blobs, sha256, ByteRange(0, size_bytes), 200, media_type, told)
    told["Content-Range"] = f"bytes {wanted.start}-{wanted.end - 1}/{size_bytes}"
    if len(wanted) > _DIGESTED_BYTES:
        return _streamed(blobs, sha256, wanted, 206, media_type, told)
    data = blobs.read(sha256, wanted.start, len(wanted))
    told["Content-Digest"] = _digest(hashlib.sha256(data).digest())
    return Response(data, 206, told, media_type)


def bytes_answer(request: Request, data: bytes, media_type: str, headers: Mapping[str, str]) -> Response:
    """Something made for this request, with its digest and tag."""
    sha256 = hashlib.sha256(data)
    told = {**headers, "ETag": f'"{sha256.hexdigest()}"', "Repr-Digest": _digest(sha256.digest())}
    if has_tag(request.headers.get("if-none-match"), sha256.hexdigest()):
        return Response(status_code=304, headers=told)
    if request.method == "HEAD":
        return Response(headers={**told, "Content-Length": str(len(data))}, media_type=media_type)
    return Response(data, 200, {**told, "Content-Digest": told["Repr-Digest"]}, media_type)


def cached_for_ever(private: bool) -> dict[str, str]:
    """Headers of what never changes; ``private``: a cache that others share must not keep it."""
    return {
        "Cache-Control": f"{'private' if private else 'public'}, max-age={_YEAR_S}, immutable",
        "Vary": "Authorization",
    }


def asked_for_again(private: bool) -> dict[str, str]:
    """Headers of what may be something else tomorrow."""
    return {"Cache-Control": "private, no-cache" if private else "no-cache", "Vary": "Authorization"}


def _wanted(request: Request, tag: str, size_bytes: int) -> ByteRange | None:
    if not range_still_holds(request.headers.get("if-range"), tag):
        return None
    return requested_range(request.headers.get("range"), size_bytes)


def _unsatisfiable(size_bytes: int) -> Response:
    problem = Problem(title="Range not satisfiable", status=416, detail=f"there are {size_bytes} bytes")
    return problem_answer(problem, {"Content-Range": f"bytes */{size_bytes}"})


def _streamed(
    blobs: Blobs, sha256: str, wanted: ByteRange, status: int, media_type: str, headers: Mapping[str, str]
) -> Response:
    """Bytes sent as they are read; what goes wrong at the beginning still becomes a problem."""
    file = blobs.local_path(sha256)
    pieces = blobs.stream(sha256, wanted.start, len(wanted)) if file is None else _file_pieces(file, wanted)
    first = next(pieces)
    told = {**headers, "Content-Length": str(len(wanted))}
    return StreamingResponse(_joined(first, pieces), status, told, media_type)


def _file_pieces(file: Path, wanted: ByteRange) -> Iterator[bytes]:
    with _opened(file) as opened:
        opened.seek(wanted.start)
        left = len(wanted)
        while left > 0 and (piece := opened.read(min(_PIECE_BYTES, left))):
            yield piece
            left -= len(piece)
    if left > 0:
        raise DamagedBlobError(f"stored data {file.name} ends {left} bytes too early")


def _opened(file: Path) -> BinaryIO:
    try:
        return file.open("rb")
    except FileNotFoundError as error:  # retired and collected just now
        raise NotFoundError(f"the server has no data named {file.name} any more") from error
    except OSError as error:
        raise StorageError(f"cannot read {file}: {error.strerror or error}; see that it may be read") from error


async def _joined(first: bytes, rest: Iterator[bytes]) -> AsyncIterator[bytes]:
    with closing(rest):  # type: ignore[type-var]  # both kinds are generators
        yield first
        async for piece in iterate_in_threadpool(rest):
            yield piece


def _digest(sha256: bytes) -> str:
    return f"sha-256=:{base64.b64encode(sha256).decode()}:"
