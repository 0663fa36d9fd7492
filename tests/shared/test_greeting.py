"""The first words between client and server: whoever else answers there, the user is told in one line and soon."""

from __future__ import annotations

import http.server
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence

import pytest
import zenoh

from fleetmap.errors import AccessDeniedError, InputError, ServerRefusedError, ServerUnreachableError
from fleetmap.transport import MapClient, check_endpoints, link
from fleetmap.transport.protocol import Hello, Problem
from fleetmap.transport.service import Handler, Request, RequestService
from fleetmap.transport.session import open_router

TOLD_WITHIN_S = 5.0  # 2 s on a machine that has nothing else to do


class AnswerError(Exception):
    def __init__(self, problem: Problem) -> None:
        self.problem = problem


def explain(error: Exception) -> Problem:
    if isinstance(error, AnswerError):
        return error.problem
    return Problem(title="Test", status=500, detail=str(error))


def service(
    endpoint: str,
    hello: Callable[[Request], Hello] | Problem,
    peers: Sequence[str] = (),
    **handlers: Handler,
) -> RequestService:
    def greet(request: Request) -> bytes:
        if isinstance(hello, Problem):
            raise AnswerError(hello)
        return hello(request).model_dump_json().encode()

    return RequestService(endpoint, {"hello": greet, **handlers}, explain, peers)


def friendly(request: Request) -> Hello:
    return Hello(service="test", protocol=1, fleetmap_version="0", server_id=request.server_id)


