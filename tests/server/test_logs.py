"""The log: one line for each request under an id, as text or JSON; failures with tracebacks, told to nobody."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import re
import time
from collections.abc import Iterator

import httpx
import pytest

from fleetmap.transport import MapClient
from fleetmap_server.logs import begin_request, log_request, logging_as
from fleetmap_server.server import RunningServer, running_server
from fleetmap_server.settings import ServerSettings


class Log:
    """A JSON log that is being written."""

    def __init__(self) -> None:
        self.written = io.StringIO()

    def line(self, **fields: object) -> dict[str, object]:
        """The one line with these fields; a request's comes a moment after its answer."""
        deadline_s = time.monotonic() + 20.0
        while not (found := [line for line in self.lines() if fields.items() <= line.items()]):
            assert time.monotonic() < deadline_s, self.written.getvalue()
        assert len(found) == 1
        return found[0]

    def lines(self) -> list[dict[str, object]]:
        whole, _, _ = self.written.getvalue().rpartition("\n")
        return [json.loads(line) for line in whole.splitlines()]


@pytest.fixture
def log() -> Iterator[Log]:
    log = Log()
    with logging_as("json", log.written):
        yield log


@pytest.fixture
def logging_server(log: Log, server: RunningServer) -> RunningServer:
    return server


def test_each_http_request_is_a_line_with_its_id_which_is_returned(log, logging_server):
    answer = httpx.get(f"{logging_server.http_url}/healthz", headers={"X-Request-ID": "trace-4711/a"})
    assert answer.headers["x-request-id"] == "trace-4711/a"
    line = log.line(request_id="trace-4711/a")
    assert (line["level"], line["face"], line["operation"]) == ("INFO", "http", "GET /healthz")
    assert (line["status"], line["bytes_in"], line["bytes_out"]) == (200, 0, len(answer.content))
    assert line["duration_ms"] > 0.0
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d+\+00:00", line["time"])


@pytest.mark.parametrize("proposed", ["", "a b", "x" * 129, "é", '{"', "a\tb"])
def test_an_id_that_is_no_plain_word_is_replaced(logging_server, proposed):
    headers = {"X-Request-ID": proposed.encode("latin-1")}
    returned = httpx.get(f"{logging_server.http_url}/healthz", headers=headers).headers["x-request-id"]
    assert re.fullmatch("[0-9a-f]{32}", returned)


def test_an_address_cannot_forge_a_line(tmp_path, endpoint):
    written = io.StringIO()
    with logging_as("text", written), running_server(ServerSettings(tmp_path, endpoint, http_port=0)) as server:
        httpx.get(f"{server.http_url}/a%0A2026-01-01T00:00:00.000Z ERROR stolen%1B[31m")
    (line,) = written.getvalue().splitlines()
    assert "GET /a%0A2026" in line
    assert "\x1b" not in line


def test_each_zenoh_request_is_a_line(log, logging_server):
    with MapClient(logging_server.zenoh_endpoint) as client:
        client.list_maps()
    hello, maps = (log.line(face="zenoh", operation=operation) for operation in ("hello", "maps"))
    assert len({hello["request_id"], maps["request_id"], ""}) == 3


def test_a_line_says_whose_token_it_was(log, tmp_path, endpoint):
    access = tmp_path / "access"
    access.write_text(f"read vehicle-7 {hashlib.sha256(b'see').hexdigest()}\nread *\n")
    settings = ServerSettings(tmp_path / "store", endpoint, http_port=0, access_file=access)
    with running_server(settings) as server:
        with MapClient(endpoint, token="see") as client:
            client.list_maps()
        for headers in ({"Authorization": "Bearer see"}, {}):
            httpx.get(f"{server.http_url}/collections", headers=headers)
        assert log.line(operation="maps")["caller"] == "vehicle-7"
        assert log.line(operation="GET /collections", caller="vehicle-7")["status"] == 200
        assert log.line(operation="GET /collections", caller="")["status"] == 200


@pytest.mark.parametrize("face", ["http", "zenoh"])
def test_a_failure_is_logged_with_its_traceback_and_told_without(log, logging_server, monkeypatch, face):
    def fail(*_: object) -> None:
        raise ValueError("the secret reason")

    monkeypatch.setattr(logging_server.library.catalogue, "search", fail)
    monkeypatch.setattr(logging_server.library.catalogue, "entry", fail)
    if face == "http":
        answer = httpx.get(f"{logging_server.http_url}/maps/karlsruhe/manifest.json")
        assert (answer.status_code, answer.headers["content-type"]) == (500, "application/problem+json")
        told, request_id = answer.text, answer.headers["x-request-id"]
    else:
        with MapClient(logging_server.zenoh_endpoint) as client, pytest.raises(Exception) as refused:  # noqa: PT011
            client.list_maps()
        told = str(refused.value)
        request_id = log.line(operation="maps")["request_id"]
    assert "ValueError" in told
    assert "secret" not in told
    error = log.line(level="ERROR", request_id=request_id)
    assert "the secret reason" in error["exc_info"]
    assert "Traceback" in error["exc_info"]
    assert log.line(status=500)["request_id"] == request_id


def test_a_download_that_breaks_off_is_logged_and_never_taken_for_whole(log, logging_server, make_map):
    one = make_map(part_sizes=(40_000_000,))
    with MapClient(logging_server.zenoh_endpoint) as client:
        client.publish(one.manifest_bytes, one.parts.__getitem__)
    (sha256,) = one.parts
    with httpx.stream("GET", f"{logging_server.http_url}/blobs/{sha256}") as answer:
        os.truncate(logging_server.library.blobs.local_path(sha256), 35_000_000)
        with pytest.raises(httpx.RemoteProtocolError):
            answer.read()
    error = log.line(request_id=answer.headers["x-request-id"], level="ERROR")
    assert error["message"] == "GET /blobs/{sha256} broke off"
    assert "Traceback" in error["exc_info"]


def test_without_a_format_only_what_goes_wrong_is_told():
    written = io.StringIO()
    with logging_as(None, written):
        begin_request("a")
        log_request("http", "GET /", 200, 0.1, 0, 0)
        logging.getLogger("fleetmap_server").warning("something is wrong")
    assert written.getvalue() == "WARNING: something is wrong\n"
