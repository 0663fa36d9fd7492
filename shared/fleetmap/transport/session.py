"""Zenoh sessions and single questions: whatever Zenoh does becomes an answer, a problem or "no answer".

Zenoh ends an iteration over replies without any error when no server is there, when the server dies and
when a message is dropped. Here an empty end is always ``NoAnswerError``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import zenoh

from fleetmap.errors import RunError, ServerRefusedError, ServerUnreachableError, TransferError
from fleetmap.transport import protocol

# One message may wait this long for a slow link before Zenoh gives the whole connection up; the default
# of 5 s loses 5 MiB on a link of 100 kB/s.
_PATIENCE_OF_LINK_US = 60_000_000
_MAX_MESSAGE_BYTES = 8 * 1024 * 1024  # what a peer may make us buffer; chunks are far smaller

Session = zenoh.Session


class NoAnswerError(TransferError):
    """No server answered, or the connection was lost before it did."""


class ProblemError(ServerRefusedError):
    """The server answered with a problem document."""

    def __init__(self, problem: protocol.Problem) -> None:
        super().__init__(problem.detail)
        self.problem = problem


def open_client(endpoint: str, connect_timeout_s: float) -> Session:
    """A session in client mode, connected to one server.

    Raises:
        ServerUnreachableError: nothing that speaks Zenoh accepts connections there.
    """
    settings: dict[str, Any] = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": round(1e3 * connect_timeout_s),
        "connect/exit_on_failure": True,
    }
    try:
        return zenoh.open(_config(settings))
    except zenoh.ZError as error:
        raise ServerUnreachableError(unreachable(endpoint)) from error


def open_router(endpoint: str) -> Session:
    """A session in router mode that listens for clients.

    Raises:
        RunError: the endpoint cannot be listened on, for instance because another server does.
    """
    try:
        return zenoh.open(_config({"mode": "router", "listen/endpoints": [endpoint]}))
    except zenoh.ZError as error:
        raise RunError(f"cannot listen on {endpoint}: {_reason(error)}; is a server running already?") from error


def unreachable(endpoint: str) -> str:
    """The line for a server that is not there."""
    return f"no map server answers at {endpoint}; start one with 'fleetmap serve', or give its endpoint"


def ask(
    session: Session,
    operation: str,
    parameters: Mapping[str, str],
    payload: bytes | None,
    timeout_s: float,
    bulk: bool = False,
) -> Question:
    """Send a request and return at once; ``bulk`` requests give way to small ones."""
    try:
        replies = session.get(
            zenoh.Selector(f"{protocol.KEY_PREFIX}/{operation}", zenoh.Parameters(dict(parameters))),
            payload=payload,
            timeout=timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.BACKGROUND if bulk else zenoh.Priority.INTERACTIVE_HIGH,
        )
    except zenoh.ZError as error:
        raise NoAnswerError(f"cannot send a request: {error}") from error
    return Question(replies)


class Question:
    """A request on its way."""

    def __init__(self, replies: zenoh.Handler[zenoh.Reply]) -> None:
        self._replies = replies

    def answer(self) -> bytes:
        """Wait for the answer.

        Raises:
            NoAnswerError: there is none.
            ProblemError: it is a problem document.
        """
        for reply in self._replies:
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            if reply.err is not None and str(reply.err.encoding) == protocol.PROBLEM_ENCODING:
                raise ProblemError(protocol.Problem.model_validate_json(reply.err.payload.to_bytes()))
        raise NoAnswerError("no answer")


def _config(settings: Mapping[str, Any]) -> zenoh.Config:
    common = {
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # Between processes of one machine Zenoh would go around TCP, and a killed one leave its segments behind.
        "transport/shared_memory/enabled": False,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": _PATIENCE_OF_LINK_US,
        "transport/link/rx/max_message_size": _MAX_MESSAGE_BYTES,
    }
    config = zenoh.Config()
    for key, value in {**common, **settings}.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _reason(error: zenoh.ZError) -> str:
    """Zenoh's message without the places in its own source code."""
    text = str(error)
    for reason in ("Address already in use", "Cannot assign requested address", "Permission denied"):
        if reason in text:
            return reason.lower()
    return text.split(" at /")[0]
