"""Tokens and what they may do: the file, the rule for each operation, and how a client is told."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterator

import pytest

from fleetmap.errors import AccessDeniedError, InputError
from fleetmap.transport import MapClient
from fleetmap.transport.operations import OPERATIONS
from fleetmap.transport.session import Connection, ProblemError
from fleetmap_server.access import Access, read_access, token_of
from fleetmap_server.problems import ForbiddenError, UnauthorizedError
from fleetmap_server.server import running_server
from fleetmap_server.settings import ServerSettings

TOKENS = {"none": "locked-out", "read": "vehicle-token", "write": "mapper-tökén"}


def sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def lines(*more: str) -> str:
    return "\n".join([f"{role}\tholder-{role}  {sha256(token)}" for role, token in TOKENS.items()] + list(more))


@pytest.fixture
def access(tmp_path) -> Access:
    (tmp_path / "access").write_text("# who may do what\n\n" + lines() + "  # the last one\n")
    return read_access(tmp_path / "access")


def test_a_token_may_do_what_its_line_says(access):
    for role, token in TOKENS.items():
        caller = access.caller(token)
        assert (caller.name, caller.role) == (f"holder-{role}", role)
    assert [access.caller(TOKENS[role]).may("read") for role in TOKENS] == [False, True, True]
    assert [access.caller(TOKENS[role]).may("write") for role in TOKENS] == [False, False, True]
    assert not access.is_open


@pytest.mark.parametrize("token", ["mapper-token", "", "x" * 5000, sha256(TOKENS["write"]), "\ud800"])
def test_a_token_that_nobody_has_is_unauthorized(access, token):
    with pytest.raises(UnauthorizedError):
        access.require(token or None, "read")


def test_without_a_file_everybody_may_do_everything():
    assert Access().require(None, "write").role == "write"
    assert Access().require("whatever", "write").role == "write"


def test_the_line_with_a_star_says_what_those_without_token_may(tmp_path):
    (tmp_path / "access").write_text(lines("read *"))
    access = read_access(tmp_path / "access")
    assert access.is_open
    assert access.require(None, "read").name is None
    with pytest.raises(UnauthorizedError, match="to write here takes a token; give --token-file"):
        access.require(None, "write")
    with pytest.raises(ForbiddenError, match="the token of 'holder-read' may not write here"):
        access.require(TOKENS["read"], "write")
    with pytest.raises(UnauthorizedError):  # a mistyped token is told, not taken for none
        access.require("vehicle-tokn", "read")


@pytest.mark.parametrize(
    "line",
    ["admin me " + "0" * 64, "read vehicle " + "0" * 63, "read vehicle", "read", "read * " + "0" * 64, "x"],
)
def test_a_line_that_says_something_else_is_bad_input(tmp_path, line):
    (tmp_path / "access").write_text(lines(line))
    with pytest.raises(InputError, match=r"access, line 4: write ROLE NAME SHA256_OF_TOKEN, or ROLE \*"):
        read_access(tmp_path / "access")


def test_two_holders_of_one_token_and_a_missing_file_are_bad_input(tmp_path):
    (tmp_path / "access").write_text(lines(f"read again {sha256(TOKENS['write'])}"))
    with pytest.raises(InputError, match="line 4: another line has the same token"):
        read_access(tmp_path / "access")
    with pytest.raises(InputError, match="cannot read the access file"):
        read_access(tmp_path / "none")


def test_http_clients_give_their_token_as_bearer_or_as_password():
    assert token_of(None) is None
    assert token_of("Bearer t0ken") == token_of("bearer   t0ken ") == "t0ken"
    assert token_of("Basic " + base64.b64encode("anyone:t0:kén".encode()).decode()) == "t0:kén"
    for malformed in ("Bearer", "t0ken", "Basic !", "Basic " + base64.b64encode(b"only").decode(), "Digest x"):
        with pytest.raises(UnauthorizedError, match="neither 'Bearer TOKEN' nor Basic"):
            token_of(malformed)


@pytest.fixture(scope="module")
def guarded(tmp_path_factory, module_endpoint) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("guarded")
    (folder / "access").write_text(lines())
    settings = ServerSettings(folder / "store", module_endpoint, http_port=0, access_file=folder / "access")
    with running_server(settings):
        yield module_endpoint


def test_a_client_without_the_right_is_told_what_to_do(guarded, make_map):
    one = make_map(part_sizes=(1000,))
    with pytest.raises(AccessDeniedError, match=f"{guarded} answers nobody without a token; give --token-file"):
        MapClient(guarded)
    with pytest.raises(AccessDeniedError, match=f"{guarded}: the server does not know this token"):
        MapClient(guarded, token="mistyped")
    with pytest.raises(AccessDeniedError, match="does not let this token read"):
        MapClient(guarded, token=TOKENS["none"])
    with MapClient(guarded, token=TOKENS["read"]) as client:
        assert (client.hello.may_read, client.hello.may_write) == (True, False)
        assert client.list_maps() == []
        with pytest.raises(AccessDeniedError, match="the token of 'holder-read' may not write here"):
            client.publish(one.manifest_bytes, one.parts.__getitem__)
    with MapClient(guarded, token=TOKENS["write"]) as client:
        assert client.hello.may_write
        client.publish(one.manifest_bytes, one.parts.__getitem__)
        assert client.manifest("karlsruhe") == one.manifest_bytes


@pytest.mark.parametrize("role", [None, *TOKENS])
def test_every_operation_asks_for_its_right_before_anything_else(guarded, role):
    connection = Connection(guarded, 5.0, TOKENS["write"])
    connection.server_id = json.loads(connection.greet(10.0))["server_id"]
    connection.token = TOKENS[role] if role else None
    ranks = ["none", "read", "write"]
    try:
        for name, operation in OPERATIONS.items():
            try:
                connection.ask(name, {}, None, 10.0).answer()
                status = 200
            except ProblemError as error:
                status = error.problem.status
            allowed = ranks.index(role or "none") >= ranks.index(operation.right)
            refused = 401 if role is None else 403
            assert (status == refused) is not allowed, name
            assert allowed or status == refused, name
    finally:
        connection.close()
