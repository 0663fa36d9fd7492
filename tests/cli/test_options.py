"""``--server`` and ``--token-file``, which every verb that talks to a map server has."""

from __future__ import annotations

import hashlib

import pytest

from fleetmap.errors import InputError
from fleetmap_cli.options import read_token

TOKEN = "t0ken-of-a-mäpper"


@pytest.fixture
def guarded(start_server, absent_server, tmp_path) -> str:
    """A map server that wants a token."""
    (tmp_path / "access").write_text(f"write mapper {hashlib.sha256(TOKEN.encode()).hexdigest()}\n")
    start_server(tmp_path / "store", absent_server, "--access", str(tmp_path / "access"))
    return absent_server


def test_a_token_opens_a_server_from_a_file_or_the_environment(
    fleetmap, map_package, guarded, absent_server, tmp_path, monkeypatch
):
    (tmp_path / "token").write_text(f"  {TOKEN}\n")
    with_file = ["--token-file", tmp_path / "token", "--server", guarded]
    code, out, err = fleetmap("publish", map_package, "--server", guarded)
    assert (code, out) == (1, "")
    assert err.splitlines()[-1] == (
        f"error: map server at {guarded} answers nobody without a token; give --token-file, or FLEETMAP_TOKEN"
    )
    assert fleetmap("publish", map_package, *with_file)[0] == 0
    assert "golden" in fleetmap("maps", "list", *with_file)[1]
    monkeypatch.setenv("FLEETMAP_TOKEN", TOKEN)
    assert "golden" in fleetmap("maps", "list", "--server", guarded)[1]
    monkeypatch.setenv("FLEETMAP_TOKEN", "mistyped")
    code, _, err = fleetmap("maps", "list", "--server", guarded)
    assert (code, "the server does not know this token" in err) == (1, True)
    assert "golden" in fleetmap("maps", "list", *with_file)[1]  # what is typed counts before the environment


@pytest.mark.parametrize("text", ["", "two words", "x" * 1025, "new\nline", "be\x07ll"])
def test_a_file_without_a_token_is_bad_input(tmp_path, text):
    (tmp_path / "token").write_text(text)
    with pytest.raises(InputError, match="token holds no token: one word of 1 to 1024 bytes"):
        read_token(tmp_path / "token")


def test_a_token_file_that_is_not_there_is_bad_input(fleetmap, tmp_path):
    code, _, err = fleetmap("maps", "list", "--token-file", tmp_path / "none")
    assert code == 2
    assert err.startswith(f"error: cannot read the token in {tmp_path / 'none'}: ")


def test_several_servers_may_be_named_and_the_one_that_is_there_is_asked(fleetmap, shared_server, absent_server):
    assert fleetmap("maps", "list", "--server", f"{absent_server},{shared_server}")[0] == 0
    code, _, err = fleetmap("maps", "list", "--server", f"{shared_server},")
    assert (code, "is no Zenoh endpoint" in err) == (2, True)
