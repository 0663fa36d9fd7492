"""What goes over Zenoh between a map server and its clients, version 1. No Zenoh in here, only the words.

Every request is a query (a Zenoh ``get``) on ``fleetmap/v1/<operation>`` with its arguments as selector
parameters and, for uploads, a payload. Every request gets exactly one answer: a sample, or an error whose
payload is a problem document (RFC 9457, ``application/problem+json``). No answer at all means that no
server is there; it never means "nothing found".

=================  ==================================  ================================================
operation          parameters (payload)                answer
=================  ==================================  ================================================
``hello``                                              JSON ``Hello``
``maps``           [lat_deg lon_deg radius_m] [offset] JSON ``MapPage``, nearest or newest first
``manifest``       map_id [version]                    JSON ``BlobTicket`` of the manifest
``chunk``          version sha256 offset               up to ``CHUNK_BYTES`` bytes of a blob
``upload/begin``   version size_bytes                  JSON ``UploadStatus``: what is still missing
``upload/chunk``   version sha256 size_bytes offset    JSON ``Received``
                   (<= ``UPLOAD_CHUNK_BYTES``)
``upload/commit``  version                             JSON ``MapEntry``
=================  ==================================  ================================================

A blob is a manifest or a part, named by its SHA-256; the manifest's is the version. To publish, a client
repeats ``upload/begin`` and sends what it names (first the manifest, then the parts) until nothing is missing,
then commits. The bytes of one blob arrive in order: ``Received`` says how many the server has, whatever was
sent, and the client goes on from there. So an upload cut at any place goes on where it stopped, also after a
restart of either side. A blob counts once its hash holds; a map is visible from its commit on.
"""

from __future__ import annotations

import re

from pydantic import BaseModel, ConfigDict, Field

from fleetmap.catalogue import NEAR_RADIUS_M
from fleetmap.errors import InputError
from fleetmap.manifest import MAX_PART_BYTES, MapId, Sha256

PROTOCOL_VERSION = 1
KEY_PREFIX = f"fleetmap/v{PROTOCOL_VERSION}"
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
CHUNK_BYTES = 256 * 1024
WINDOW_CHUNKS = 3  # a client asks for at most so many at once: 768 KiB, which every transmit queue holds
UPLOAD_CHUNK_BYTES = WINDOW_CHUNKS * CHUNK_BYTES  # uploads go one at a time
PROBLEM_ENCODING = "application/problem+json"

HELLO, MAPS, MANIFEST, CHUNK = "hello", "maps", "manifest", "chunk"
UPLOAD_BEGIN, UPLOAD_CHUNK, UPLOAD_COMMIT = "upload/begin", "upload/chunk", "upload/commit"

_ENDPOINT = re.compile(r"tcp/(?P<host>\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+):(?P<port>[0-9]{1,5})")


class _Message(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class Hello(_Message):
    """Who answers."""

    service: str
    protocol: int
    fleetmap_version: str


class HelloRequest(_Message):
    """Is a map server there?"""


class Problem(_Message):
    """A problem document (RFC 9457): why a request was not served."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str


class MapsRequest(_Message):
    """Which maps to list."""

    lat_deg: float | None = Field(default=None, ge=-90.0, le=90.0)
    lon_deg: float | None = Field(default=None, ge=-180.0, le=180.0)
    radius_m: float = Field(default=NEAR_RADIUS_M, gt=0.0, le=1_000_000.0)
    offset: int = Field(default=0, ge=0, le=2**31)


class ManifestRequest(_Message):
    """Which map's manifest; without a version the latest."""

    map_id: MapId
    version: Sha256 | None = None


class BlobTicket(_Message):
    """A blob that the server has."""

    version: Sha256
    sha256: Sha256
    size_bytes: int = Field(gt=0)


class ChunkRequest(_Message):
    """A piece of a blob that belongs to a published version."""

    version: Sha256
    sha256: Sha256
    offset: int = Field(ge=0, le=MAX_PART_BYTES)


class BeginRequest(_Message):
    """A version about to be published, and the length of its manifest."""

    version: Sha256
    size_bytes: int = Field(gt=0)


class MissingBlob(_Message):
    """A blob the server still needs, and how many of its bytes it already has."""

    sha256: Sha256
    size_bytes: int = Field(gt=0)
    received_bytes: int = Field(ge=0)


class UploadStatus(_Message):
    """What is missing before a commit; ``missing`` may be only the first of them, ``missing_bytes`` counts all."""

    missing: tuple[MissingBlob, ...]
    missing_bytes: int = Field(ge=0)


class UploadChunkRequest(_Message):
    """The bytes of a blob from ``offset`` on."""

    version: Sha256
    sha256: Sha256
    size_bytes: int = Field(gt=0, le=MAX_PART_BYTES)
    offset: int = Field(ge=0, le=MAX_PART_BYTES)


class Received(_Message):
    """How many bytes of a blob the server has, from its start."""

    received_bytes: int = Field(ge=0)


class CommitRequest(_Message):
    """A version all of whose blobs have arrived."""

    version: Sha256


def check_endpoint(text: str) -> str:
    """The endpoint itself, if it is one.

    Raises:
        InputError: not of the form ``tcp/HOST:PORT``.
    """
    match = _ENDPOINT.fullmatch(text)
    if match is None or not 0 < int(match["port"]) < 65536:
        raise InputError(f"{text!r} is no Zenoh endpoint; write tcp/HOST:PORT, for instance {DEFAULT_ENDPOINT}")
    return text
