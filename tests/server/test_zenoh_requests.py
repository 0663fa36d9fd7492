"""The protocol, spoken word by word: whatever is sent, there is an answer, and the server goes on."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator

import pytest

from fleetmap.transport import MapClient
from fleetmap.transport.protocol import UPLOAD_CHUNK_BYTES
from fleetmap.transport.session import Connection, ProblemError
from fleetmap_server.server import running_server
from fleetmap_server.settings import ServerSettings

HASH = "ab" * 32


@pytest.fixture(scope="module")
def standing_server(tmp_path_factory, module_endpoint):
    with running_server(ServerSettings(tmp_path_factory.mktemp("store"), module_endpoint, http_port=0)) as server:
        yield server


@pytest.fixture(scope="module")
def connection(standing_server) -> Iterator[Connection]:
    connection = Connection(standing_server.zenoh_endpoint, 2.0)
    yield connection
    connection.close()


def problem(connection, operation: str, payload: bytes | None = None, **parameters: object) -> tuple[int, str]:
    words = {name: str(value) for name, value in parameters.items()}
    with pytest.raises(ProblemError) as refused:
        connection.ask(operation, words, payload, timeout_s=10.0).answer()
    return refused.value.problem.status, refused.value.problem.detail


@pytest.mark.parametrize(
    ("operation", "parameters", "status", "word"),
    [
        ("maps", {"lat_deg": 49}, 400, "lat_deg and lon_deg"),
        ("maps", {"lat_deg": "north", "lon_deg": 8}, 400, "lat_deg"),
        ("maps", {"lat_deg": "nan", "lon_deg": 8}, 400, "lat_deg"),
        ("maps", {"lat_deg": 49, "lon_deg": 181}, 400, "lon_deg"),
        ("maps", {"offset": -1}, 400, "offset"),
        ("manifest", {}, 400, "map_id"),
        ("manifest", {"map_id": "../../etc/passwd"}, 400, "map_id"),
        ("manifest", {"map_id": "none"}, 404, "none"),
        ("manifest", {"map_id": "none", "version": "x"}, 400, "version"),
        ("chunk", {}, 400, "version"),
        ("chunk", {"version": HASH, "sha256": "../../x", "offset": 0}, 400, "sha256"),
        ("chunk", {"version": HASH, "sha256": HASH, "offset": 0}, 404, "no data"),
        ("chunk", {"version": HASH, "sha256": HASH, "offset": 10**30}, 400, "offset"),
        ("upload/begin", {"version": HASH}, 400, "size_bytes"),
        ("upload/begin", {"version": HASH, "size_bytes": 17 * 1024 * 1024}, 422, "too large"),
        ("upload/commit", {"version": HASH}, 404, "no data"),
        ("upload/commit", {"version": HASH.upper()}, 400, "version"),
    ],
)
def test_a_malformed_request_is_answered_with_a_problem(connection, operation, parameters, status, word):
    told = problem(connection, operation, **parameters)
    assert told[0] == status
    assert word in told[1]
    assert "\n" not in told[1]


def test_chunks_are_taken_up_to_their_limit(connection):
    place = {"version": HASH, "sha256": HASH, "size_bytes": 5 * UPLOAD_CHUNK_BYTES, "offset": 0}
    status, detail = problem(connection, "upload/chunk", bytes(UPLOAD_CHUNK_BYTES + 1), **place)
    assert (status, f"1 to {UPLOAD_CHUNK_BYTES} bytes" in detail) == (400, True)
    assert problem(connection, "upload/chunk", None, **place)[0] == 400
    answer = connection.ask(
        "upload/chunk", {k: str(v) for k, v in place.items()}, bytes(UPLOAD_CHUNK_BYTES), 10.0
    ).answer()
    assert json.loads(answer) == {"received_bytes": UPLOAD_CHUNK_BYTES}


def test_a_tampered_chunk_is_refused_and_leaves_nothing(connection, standing_server, make_map):
    one = make_map(map_id="tampered", part_sizes=(1000,))
    ((sha256, data),) = one.parts.items()
    place = {"version": one.version, "sha256": one.version, "size_bytes": len(one.manifest_bytes), "offset": 0}
    assert problem(connection, "upload/chunk", one.manifest_bytes[:-1] + b" ", **place)[0] == 422
    connection.ask("upload/chunk", {k: str(v) for k, v in place.items()}, one.manifest_bytes, 10.0).answer()
    place = {"version": one.version, "sha256": sha256, "size_bytes": 1000, "offset": 0}
    status, detail = problem(connection, "upload/chunk", data[:-1] + b"?", **place)
    assert (status, "other bytes than its name says" in detail) == (422, True)
    status, detail = problem(connection, "upload/commit", version=one.version)
    assert (status, "1 parts are missing" in detail) == (409, True)
    with MapClient(standing_server.zenoh_endpoint) as client:
        assert client.list_maps() == []


def test_a_manifest_that_is_none_is_refused_before_any_part_is_sent(connection):
    data = b'{"format": {"name": "fleetmap-map", "major": 2}}'
    version = hashlib.sha256(data).hexdigest()
    place = {"version": version, "sha256": version, "size_bytes": len(data), "offset": 0}
    status, detail = problem(connection, "upload/chunk", data, **place)
    assert (status, "map format 2" in detail) == (422, True)
    assert problem(connection, "upload/commit", version=version)[0] == 404


def test_a_query_for_everything_is_answered_and_harms_nobody(connection):
    with contextlib.suppress(ProblemError):  # whichever operation answers first
        assert connection.ask("**", {}, None, 10.0).answer()
    assert json.loads(connection.ask("hello", {}, None, 10.0).answer())["service"] == "fleetmap-server"
