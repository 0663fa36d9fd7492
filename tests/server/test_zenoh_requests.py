"""The protocol, spoken word by word: whatever is sent, there is an answer, and the server goes on."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fleetmap.jobs import MAX_SUMMARY_BYTES
from fleetmap.transport import MapClient
from fleetmap.transport.operations import OPERATIONS
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
    connection.server_id = json.loads(connection.greet(10.0))["server_id"]
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
        ("maps", {"area_lonlat": "8,49,9"}, 400, "area_lonlat"),
        ("maps", {"area_lonlat": "8,49,9,48"}, 400, "south lies north"),
        ("maps", {"area_lonlat": "8,49,9,91"}, 400, "area_lonlat"),
        ("maps", {"from_ns": 2, "until_ns": 1}, 400, "after until_ns"),
        ("maps", {"from_ns": 2**63}, 400, "from_ns"),
        ("maps", {"versions": "all"}, 400, "needs a map_id"),
        ("maps", {"versions": "all", "map_id": "none"}, 404, "none"),
        ("maps", {"after": "bm8gY3Vyc29y"}, 400, "no page of this search"),
        ("maps/rollback", {"map_id": "none", "version": 1}, 404, "none"),
        ("maps/rollback", {"map_id": "none", "version": "1234567 "}, 400, "version"),
        ("maps/retire", {"map_id": "none"}, 404, "none"),
        ("announcements", {"after": -1}, 400, "after"),
        ("maps", {"lat_deg": "nan", "lon_deg": 8}, 400, "lat_deg"),
        ("maps", {"lat_deg": 49, "lon_deg": 181}, 400, "lon_deg"),
        ("maps", {"after": "<>"}, 400, "after"),
        ("manifest", {}, 400, "map_id"),
        ("manifest", {"map_id": "../../etc/passwd"}, 400, "map_id"),
        ("manifest", {"map_id": "none"}, 404, "none"),
        ("manifest", {"map_id": "none", "version": "x"}, 400, "version"),
        ("chunk", {}, 400, "sha256"),
        ("chunk", {"version": HASH, "sha256": "../../x", "offset": 0}, 400, "sha256"),
        ("chunk", {"version": HASH, "sha256": HASH, "offset": 0}, 404, "no data"),
        ("chunk", {"version": HASH, "sha256": HASH, "offset": 10**30}, 400, "offset"),
        ("chunk", {"sha256": HASH, "offset": 0}, 404, "no drive"),
        ("chunk", {"sha256": HASH, "offset": 0, "length_bytes": 2**20 + 1}, 400, "length_bytes"),
        ("upload/begin", {"version": HASH}, 400, "size_bytes"),
        ("upload/begin", {"version": HASH, "size_bytes": 17 * 1024 * 1024}, 422, "too large"),
        ("upload/commit", {"version": HASH}, 404, "no data"),
        ("upload/commit", {"version": HASH.upper()}, 400, "version"),
        ("upload/commit", {"version": HASH, "job_id": "0" * 16}, 400, "go together"),
        ("drives/begin", {"sha256": HASH, "name": "a/b", "size_bytes": 1}, 400, "name"),
        ("drives/begin", {"sha256": HASH, "name": "a", "size_bytes": 2**50}, 400, "size_bytes"),
        ("drives/commit", {"sha256": HASH}, 409, "not arrived whole"),
        ("drives/list", {"drive": "xyz"}, 400, "drive"),
        ("jobs/list", {"job_id": HASH}, 404, "no job"),
        ("jobs/list", {"state": "asleep"}, 400, "state"),
        ("jobs/take", {"worker": "me and you"}, 400, "worker"),
        ("jobs/report", {"job_id": HASH, "fence": 1, "stage": "x", "percent": 101}, 400, "percent"),
        ("jobs/report", {"job_id": HASH, "fence": 1, "stage": "x", "percent": 100}, 404, "no job"),
        ("jobs/finish", {"job_id": HASH, "fence": 1, "give_back": "perhaps"}, 400, "give_back"),
        ("jobs/cancel", {"job_id": HASH}, 404, "no job"),
        ("jobs/retry", {"job_id": "../"}, 400, "job_id"),
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
    data = b'{"format": {"name": "fleetmap-map", "major": 9}}'
    version = hashlib.sha256(data).hexdigest()
    place = {"version": version, "sha256": version, "size_bytes": len(data), "offset": 0}
    status, detail = problem(connection, "upload/chunk", data, **place)
    assert (status, "map format 9" in detail) == (422, True)
    assert problem(connection, "upload/commit", version=version)[0] == 404


def test_a_summary_that_is_none_is_refused(connection):
    for payload in (b"{}", b"\xff", b"x" * (MAX_SUMMARY_BYTES + 1)):
        assert problem(connection, "drives/commit", payload, sha256=HASH)[0] == 400


WORDS = ["map_id", "version", "sha256", "offset", "size_bytes", "after", "job_id", "fence", "worker", "name", "x"]
VALUES = st.one_of(st.sampled_from([HASH, "karlsruhe", "0", "1", "-1", "1e9", "all", ""]), st.text(max_size=40))


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    operation=st.sampled_from(list(OPERATIONS)),
    words=st.dictionaries(st.sampled_from(WORDS), VALUES, max_size=5),
    payload=st.none() | st.binary(max_size=100),
)
def test_whatever_is_asked_there_is_an_answer(connection, operation, words, payload):
    question = connection.ask(operation, words, payload, 10.0)
    kind, told = OPERATIONS[operation].answer, None
    try:
        answer = question.answer()
    except ProblemError as error:
        told = error.problem
    if told is None:
        assert kind is not None
        kind.model_validate_json(answer)
    else:
        assert 400 <= told.status < 500
        assert told.type.startswith("urn:fleetmap:problem:")
        assert "\n" not in told.detail


def test_a_query_for_everything_is_answered_and_harms_nobody(connection):
    with contextlib.suppress(ProblemError):  # whichever operation answers first
        assert connection.ask("**", {}, None, 10.0).answer()
    assert json.loads(connection.ask("hello", {}, None, 10.0).answer())["service"] == "fleetmap-server"
