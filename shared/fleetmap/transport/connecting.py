"""The first words with a map server: who is there, and may we come in; else a line that says what to do."""

from __future__ import annotations

import socket
import time
from collections.abc import Sequence
from typing import Literal

from pydantic import ValidationError

from fleetmap.errors import AccessDeniedError, ServerRefusedError, ServerUnreachableError
from fleetmap.transport import protocol
from fleetmap.transport.session import Connection, NoAnswerError, ProblemError

_PROBE_S, _CONNECT_S = 1.0, 2.0
_PAUSE_S = 0.1  # between two rounds through the endpoints
_SLOW_HELLO_S = 10.0  # of a server that is there, and busy
_UNAUTHORIZED, _FORBIDDEN = 401, 403
_SERVICES = {protocol.MAP_SERVER: ("map server", "serve"), protocol.LOCALIZER: ("localizer", "locator")}
_CLOSED = "answers nobody without a token; give --token-file, or FLEETMAP_TOKEN"
_LOCKED_OUT = "does not let this token read; ask its operator"


def connect(
    endpoints: Sequence[str],
    token: str | None,
    deadline_s: float,
    refused_deadline_s: float,
    service: str = protocol.MAP_SERVER,
) -> tuple[Connection, protocol.Hello]:
    """A connection to the first of some endpoints where a map server, or a localizer, says hello.

    Args:
        endpoints: of servers that have the same maps; tried in turn, again and again.
        token: goes with every request.
        deadline_s: of the monotonic clock; each endpoint is tried once at least.
        refused_deadline_s: the same where machines are there, and refuse the connection.
        service: whose hello is wanted.

    Raises:
        AccessDeniedError: it lets nobody in without a token, or does not know ours.
        ServerRefusedError: it speaks another version of the protocol, or is the other of the two services.
        ServerUnreachableError: none was there until the deadline.
    """
    while True:
        why: ServerUnreachableError | None = None
        are_refused = True
        for endpoint in endpoints:
            left_s = max(deadline_s - time.monotonic(), _PAUSE_S)
            probe = _probe(endpoint, min(left_s, _PROBE_S))
            are_refused &= probe == "refuses"
            if probe != "accepts":
                continue
            try:
                return _connect(endpoint, token, min(left_s, _CONNECT_S / len(endpoints)), service)
            except ServerUnreachableError as error:
                why = error
        if time.monotonic() > (refused_deadline_s if are_refused else deadline_s):
            what, verb = _SERVICES[service]
            raise why or ServerUnreachableError(
                f"no {what} answers at {' or '.join(endpoints)}; start one with 'fleetmap {verb}', "
                "or give its endpoint"
            )
        time.sleep(_PAUSE_S)


def _probe(endpoint: str, timeout_s: float) -> Literal["accepts", "refuses", "silent"]:
    """What becomes of a TCP connection there; Zenoh would not tell, and try for its whole time."""
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout_s).close()
    except ConnectionRefusedError:
        return "refuses"
    except (OSError, UnicodeError):
        return "silent"
    return "accepts"


def _connect(
    endpoint: str, token: str | None, timeout_s: float, service: str
) -> tuple[Connection, protocol.Hello]:
    connection = Connection(endpoint, timeout_s, token)
    try:
        return connection, _greet(connection, service)
    except BaseException:
        connection.close()
        raise


def _greet(connection: Connection, service: str) -> protocol.Hello:
    """Make sure that a map server is behind the connection, Zenoh alone does not tell; requests then go to it."""
    endpoint = connection.endpoint
    try:
        hello = protocol.Hello.model_validate_json(connection.greet(_SLOW_HELLO_S))
    except ProblemError as error:
        if error.problem.status in (_UNAUTHORIZED, _FORBIDDEN):
            raise AccessDeniedError(f"map server at {endpoint}: {error.problem.detail}") from error
        raise ServerUnreachableError(f"map server at {endpoint}: {error.problem.detail}") from error
    except NoAnswerError as error:
        raise ServerUnreachableError(
            f"a Zenoh router answers at {endpoint}, but no map server behind it; start one with 'fleetmap serve'"
        ) from error
    except ValidationError as error:
        raise _no_map_server(endpoint) from error
    _check_version(hello, endpoint)
    if (hello.service == protocol.LOCALIZER) != (service == protocol.LOCALIZER):
        raise ServerRefusedError(f"a {hello.service} answers at {endpoint}; give the endpoint of a {service}")
    if not hello.server_id:
        raise _no_map_server(endpoint)
    if not hello.may_read:
        raise AccessDeniedError(f"map server at {endpoint} {_CLOSED if connection.token is None else _LOCKED_OUT}")
    connection.server_id = hello.server_id
    return hello


def _no_map_server(endpoint: str) -> ServerUnreachableError:
    return ServerUnreachableError(f"what listens at {endpoint} is no map server; give its endpoint")


def _check_version(hello: protocol.Hello, endpoint: str) -> None:
    if hello.protocol == protocol.PROTOCOL_VERSION:
        return
    newer = hello.protocol > protocol.PROTOCOL_VERSION
    raise ServerRefusedError(
        f"map server at {endpoint} speaks version {hello.protocol} of the protocol, this fleetmap "
        f"{protocol.PROTOCOL_VERSION}; upgrade {'this fleetmap' if newer else 'the server'}"
    )
