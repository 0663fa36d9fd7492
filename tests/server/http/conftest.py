"""The web application over a store of its own, on either database, asked through real sockets."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI

from fleetmap.catalogue import MapEntry
from fleetmap.transport.protocol import BeginRequest, CommitRequest
from fleetmap_server.http.app import create_app
from fleetmap_server.http_face import listening_socket, serving_http
from fleetmap_server.library import MapLibrary, open_library
from fleetmap_server.settings import ServerSettings


@contextlib.contextmanager
def _serving(app: FastAPI) -> Iterator[str]:
    """The application's address while the block runs."""
    with listening_socket("127.0.0.1", 0) as listening, serving_http(app, listening) as face:
        yield face.url


@pytest.fixture(scope="session")
def serving() -> Callable[[FastAPI], contextlib.AbstractContextManager[str]]:
    return _serving


@pytest.fixture
def library(database_url: str, tmp_path: Path) -> Iterator[MapLibrary]:
    with open_library(ServerSettings(store=tmp_path / "store", catalogue=database_url)) as library:
        yield library


@pytest.fixture
def web(library: MapLibrary) -> Iterator[httpx.Client]:
    with _serving(create_app(library)) as address, httpx.Client(base_url=address, timeout=30.0) as client:
        yield client


@pytest.fixture(scope="session")
def publish() -> Callable[..., MapEntry]:
    """Brings a handmade map, or a manifest with its parts, into a library, as a publisher does."""

    def publish(library: MapLibrary, one) -> MapEntry:
        version, size_bytes = one.version, len(one.manifest_bytes)
        request = BeginRequest(version=version, size_bytes=size_bytes, map_id=one.manifest.map_id)
        latest = library.begin(request).latest
        library.receive(version, version, size_bytes, 0, one.manifest_bytes)
        for missing in library.begin(request).missing:
            data = one.parts[missing.sha256]
            library.receive(version, missing.sha256, len(data), 0, data)
        return library.commit(CommitRequest(version=version, predecessor=latest))

    return publish
