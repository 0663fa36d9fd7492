"""A blob sent two chunks at a time to servers that take them in any order, lose some, or take none."""

from __future__ import annotations

import hashlib
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from threading import Event

import pytest

from fleetmap.errors import TransferError
from fleetmap.transport.link import ServerLink
from fleetmap.transport.protocol import HELLO, UPLOAD_CHUNK, Hello, Problem, Received
from fleetmap.transport.sending import send_blob
from fleetmap.transport.service import Request, RequestService

DATA = hashlib.shake_128(b"blob").digest(3_000_000)
PATIENCE_S = 30.0


class Store:
    """What a server has of the blob; a chunk that is not the next one changes nothing."""

    def __init__(self) -> None:
        self.data = b""
        self.requests = 0

    def take(self, request: Request) -> None:
        self.requests += 1
        if int(request.parameters["offset"]) == len(self.data):
            self.data += request.payload


@pytest.fixture
def send() -> Iterator[Callable[[Callable[[Request], int]], list[int]]]:
    """Sends the blob to a server made of a function that takes chunks; returns what was reported."""
    with ExitStack() as stack:

        def start(take: Callable[[Request], int]) -> list[int]:
            with socket.socket() as probe:
                probe.bind(("127.0.0.1", 0))
                endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
            handlers = {
                HELLO: lambda request: (
                    Hello(service="test", protocol=1, fleetmap_version="0", server_id=request.server_id)
                    .model_dump_json()
                    .encode()
                ),
                UPLOAD_CHUNK: lambda request: Received(received_bytes=take(request)).model_dump_json().encode(),
            }
            stack.enter_context(
                RequestService(endpoint, handlers, lambda e: Problem(title="Test", status=500, detail=str(e)))
            )
            link = ServerLink(endpoint, timeout_s=10.0, patience_s=1.0)
            stack.callback(link.close)
            reported: list[int] = []
            named = {"sha256": hashlib.sha256(DATA).hexdigest(), "size_bytes": len(DATA)}
            send_blob(
                link, named, lambda offset, length: DATA[offset : offset + length], len(DATA), 0, reported.append
            )
            return reported

        yield start


def test_a_blob_arrives_whole_and_every_byte_is_reported_once(send):
    store = Store()

    def take(request: Request) -> int:
        store.take(request)
        return len(store.data)

    reported = send(take)
    assert store.data == DATA
    assert reported == sorted(set(reported))
    assert reported[-1] == len(DATA)
    assert len(reported) == store.requests


def test_a_second_chunk_that_overtakes_the_first_is_sent_again(send):
    store, second_came = Store(), Event()

    def take(request: Request) -> int:
        if request.parameters["offset"] == "0":
            assert second_came.wait(PATIENCE_S)
        store.take(request)
        answer = len(store.data)
        second_came.set()
        return answer

    assert send(take)[-1] == len(DATA)
    assert store.data == DATA


@pytest.mark.parametrize("kept_bytes", [0, 1, 700_000])
def test_what_a_server_has_lost_is_sent_again(send, kept_bytes):
    store, lost = Store(), []

    def take(request: Request) -> int:
        store.take(request)
        if len(store.data) > 1_500_000 and not lost:
            lost.append(len(store.data) - kept_bytes)
            store.data = store.data[:kept_bytes]
        return len(store.data)

    assert send(take)[-1] == len(DATA)
    assert store.data == DATA
    assert lost


def test_a_server_that_has_more_than_was_sent_is_not_sent_it(send):
    store = Store()

    def take(request: Request) -> int:
        store.data = DATA[:2_900_000]
        store.take(request)
        return len(store.data)

    send(take)
    assert store.requests <= 6  # instead of all of them


def test_a_server_that_takes_nothing_is_given_up(send):
    store = Store()

    def take(request: Request) -> int:
        store.requests += 1
        return 0

    with pytest.raises(TransferError, match=r"does not take blob [0-9a-f]{12}"):
        send(take)
    assert store.requests <= 6
