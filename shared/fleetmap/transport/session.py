"""Zenoh sessions and single questions: whatever Zenoh does becomes an answer, a problem or "no answer".

Zenoh ends an iteration over replies without any error when no server is there, when the server dies and
when a message is dropped. Here an empty end is always ``NoAnswerError``.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from queue import Empty, SimpleQueue
from threading import Event
from typing import Any

import zenoh
from pydantic import ValidationError

from fleetmap.errors import RunError, ServerRefusedError, ServerUnreachableError, TransferError
from fleetmap.transport import protocol

# Batches of 64 KiB that a transmit queue may hold; 16 is Zenoh's limit. A message that finds its queue full
# waits, and while it waits for a client that has gone the whole router may stand still. So a client asks for
# no more at once than fits (see CHUNK_BYTES), and nothing ever waits.
_QUEUE_BATCHES = 16
_QUEUES = ("interactive_high", "background")
_LOOK_UP_S = 0.2  # how often someone who waits looks whether the connection still stands
_MAX_MESSAGE_BYTES = 8 * 1024 * 1024  # what a peer may make us buffer; chunks are far smaller


_log = logging.getLogger(__name__)


class NoAnswerError(TransferError):
    """No server answered, or the connection was lost before it did."""


class ProblemError(ServerRefusedError):
    """The server answered with a problem document."""

    def __init__(self, problem: protocol.Problem) -> None:
        super().__init__(problem.detail)
        self.problem = problem


class Connection:
    """A session in client mode, connected to one server, and of use only as long as that connection stands.

    Zenoh connects again by itself, but a request that falls between the two connections is lost without
    a word. So what was asked over a connection that broke counts as not answered, at once.

    Args:
        endpoint: ``tcp/HOST:PORT`` of the server.
        timeout_s: how long to try to connect.

    Raises:
        ServerUnreachableError: nothing that speaks Zenoh accepts connections there.
    """

    def __init__(self, endpoint: str, timeout_s: float) -> None:
        settings: dict[str, Any] = {
            "mode": "client",
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": round(1e3 * timeout_s),
            "connect/exit_on_failure": True,
        }
        try:
            self._session = zenoh.open(_config(settings))
        except zenoh.ZError as error:
            raise ServerUnreachableError(unreachable(endpoint)) from error
        self._broken = Event()
        self._events = self._session.info.declare_transport_events_listener(self._note)

    @property
    def is_broken(self) -> bool:
        """Whether the connection has been lost, or closed."""
        return self._broken.is_set()

    def close(self) -> None:
        """End it; what was asked over it is not answered any more."""
        self._broken.set()
        try:
            self._session.close()  # type: ignore[no-untyped-call]
        except zenoh.ZError as error:  # it waited for a link that is dead
            _log.debug("closing: %s", error)

    def ask(
        self,
        operation: str,
        parameters: Mapping[str, str],
        payload: bytes | None,
        timeout_s: float,
        bulk: bool = False,
    ) -> Question:
        """Send a request and return at once; ``bulk`` requests give way to small ones."""
        question = Question(self)
        if self.is_broken:
            question.end()
            return question
        try:
            self._session.get(
                zenoh.Selector(f"{protocol.KEY_PREFIX}/{operation}", zenoh.Parameters(dict(parameters))),
                zenoh.handlers.Callback(question.take, question.end, indirect=False),
                payload=payload,
                timeout=timeout_s,
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.BACKGROUND if bulk else zenoh.Priority.INTERACTIVE_HIGH,
            )
        except zenoh.ZError as error:
            _log.debug("cannot ask for %s: %s", operation, error)
            question.end()
        return question

    def _note(self, event: zenoh.TransportEvent) -> None:
        if event.kind == zenoh.SampleKind.DELETE:
            self._broken.set()


class Question:
    """A request on its way over a connection."""

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self._replies: SimpleQueue[zenoh.Reply | None] = SimpleQueue()  # None: there will be no more

    def take(self, reply: zenoh.Reply) -> None:
        """Zenoh's callback for each reply."""
        self._replies.put(reply)

    def end(self) -> None:
        """Zenoh's callback after the last reply."""
        self._replies.put(None)

    def answer(self) -> bytes:
        """Wait for the answer.

        Raises:
            NoAnswerError: there is none.
            ProblemError: it is a problem document.
        """
        while (reply := self._next()) is not None:
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            if reply.err is not None and str(reply.err.encoding) == protocol.PROBLEM_ENCODING:
                raise ProblemError(_problem(reply.err.payload.to_bytes()))
        raise NoAnswerError("no answer")

    def _next(self) -> zenoh.Reply | None:
        while True:
            try:
                return self._replies.get(timeout=_LOOK_UP_S)
            except Empty:
                if self.connection.is_broken:
                    return None


def _problem(data: bytes) -> protocol.Problem:
    try:
        return protocol.Problem.model_validate_json(data)
    except ValidationError:
        return protocol.Problem(title="Unknown", status=500, detail="it failed without saying why")


def open_router(endpoint: str) -> zenoh.Session:
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


def _config(settings: Mapping[str, Any]) -> zenoh.Config:
    common = {
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,  # nothing is scouted for
        # Between processes of one machine Zenoh would go around TCP, and a killed one leave its segments behind.
        "transport/shared_memory/enabled": False,
        **{f"transport/link/tx/queue/size/{queue}": _QUEUE_BATCHES for queue in _QUEUES},
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
