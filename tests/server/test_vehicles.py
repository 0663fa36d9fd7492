"""Who is online: vehicles are counted while they live, however they go."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable

import httpx
import pytest

from fleetmap.errors import InputError
from fleetmap.transport import MapClient
from fleetmap_server.server import running_server
from fleetmap_server.settings import ServerSettings

VEHICLE = """
import sys
from fleetmap.transport import MapClient
client = MapClient(sys.argv[1], vehicle_id=sys.argv[2])
print("connected", flush=True)
sys.stdin.read()
"""


def until(condition: Callable[[], bool], within_s: float = 20.0) -> None:
    deadline_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline_s, "it did not come true in time"
        time.sleep(0.01)


def test_a_vehicle_is_counted_until_its_process_is_killed(server):
    process = subprocess.Popen(
        [sys.executable, "-c", VEHICLE, server.zenoh_endpoint, "truck-7"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "connected\n"
    with MapClient(server.zenoh_endpoint):  # who is no vehicle is not counted
        until(lambda: server.zenoh.vehicles_online() == 1)
        assert "fleetmap_vehicles_online 1.0" in httpx.get(f"{server.http_url}/metrics").text
    process.kill()
    process.communicate(timeout=10)
    until(lambda: server.zenoh.vehicles_online() == 0)


def test_a_vehicle_that_connects_twice_is_one_until_both_are_gone(server):
    with MapClient(server.zenoh_endpoint, vehicle_id="truck-7"):
        with MapClient(server.zenoh_endpoint, vehicle_id="truck-7"):
            with MapClient(server.zenoh_endpoint, vehicle_id="van_2.b"):
                until(lambda: server.zenoh.vehicles_online() == 2)
            until(lambda: server.zenoh.vehicles_online() == 1)
        assert server.zenoh.vehicles_online() == 1
    until(lambda: server.zenoh.vehicles_online() == 0)


def test_a_vehicle_that_asks_for_nothing_is_there_again_after_a_restart_of_the_server(tmp_path, endpoint):
    settings = ServerSettings(tmp_path, endpoint, http_port=0)
    with running_server(settings) as server:
        client = MapClient(endpoint, vehicle_id="truck-7")
        until(lambda: server.zenoh.vehicles_online() == 1)
    with client, running_server(settings) as server:
        until(lambda: server.zenoh.vehicles_online() == 1)


@pytest.mark.parametrize("vehicle_id", ["", "a/b", "*", "truck 7", "x" * 65, "ü"])
def test_what_cannot_be_a_vehicles_id_is_bad_input(vehicle_id):
    with pytest.raises(InputError, match="no vehicle's id; write 1 to 64 letters"):
        MapClient("tcp/127.0.0.1:1", vehicle_id=vehicle_id)
