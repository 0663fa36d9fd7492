"""``fleetmap serve`` as a user types it; what it serves is tested with the server."""

from __future__ import annotations

import socket

import pytest

from fleetmap_server.library import open_library


def test_help_says_what_it_does_with_its_defaults(fleetmap):
    code, out, _ = fleetmap("serve", "--help")
    assert code == 0
    for word in ("tcp/127.0.0.1:7447", "127.0.0.1:8000", "default: maps", "Example"):
        assert word in out


@pytest.mark.parametrize("http", ["8000", "127.0.0.1", "127.0.0.1:99999", "127.0.0.1:x", ":8000", "127.0.0.1:-1"])
def test_an_http_address_that_is_none_is_a_usage_error(fleetmap, tmp_path, http):
    code, out, err = fleetmap("serve", "--store", tmp_path / "store", "--http", http)
    assert (code, out) == (2, "")
    assert f"'{http}' is not HOST:PORT" in err
    assert not (tmp_path / "store").exists()


def test_a_zenoh_endpoint_that_is_none_is_a_usage_error(fleetmap, tmp_path):
    code, _, err = fleetmap("serve", "--store", tmp_path, "--zenoh", "127.0.0.1:7447", "--http", "127.0.0.1:0")
    assert code == 2
    assert (
        err
        == "error: '127.0.0.1:7447' is no Zenoh endpoint; write tcp/HOST:PORT, for instance tcp/127.0.0.1:7447\n"
    )


def test_a_port_in_use_is_one_line(fleetmap, tmp_path, absent_server):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        code, out, err = fleetmap("serve", "--store", tmp_path, "--zenoh", absent_server, "--http", address)
    assert (code, out) == (1, "")
    assert err == f"error: cannot serve HTTP on {address}: Address already in use; is a server running already?\n"


def test_a_second_server_on_the_same_store_is_one_line(fleetmap, tmp_path, absent_server):
    store = tmp_path / "store"
    with open_library(store):
        code, out, err = fleetmap("serve", "--store", store, "--zenoh", absent_server, "--http", "127.0.0.1:0")
    assert (code, out) == (1, "")
    assert err == f"error: another map server uses the store {store}; stop it or give another --store\n"
