"""Zenoh sessions and single questions: whatever Zenoh does becomes an answer, a problem or "no answer".

Zenoh ends an iteration over replies without any error when no server is there, when the server dies and
when a message is dropped. Here an empty end is always ``NoAnswerError``.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Event
from typing import Any
from urllib.parse import quote

import zenoh
from pydantic import ValidationError

from fleetmap.errors import RunError, ServerRefusedError, ServerUnreachableError, TransferError
from fleetmap.transport import protocol

# Batches of 64 KiB that a transmit queue may hold; 16 is Zenoh's limit. A message that finds its queue full
# waits, and while it waits for a client that has gone the whole router may stand still. So a client asks for
# no more at once than fits (see CHUNK_BYTES), and nothing ever waits.
_QUEUE_BATCHES = 16
_QUEUES = ("interactive_high", "background")
# Should it happen all the same, a router waits briefly, then hangs up on that client; a client waits for its link.
_PATIENCE_WITH_FULL_QUEUE = "transport/link/tx/queue/congestion_control/block/wait_before_close"
_ROUTER_WAITS_US, _CLIENT_WAITS_US = 1_000_000, 60_000_000
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
        token: goes with every request.

    Raises:
        ServerUnreachableError: nothing that speaks Zenoh accepts connections there.
    """

    def __init__(self, endpoint: str, timeout_s: float, token: str | None = None) -> None:
        self.endpoint = endpoint
        self.server_id = ""  # of the server that requests go to; see ``greet``
        self.token = token
        settings: dict[str, Any] = {
            "mode": "client",
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": round(1e3 * timeout_s),
            "connect/exit_on_failure": True,
            _PATIENCE_WITH_FULL_QUEUE: _CLIENT_WAITS_US,
        }
        try:
            self._session = zenoh.open(_config(settings))
        except zenoh.ZError as error:
            raise ServerUnreachableError(
                f"what listens at {endpoint} is no map server; give its endpoint"
            ) from error
        self._broken = Event()
        self._declared: list[object] = []  # what Zenoh forgets once nobody holds it
        self._events = self._session.info.declare_transport_events_listener(
            zenoh.handlers.Callback(self._note, indirect=False)
        )

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

    def greet(self, timeout_s: float) -> bytes:
        """A server's answer to hello; preferably of the one at the other end, else of any that can be reached.

        Raises:
            NoAnswerError: no map server can be reached over this connection, or none answered in time.
            ProblemError: as ``Question.answer``.
        """
        nearest = [protocol.server_key(str(zid), protocol.HELLO) for zid in self._session.info.routers_zid()]
        deadline_s = time.monotonic() + timeout_s
        for key in (*nearest, protocol.HELLO_KEY, protocol.ANY_VERSION_HELLO):
            left_s = deadline_s - time.monotonic()
            with suppress(NoAnswerError):
                return self._get(key, {}, None, max(left_s, _LOOK_UP_S), False, self.token).answer()
        raise NoAnswerError("no map server says hello")

    def watch(self, key_expression: str, notice: Callable[[bytes], None]) -> None:
        """Hand every sample published under some keys to ``notice``, on a thread of Zenoh's."""
        with suppress(zenoh.ZError):  # on a connection that has just been lost; the next will do it
            self._declared.append(
                self._session.declare_subscriber(key_expression, lambda sample: notice(sample.payload.to_bytes()))
            )

    def be_alive_as(self, key: str) -> None:
        """Keep a liveliness token as long as it stands."""
        with suppress(zenoh.ZError):
            self._declared.append(self._session.liveliness().declare_token(key))

    def ask(
        self,
        operation: str,
        parameters: Mapping[str, str],
        payload: bytes | None,
        timeout_s: float,
        bulk: bool = False,
        token: str | None = None,
    ) -> Question:
        """Send a request to the greeted server and return at once.

        Those that are ``bulk`` give way to small ones; ``token`` goes with it in place of the connection's.
        """
        key = protocol.server_key(self.server_id, operation)
        return self._get(key, parameters, payload, timeout_s, bulk, token or self.token)

    def _get(
        self,
        key: str,
        parameters: Mapping[str, str],
        payload: bytes | None,
        timeout_s: float,
        bulk: bool,
        token: str | None,
    ) -> Question:
        question = Question(self)
        if self.is_broken:
            question.end()
            return question
        try:
            self._session.get(
                zenoh.Selector(key, zenoh.Parameters({name: quote(text) for name, text in parameters.items()})),
                zenoh.handlers.Callback(question.take, question.end, indirect=False),
                payload=payload,
                attachment=token,
                timeout=timeout_s,
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.BACKGROUND if bulk else zenoh.Priority.INTERACTIVE_HIGH,
            )
        except zenoh.ZError as error:
            _log.debug("cannot ask for %s: %s", key, error)
            question.end()
        return question

    def _note(self, event: zenoh.TransportEvent) -> None:
        if event.kind == zenoh.SampleKind.DELETE:
            self._broken.set()


class Question:
    """A request on its way over a connection."""

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.asked_s = self.answered_s = time.monotonic()
        self._replies: SimpleQueue[zenoh.Reply | None] = SimpleQueue()  # None: there will be no more

    def take(self, reply: zenoh.Reply) -> None:
        """Zenoh's callback for each reply."""
        self.answered_s = time.monotonic()
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


# Any client of a router may say that it answers any key. Requests carry tokens, so they end at this server: what
# is asked over its router is never passed on to somebody who pretends to be one.
_NO_REQUEST_LEAVES = {
    "enabled": True,
    "default_permission": "allow",
    "rules": [
        {
            "id": "requests",
            "messages": ["query"],
            "flows": ["egress"],
            "permission": "deny",
            "key_exprs": ["fleetmap/**"],
        }
    ],
    "subjects": [{"id": "everybody"}],
    "policies": [{"rules": ["requests"], "subjects": ["everybody"]}],
}


def open_router(endpoint: str, peers: Sequence[str] = ()) -> zenoh.Session:
    """A session in router mode that listens for clients, and forms a mesh with ``peers``, once they are there.

    Raises:
        RunError: the endpoint cannot be listened on, for instance because another server does.
    """
    settings: dict[str, Any] = {
        "mode": "router",
        "listen/endpoints": [endpoint],
        "connect/endpoints": list(peers),
        "connect/timeout_ms": -1,  # for as long as it takes, in the background
        "connect/exit_on_failure": False,
        _PATIENCE_WITH_FULL_QUEUE: _ROUTER_WAITS_US,
        "access_control": _NO_REQUEST_LEAVES,
    }
    try:
        return zenoh.open(_config(settings))
    except zenoh.ZError as error:
        raise RunError(f"cannot listen on {endpoint}: {_reason(error)}; is a server running already?") from error


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
