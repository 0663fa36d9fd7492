"""A server that ends: transfers under way come to their ends, newcomers are sent elsewhere."""

from __future__ import annotations

import hashlib
import socket
import threading
from collections.abc import Iterator

import pytest

from fleetmap.errors import ServerUnreachableError
from fleetmap.transport import MapClient, link, transfers
from fleetmap.transport.protocol import CHUNK_BYTES, Hello, Problem
from fleetmap.transport.service import Request, RequestService

DATA = bytes(range(256)) * 8000
NAME = hashlib.sha256(DATA).hexdigest()


class Server:
    """Hands out chunks of one blob, each only when it is let."""

    def __init__(self) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        self.leave, self.asked = threading.Semaphore(0), threading.Semaphore(0)
        self.observed: list[tuple[str, int, int, int]] = []
        handlers = {"hello": self._hello, "chunk": self._chunk, "maps": lambda request: b'{"maps": []}'}
        self.service = RequestService(self.endpoint, handlers, self._explain, observe=self._observe)

    def _hello(self, request: Request) -> bytes:
        hello = Hello(service="test", protocol=1, fleetmap_version="0", server_id=request.server_id)
        return hello.model_dump_json().encode()

    def _chunk(self, request: Request) -> bytes:
        self.asked.release()
        assert self.leave.acquire(timeout=20.0)
        offset = int(request.parameters["offset"])
        return DATA[offset : offset + int(request.parameters["length_bytes"])]

    def _explain(self, error: Exception) -> Problem:
        return Problem(title="Test", status=500, detail=str(error))

    def _observe(self, operation: str, status: int, seconds: float, bytes_in: int, bytes_out: int) -> None:
        assert seconds >= 0.0
        self.observed.append((operation, status, bytes_in, bytes_out))


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setattr(transfers, "_QUIET_S", 0.3)
    monkeypatch.setattr(link, "_GREETING_S", 0.3)
    made = Server()
    with made.service:
        yield made


def in_thread(act: object, *arguments: object) -> tuple[threading.Thread, list[object]]:
    result: list[object] = []
    thread = threading.Thread(target=lambda: result.append(act(*arguments)), daemon=True)  # type: ignore[operator]
    thread.start()
    return thread, result


def test_a_download_under_way_ends_and_a_new_client_is_sent_away(server):
    with MapClient(server.endpoint) as client:
        download, data = in_thread(client.part, "street", "a" * 64, NAME, len(DATA))
        assert server.asked.acquire(timeout=20.0)
        drain, drained = in_thread(server.service.drain, 20.0)
        with pytest.raises(ServerUnreachableError, match="the server is ending; ask again soon"):
            MapClient(server.endpoint)
        assert drain.is_alive()
        for _ in range(len(DATA) // CHUNK_BYTES + 40):
            server.leave.release()
        download.join(20.0)
        assert data == [DATA]
        assert client.list_maps() == []  # who is connected is still served
        drain.join(20.0)
        assert drained == [True]
    assert ("hello", 503) in [seen[:2] for seen in server.observed]


def test_the_wait_for_a_transfer_has_an_end_and_can_be_cut_short(server):
    with MapClient(server.endpoint) as client:
        download, data = in_thread(client.part, "street", "a" * 64, NAME, len(DATA))
        assert server.asked.acquire(timeout=20.0)
        assert server.service.drain(0.1) is False  # as long as the chunk is being answered
        hurry = threading.Event()
        drain, drained = in_thread(server.service.drain, 60.0, hurry)
        hurry.set()
        drain.join(20.0)
        for _ in range(100):
            server.leave.release()
        download.join(20.0)
        assert (drained, data) == ([False], [DATA])


def test_a_server_without_transfers_is_drained_at_once(server):
    with MapClient(server.endpoint) as client:
        assert client.list_maps() == []
        assert server.service.drain(0.0) is True


def test_requests_are_observed_with_their_bytes():
    server = Server()
    for _ in range(100):
        server.leave.release()
    with server.service, MapClient(server.endpoint) as client:
        client.list_maps()
        client.part("street", "a" * 64, NAME, len(DATA))
    assert ("maps", 200, 0, len(b'{"maps": []}')) in server.observed
    assert sum(seen[3] for seen in server.observed if seen[0] == "chunk") == len(DATA)
