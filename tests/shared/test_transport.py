"""The client against servers that are not there, or do not do what they promise."""

from __future__ import annotations

import hashlib
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest

from fleetmap.errors import InputError, RunError, ServerRefusedError, ServerUnreachableError, TransferError
from fleetmap.transport import MapClient, check_endpoint
from fleetmap.transport.protocol import CHUNK_BYTES, UPLOAD_CHUNK_BYTES, WINDOW_CHUNKS, Hello, Problem
from fleetmap.transport.service import Handler, Request, RequestService

DATA = bytes(range(256)) * 5000
NAME = hashlib.sha256(DATA).hexdigest()


def piece_of_data(words: Mapping[str, str]) -> bytes:
    offset = int(words["offset"])
    return DATA[offset : offset + int(words["length_bytes"])]


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def hello(request: Request) -> bytes:
    return (
        Hello(service="test", protocol=1, fleetmap_version="0", server_id=request.server_id)
        .model_dump_json()
        .encode()
    )


def explain(error: Exception) -> Problem:
    return Problem(title="Test", status=getattr(error, "status", 500), detail=str(error))


@pytest.fixture
def connect() -> Iterator[Callable[..., MapClient]]:
    """A client of a server made of the given handlers."""
    opened: list[Any] = []

    def start(**handlers: Handler) -> MapClient:
        endpoint = free_endpoint()
        named = {name.replace("__", "/"): handler for name, handler in handlers.items()}
        opened.append(RequestService(endpoint, {"hello": hello, **named}, explain))
        opened.append(MapClient(endpoint, timeout_s=5.0, patience_s=0.5))
        return opened[-1]

    yield start
    for thing in reversed(opened):
        thing.close()


@pytest.mark.parametrize("text", ["tcp/127.0.0.1:7447", "tcp/map-server.local:1", "tcp/[::1]:65535"])
def test_endpoints_are_accepted(text):
    assert check_endpoint(text) == text


@pytest.mark.parametrize(
    "text",
    [
        *("", "127.0.0.1:7447", "tcp/127.0.0.1", "tcp/:7447", "tcp/a:0", "tcp/a:65536", "tcp/a:b"),
        *("udp/a:1", "tcp/a:1#x=y", "tcp/a:1\n"),
    ],
)
def test_what_is_no_endpoint_is_bad_input(text):
    with pytest.raises(InputError, match="is no Zenoh endpoint; write tcp/HOST:PORT"):
        MapClient(text)


def test_an_absent_server_is_told_within_two_seconds():
    endpoint = free_endpoint()
    begun_s = time.monotonic()
    with pytest.raises(ServerUnreachableError, match=f"no map server answers at {endpoint}; start one with"):
        MapClient(endpoint)
    assert time.monotonic() - begun_s < 4.0


def test_a_port_that_accepts_and_says_nothing_is_no_map_server():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        begun_s = time.monotonic()
        with pytest.raises(ServerUnreachableError):
            MapClient(f"tcp/127.0.0.1:{silent.getsockname()[1]}")
        assert time.monotonic() - begun_s < 5.0


def test_a_zenoh_router_without_a_map_server_is_told_within_two_seconds():
    endpoint = free_endpoint()
    begun_s = time.monotonic()
    with RequestService(endpoint, {}, explain), pytest.raises(ServerUnreachableError):
        MapClient(endpoint)
    assert time.monotonic() - begun_s < 4.0


def test_an_endpoint_is_listened_on_once():
    endpoint = free_endpoint()
    with RequestService(endpoint, {}, explain), pytest.raises(RunError, match="address already in use"):
        RequestService(endpoint, {}, explain)


def test_a_part_in_many_chunks_is_put_together(connect):
    client = connect(chunk=lambda request: piece_of_data(request.parameters))
    assert client.part("street", "v" * 64, NAME, len(DATA)) == DATA


@pytest.mark.parametrize(
    "spoil",
    [lambda data: data[:-1], lambda data: data + b"?", lambda data: b"?" + data[1:], lambda data: b""],
    ids=["short", "long", "changed", "empty"],
)
def test_a_part_that_arrives_damaged_is_refused(connect, spoil):
    client = connect(chunk=lambda request: spoil(piece_of_data(request.parameters)))
    with pytest.raises(TransferError, match=f"part {NAME[:12]} of map 'street' arrived damaged"):
        client.part("street", "v" * 64, NAME, len(DATA))


def test_what_is_on_its_way_at_once_fits_the_transmit_queue():
    def batches(size_bytes: int) -> int:
        return -(-(size_bytes + 2048) // 65_000)  # of 65535 bytes, each with its fragment's header

    assert batches(CHUNK_BYTES) * WINDOW_CHUNKS <= 16
    assert batches(UPLOAD_CHUNK_BYTES) <= 16
    assert UPLOAD_CHUNK_BYTES <= 1024 * 1024


def test_an_exception_in_a_handler_is_an_answer(connect):
    def fail(request: Request) -> bytes:
        raise ValueError("the handler failed")

    with pytest.raises(ServerRefusedError, match=r"map server at tcp/.*: the handler failed"):
        connect(maps=fail).list_maps()


def test_an_answer_that_is_not_what_it_should_be_is_told(connect):
    with pytest.raises(TransferError, match="answers what no MapPage is"):
        connect(maps=lambda request: b"{").list_maps()


def test_an_operation_the_server_does_not_know_is_given_up(connect):
    with pytest.raises(TransferError, match="answers no more"):
        connect().list_maps()


def test_a_busy_server_is_asked_again(connect):
    answers = [b"busy", b"busy", b'{"maps": []}']

    class BusyError(Exception):
        status = 503

    def busy_twice(request: Request) -> bytes:
        answer = answers.pop(0)
        if answer == b"busy":
            raise BusyError
        return answer

    assert connect(maps=busy_twice).list_maps() == []
    assert answers == []


def test_a_manifest_of_another_map_is_refused(connect):
    data = b"{}"
    version = hashlib.sha256(data).hexdigest()
    other = "0" * 64
    ticket = f'{{"version": "{version}", "sha256": "{version}", "size_bytes": 2}}'.encode()
    client = connect(manifest=lambda request: ticket, chunk=lambda request: data)
    with pytest.raises(TransferError, match="offers no manifest of map 'street'"):
        client.manifest("street", other)
    with pytest.raises(InputError, match="is not a fleetmap map"):
        client.manifest("street")


def test_a_server_that_offers_a_giant_manifest_is_not_followed(connect):
    ticket = f'{{"version": "{NAME}", "sha256": "{NAME}", "size_bytes": 99999999999}}'.encode()
    client = connect(manifest=lambda request: ticket, chunk=lambda request: DATA)
    with pytest.raises(TransferError, match="offers no manifest"):
        client.manifest("street")
