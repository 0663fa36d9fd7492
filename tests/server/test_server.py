"""The server as a process: starts, tells where, refuses what cannot work, and ends when asked to."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from urllib.parse import urlsplit

import httpx
import pytest

from fleetmap.errors import InputError, RunError
from fleetmap.transport import MapClient
from fleetmap_server.server import running_server
from fleetmap_server.settings import ServerSettings
from fleetmap_server.tidying import tidying


def test_ctrl_c_ends_the_server_cleanly(start_server, tmp_path, endpoint):
    server = start_server(tmp_path / "new" / "store", endpoint)
    assert server.announcement.startswith("serving 0 maps of ")
    assert endpoint in server.announcement
    assert httpx.get(f"{server.http_url}/healthz").json()["status"] == "ok"
    with MapClient(endpoint) as client:
        assert client.list_maps() == []
        assert server.stop(signal.SIGINT) == (0, "")


def test_a_stopped_server_leaves_its_addresses_and_store_free(tmp_path, endpoint):
    settings = ServerSettings(tmp_path, endpoint, http_port=0)
    with running_server(settings) as first:
        port = int(first.http_url.rpartition(":")[2])
    with running_server(ServerSettings(tmp_path, endpoint, http_port=port)) as second:
        assert httpx.get(f"{second.http_url}/healthz").status_code == 200


def test_an_address_in_use_is_told(server, tmp_path, endpoint):
    elsewhere = tmp_path / "elsewhere"
    with pytest.raises(RunError, match=f"cannot listen on {endpoint}: address already in use"):
        running_server(ServerSettings(elsewhere, endpoint, http_port=0)).__enter__()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(RunError, match=f"cannot serve HTTP on 127.0.0.1:{port}: Address already in use"):
            running_server(ServerSettings(elsewhere, endpoint, http_port=port)).__enter__()


def test_a_store_in_use_is_told(server, tmp_path):
    with pytest.raises(RunError, match="another map server uses the store"):
        running_server(ServerSettings(tmp_path / "store", "tcp/127.0.0.1:7447", http_port=0)).__enter__()


def test_addresses_that_are_none_are_told(tmp_path):
    with pytest.raises(InputError, match="no Zenoh endpoint"):
        running_server(ServerSettings(tmp_path, "127.0.0.1:7447", http_port=0)).__enter__()
    with pytest.raises(InputError, match="'no such host' is no address"):
        running_server(ServerSettings(tmp_path, http_host="no such host", http_port=0)).__enter__()


class SlowReader:
    """A download over HTTP that goes on only when it is told to."""

    def __init__(self, http_url: str, path: str) -> None:
        address = urlsplit(http_url)
        self._socket = socket.socket()
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 131_072)
        self._socket.settimeout(30.0)
        self._socket.connect((address.hostname, address.port))
        self._socket.sendall(f"GET {path} HTTP/1.1\r\nHost: fleetmap\r\n\r\n".encode())
        self._received = self._socket.recv(100)

    def read_to_the_end(self) -> bytes:
        with self._socket:
            while piece := self._socket.recv(1_000_000):
                self._received += piece
        return self._received.partition(b"\r\n\r\n")[2]


def listens(http_url: str) -> bool:
    try:
        socket.create_connection((urlsplit(http_url).hostname, urlsplit(http_url).port), timeout=10.0).close()
    except (ConnectionRefusedError, ConnectionResetError):  # the latter just while it closes
        return False
    return True


@pytest.fixture
def large_map(make_map):
    """More than the buffers between server and client hold."""
    return make_map(part_sizes=(8_000_000,))


def slow_reader(server, endpoint, one) -> SlowReader:
    with MapClient(endpoint) as client:
        client.publish(one.manifest_bytes, one.parts.__getitem__)
    return SlowReader(server.http_url, f"/blobs/{next(iter(one.parts))}")


def test_a_download_under_way_is_finished_before_the_server_ends(start_server, tmp_path, endpoint, large_map):
    server = start_server(tmp_path, endpoint, "--log-format", "json")
    reader = slow_reader(server, endpoint, large_map)
    for _ in range(2):  # as from a terminal, and from a program that passes it on
        os.kill(server.process.pid, signal.SIGTERM)
    deadline_s = time.monotonic() + 20.0
    while listens(server.http_url):
        assert time.monotonic() < deadline_s
    assert server.process.poll() is None
    assert reader.read_to_the_end() == next(iter(large_map.parts.values()))
    _, err = server.process.communicate(timeout=30)
    assert server.process.returncode == 0
    lines = [json.loads(line) for line in err.splitlines()]
    (download,) = [line for line in lines if line.get("operation") == "GET /blobs/{sha256}"]
    assert (download["status"], download["bytes_out"]) == (200, 8_000_000)
    assert {line["level"] for line in lines} == {"INFO"}


def test_a_reader_who_never_reads_is_waited_for_only_so_long(start_server, tmp_path, endpoint, large_map):
    server = start_server(tmp_path, endpoint, "--drain-s", "0.5")
    reader = slow_reader(server, endpoint, large_map)
    code, err = server.stop()
    assert code == 0
    assert "GET /blobs/{sha256} was cut off" in err
    assert "Traceback" not in err
    assert len(reader.read_to_the_end()) < 8_000_000


def test_a_second_signal_stops_at_once(start_server, tmp_path, endpoint, large_map):
    server = start_server(tmp_path, endpoint, "--drain-s", "600")
    reader = slow_reader(server, endpoint, large_map)
    os.kill(server.process.pid, signal.SIGTERM)
    with pytest.raises(subprocess.TimeoutExpired):  # it waits for the reader, and moments later is another signal
        server.process.wait(timeout=1.0)
    code, err = server.stop(signal.SIGINT)
    assert code == 1
    assert err.endswith("error: stopped at once by a second signal; what was under way is cut off\n")
    assert "Traceback" not in err
    assert len(reader.read_to_the_end()) < 8_000_000


def test_the_store_is_tidied_while_the_server_serves(tmp_path, endpoint, make_map):
    settings = ServerSettings(tmp_path, endpoint, http_port=0, keep_versions=2)
    published = [make_map(seed=seed, part_sizes=(1000,)) for seed in range(4)]
    with running_server(settings) as server:
        with tidying(server.library, every_s=0.02), MapClient(endpoint) as client:
            for one in published:
                client.publish(one.manifest_bytes, one.parts.__getitem__)
            deadline_s = time.monotonic() + 20.0
            while len(list(server.library.storage.objects.keys("blobs"))) != 4:  # two manifests, two parts
                assert time.monotonic() < deadline_s
        assert [entry.number for entry in server.library.versions("karlsruhe")] == [3, 4]
        latest = httpx.get(f"{server.http_url}/maps/karlsruhe/manifest.json")
        assert latest.content == published[-1].manifest_bytes


BLOCKED = ("cv2", "gtsam", "numba", "mcap", "rosbags", "poselib")
WITHOUT_VISION = f"""
import sys
import time
from urllib.parse import urlsplit
for name in {BLOCKED}:
    sys.modules[name] = None
from fleetmap_cli.main import main
main(sys.argv[1:])
"""


def test_serving_needs_neither_vision_nor_recordings(tmp_path, endpoint):
    arguments = ["serve", "--store", str(tmp_path), "--zenoh", endpoint, "--http", "127.0.0.1:0"]
    process = subprocess.Popen(
        [sys.executable, "-c", WITHOUT_VISION, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    line = process.stdout.readline()
    os.kill(process.pid, signal.SIGTERM)
    _, err = process.communicate(timeout=20)
    assert (line[:15], process.returncode, err) == ("serving 0 maps ", 0, "")