def told(kind: type[Exception], endpoint: str) -> str:
    begun_s = time.monotonic()
    with pytest.raises(kind) as refused:
        MapClient(endpoint)
    assert time.monotonic() - begun_s < TOLD_WITHIN_S
    assert "\n" not in str(refused.value)
    return str(refused.value)


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def unused_endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether a client waits for 2 s is tested once; here it is what it says."""
    monkeypatch.setattr(link, "_GREETING_S", 0.3)


@pytest.fixture
def web_endpoint() -> Iterator[str]:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), http.server.BaseHTTPRequestHandler) as web:
        threading.Thread(target=web.serve_forever, daemon=True).start()
        yield f"tcp/127.0.0.1:{web.server_port}"
        web.shutdown()


def test_nobody_there(endpoint):
    assert told(ServerUnreachableError, endpoint).startswith(
        f"no map server answers at {endpoint}; start one with"
    )


def test_somebody_who_says_nothing():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        endpoint = f"tcp/127.0.0.1:{silent.getsockname()[1]}"
        assert (
            told(ServerUnreachableError, endpoint)
            == f"what listens at {endpoint} is no map server; give its endpoint"
        )


def test_a_web_server(web_endpoint, hurried):
    assert "is no map server" in told(ServerUnreachableError, web_endpoint)


def test_a_zenoh_router_alone(endpoint, hurried):
    router = open_router(endpoint)
    assert "but no map server behind it" in told(ServerUnreachableError, endpoint)
    router.close()


@pytest.mark.parametrize(("version", "who"), [(2, "this fleetmap"), (0, "the server")])
def test_a_server_of_another_version(endpoint, version, who):
    router = open_router(endpoint)
    answer = Hello(service="fleetmap-server", protocol=version, fleetmap_version="9").model_dump_json().encode()
    key = f"fleetmap/v{version}/hello"

    def reply(query: zenoh.Query) -> None:
        with query:
            query.reply(key, answer)

    router.declare_queryable(key, reply)
    text = told(ServerRefusedError, endpoint)
    assert text.endswith(f"speaks version {version} of the protocol, this fleetmap 1; upgrade {who}")
    router.close()


@pytest.mark.parametrize("server_id", ["", "**", "a/b"])
def test_a_server_without_a_proper_name(endpoint, hurried, server_id):
    with service(endpoint, lambda request: friendly(request).model_copy(update={"server_id": server_id})):
        assert "is no map server" in told(ServerUnreachableError, endpoint)


def test_a_server_that_wants_a_token_or_another_one(endpoint):
    closed = {"may_read": False, "may_write": False}
    with service(endpoint, lambda request: friendly(request).model_copy(update=closed)):
        assert "give --token-file, or FLEETMAP_TOKEN" in told(AccessDeniedError, endpoint)
    with service(endpoint, Problem(title="Test", status=401, detail="who are you?")):
        assert told(AccessDeniedError, endpoint) == f"map server at {endpoint}: who are you?"


def test_a_server_that_is_ending_is_left_for_the_next(endpoint, unused_endpoint, hurried):
    ending = Problem(title="Test", status=503, detail="the server is ending")
    with service(endpoint, ending):
        assert told(ServerUnreachableError, endpoint) == f"map server at {endpoint}: the server is ending"
        with service(unused_endpoint, friendly) as other, MapClient(f"{endpoint},{unused_endpoint}") as client:
            assert client.hello.server_id == other.server_id


def test_of_several_endpoints_the_first_that_answers_is_taken(endpoint, web_endpoint, unused_endpoint, hurried):
    assert check_endpoints("tcp/a:1,tcp/b:2") == ("tcp/a:1", "tcp/b:2")
    with service(unused_endpoint, friendly) as there:
        with MapClient(f"{endpoint},{unused_endpoint}") as client:
            assert client.hello.server_id == there.server_id
        with MapClient(f"{unused_endpoint},{web_endpoint}") as client:
            assert client.hello.server_id == there.server_id
    assert f"{endpoint} or {unused_endpoint}" in told(ServerUnreachableError, f"{endpoint},{unused_endpoint}")
    for malformed in ("", "tcp/a:1,", "tcp/a:1;tcp/b:2", "tcp/a:1, tcp/b:2"):
        with pytest.raises(InputError, match="is no Zenoh endpoint"):
            check_endpoints(malformed)


def plain_session(**settings: object) -> zenoh.Session:
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    for name, value in settings.items():
        config.insert_json5(name.replace("__", "/"), json.dumps(value))
    return zenoh.open(config)


def test_behind_a_plain_router_the_server_is_found(endpoint, unused_endpoint):
    """A client at a Zenoh router that is no map server reaches those behind it."""
    with service(unused_endpoint, friendly, maps=lambda request: b'{"maps": []}') as there:
        router = plain_session(mode="router", listen__endpoints=[endpoint], connect__endpoints=[unused_endpoint])
        with MapClient(endpoint) as client:
            assert client.hello.server_id == there.server_id
            assert client.list_maps() == []
        router.close()


def test_a_client_that_pretends_to_be_a_server_gets_to_see_no_request(endpoint):
    seen: list[str] = []
    tokens: list[str | None] = []

    def maps(request: Request) -> bytes:
        tokens.append(request.token)
        return b'{"maps": []}'

    with service(endpoint, friendly, maps=maps) as there:
        impostor = plain_session(mode="client", connect__endpoints=[endpoint])
        for key in ("**", "fleetmap/**", "fleetmap/v1/hello", f"fleetmap/v1/at/{there.server_id}/maps"):
            impostor.declare_queryable(key, lambda query: seen.append(str(query.key_expr)), complete=True)
        with MapClient(endpoint, token="secret") as client:
            for _ in range(5):
                assert client.list_maps() == []
            assert client.hello.service == "test"
        impostor.close()
    assert (seen, tokens) == ([], ["secret"] * 5)


def test_a_request_reaches_one_server_of_a_mesh(endpoint, unused_endpoint):
    asked: list[str] = []

    def maps(request: Request) -> bytes:
        asked.append(request.server_id)
        return b'{"maps": []}'

    with (
        service(endpoint, friendly, maps=maps) as a,
        service(unused_endpoint, friendly, peers=[endpoint], maps=maps) as b,
    ):
        assert b.servers.wait_for(frozenset({a.server_id, b.server_id}), 20.0)
        for at, server in ((endpoint, a), (unused_endpoint, b)):
            asked.clear()
            with MapClient(at) as client:
                for _ in range(5):
                    client.list_maps()
            assert asked == [server.server_id] * 5
