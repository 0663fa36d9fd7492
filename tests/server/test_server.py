"""The server as a process: starts, tells where, refuses what cannot work, and ends when asked to."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys

import httpx
import pytest

from fleetmap.errors import InputError, RunError
from fleetmap.transport import MapClient
from fleetmap_server.server import running_server
from fleetmap_server.settings import ServerSettings


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_server_cleanly(start_server, tmp_path, endpoint, number):
    server = start_server(tmp_path / "new" / "store", endpoint)
    assert server.announcement.startswith("serving 0 maps of ")
    assert endpoint in server.announcement
    assert httpx.get(f"{server.http_url}/healthz").json()["status"] == "ok"
    with MapClient(endpoint) as client:
        assert client.list_maps() == []
        assert server.stop(number) == (0, "")


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


BLOCKED = ("cv2", "gtsam", "numba", "mcap", "rosbags", "poselib")
WITHOUT_VISION = f"""
import sys
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
