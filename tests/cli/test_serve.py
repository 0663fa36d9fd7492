"""``fleetmap serve`` as a user types it; what it serves is tested with the server."""

from __future__ import annotations

import socket

import pytest

from fleetmap_server.library import open_library
from fleetmap_server.settings import ServerSettings


def test_help_says_what_it_does_with_its_defaults(fleetmap):
    code, out, _ = fleetmap("serve", "--help")
    assert code == 0
    for word in ("tcp/127.0.0.1:7447", "127.0.0.1:8000", "default: maps", "default: 30", "s3://", "Example"):
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
    with open_library(ServerSettings(store)):
        code, out, err = fleetmap("serve", "--store", store, "--zenoh", absent_server, "--http", "127.0.0.1:0")
    assert (code, out) == (1, "")
    assert err.startswith(f"error: another map server uses the store {store}; stop it")
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--store", "s3://bucket/maps"), "give --catalogue"),
        (("--store", "ftp://host/maps", "--catalogue", "sqlite:///{tmp}/c"), "is no store"),
        (("--store", "{tmp}/maps", "--catalogue", "mysql://host/maps"), "is no catalogue"),
        (("--store", __file__), "is a file; give a folder"),
        (("--store", "{tmp}/maps", "--access", "{tmp}/none"), "cannot read the access file"),
        (("--store", "{tmp}/maps", "--keep-versions", "0"), "--keep-versions"),
        (("--store", "{tmp}/maps", "--drain-s", "-1"), "--drain-s"),
        (("--store", "{tmp}/maps", "--log-format", "xml"), "--log-format"),
        (("--store", "{tmp}/maps", "--peer", "10.0.0.1:7447"), "no Zenoh endpoint"),
    ],
)
def test_options_that_do_not_go_together_are_one_line(fleetmap, tmp_path, absent_server, options, complaint):
    words = [word.format(tmp=tmp_path) for word in options]
    code, out, err = fleetmap("serve", "--zenoh", absent_server, "--http", "127.0.0.1:0", *words)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert complaint in err


def test_a_line_of_the_access_file_that_says_something_else_is_named(fleetmap, tmp_path, absent_server):
    access = tmp_path / "access"
    access.write_text("# who\nread *\nadmin me 00\n")
    code, out, err = fleetmap("serve", "--zenoh", absent_server, "--http", "127.0.0.1:0", "--access", access)
    assert (code, out) == (2, "")
    assert f"{access}, line 3" in err
