"""The serving side of the protocol: a Zenoh router that hands requests to plain functions.

Whatever a function does, its client gets an answer: the bytes it returns, or a problem document for
whatever it raises. Zenoh runs the callbacks of a queryable one after the other, and swallows what they
raise; so a callback only hands the request to a pool of threads.

Of servers that form a mesh each has keys of its own for its operations, and all have the key of ``hello``: Zenoh
may bring a query to every server that takes its key, and a request must be served once.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from threading import Event
from types import TracebackType
from typing import Self
from urllib.parse import unquote

import zenoh

from fleetmap.transport import protocol
from fleetmap.transport.endpoints import check_endpoint
from fleetmap.transport.lanes import Lane
from fleetmap.transport.liveliness import AliveNames
from fleetmap.transport.session import open_router
from fleetmap.transport.transfers import Transfers

_SMALL_LANE = (8, 500)  # threads, and how many requests may wait for one
_BULK_LANES = {
    protocol.CHUNK: (4, 1000),  # a request that waits holds next to nothing
    protocol.UPLOAD_CHUNK: (4, 48),  # each holds a chunk's bytes; the disk may be slow
    protocol.LOCALIZE: (4, 12),  # each holds an image
}

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Request:
    """What a client asks for."""

    server_id: str  # of the server that is asked
    operation: str
    parameters: Mapping[str, str]
    payload: bytes
    token: str | None = field(repr=False)


Handler = Callable[[Request], bytes]
Explain = Callable[[Exception], protocol.Problem]
Observe = Callable[[str, int, float, int, int], None]  # operation, status, seconds, bytes in, bytes out


class RequestService:
    """Answers requests while it stands; use it in a ``with`` statement, or close it.

    Args:
        endpoint: ``tcp/HOST:PORT`` to listen on.
        handlers: one function for each operation of the protocol; called from several threads.
        explain: the problem document for what a handler raised.
        peers: endpoints of other servers to form a mesh with; they need not be there yet.
        observe: told of each request once it is answered: operation, status, seconds since it arrived, bytes of
            its payload and of the answer; called from several threads.

    Raises:
        InputError: an endpoint is malformed.
        RunError: the endpoint cannot be listened on.
    """

    def __init__(
        self,
        endpoint: str,
        handlers: Mapping[str, Handler],
        explain: Explain,
        peers: Sequence[str] = (),
        observe: Observe | None = None,
    ) -> None:
        self._handlers, self._explain = handlers, explain
        self._observe = observe or _unobserved
        self._transfers, self._is_draining = Transfers(), False
        self._session = open_router(check_endpoint(endpoint), [check_endpoint(peer) for peer in peers])
        self.server_id = str(self._session.zid())
        self._lanes = {operation: Lane(operation, *_BULK_LANES[operation]) for operation in _BULK_LANES}
        self._lane = Lane("request", *_SMALL_LANE)
        self.vehicles = AliveNames(self._session, protocol.VEHICLES_PREFIX)
        self.servers = AliveNames(self._session, protocol.SERVERS_PREFIX)
        keys = {protocol.server_key(self.server_id, operation): operation for operation in handlers}
        if protocol.HELLO in handlers:
            keys[protocol.HELLO_KEY] = protocol.HELLO
        self._queryables = [
            self._session.declare_queryable(key, _on_the_spot(partial(self._take, key, operation)), complete=True)
            for key, operation in keys.items()
        ]
        self._alive = self._session.liveliness().declare_token(f"{protocol.SERVERS_PREFIX}/{self.server_id}")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def announce(self, announcement: protocol.Announcement) -> None:
        """Tell everybody who listens that a map has a new latest version."""
        self._session.put(
            f"{protocol.ANNOUNCED_PREFIX}/{announcement.map_id}",
            announcement.model_dump_json().encode(),
            encoding=zenoh.Encoding.APPLICATION_JSON,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def drain(self, timeout_s: float, hurry: Event | None = None) -> bool:
        """Greet nobody any more, and let transfers under way come to their ends; requests are still answered.

        Args:
            timeout_s: how long at most.
            hurry: ends the waiting once it is set.

        Returns:
            Whether no transfer is under way any more.
        """
        if not self._is_draining:
            self._is_draining = True
            self._alive.undeclare()  # type: ignore[no-untyped-call]
        return self._transfers.wait_until_quiet(timeout_s, hurry or Event())

    def close(self) -> None:
        """Finish what has been taken, take no more, and hang up."""
        for queryable in self._queryables:
            queryable.undeclare()  # type: ignore[no-untyped-call]
        for lane in (self._lane, *self._lanes.values()):
            lane.close()
        self._session.close()  # type: ignore[no-untyped-call]

    def _take(self, key: str, operation: str, query: zenoh.Query) -> None:
        """Zenoh's callback: never blocks, never raises."""
        arrived_s = time.monotonic()
        if operation == protocol.HELLO and self._is_draining:
            self._put_off(query, operation, _ENDING)
            return
        lane = self._lanes.get(operation, self._lane)
        if not lane.take(partial(self._serve, key, operation, query, arrived_s)):
            self._put_off(query, operation, _ENDING if lane.is_closed else _BUSY)

    def _put_off(self, query: zenoh.Query, operation: str, problem: protocol.Problem) -> None:
        self._observe(operation, problem.status, 0.0, 0, _reply_problem(query, problem))

    def _serve(self, key: str, operation: str, query: zenoh.Query, arrived_s: float) -> None:
        bytes_in = bytes_out = 0
        status = 200
        with self._transfers.request(operation):
            try:
                request = self._request(operation, query)
                bytes_in = len(request.payload)
                answer = self._handlers[operation](request)
            except Exception as error:
                problem = self._explain(error)
                status, bytes_out = problem.status, _reply_problem(query, problem)
            else:
                bytes_out = _reply(query, key, answer)
        self._observe(operation, status, time.monotonic() - arrived_s, bytes_in, bytes_out)

    def _request(self, operation: str, query: zenoh.Query) -> Request:
        words = dict(query.parameters)  # type: ignore[call-overload]  # the stub names a list
        parameters = {name: unquote(text) for name, text in words.items()}
        payload = b"" if query.payload is None else query.payload.to_bytes()
        attached = b"" if query.attachment is None else query.attachment.to_bytes()
        token = attached[: protocol.MAX_TOKEN_BYTES + 1].decode(errors="replace") or None
        return Request(self.server_id, operation, parameters, payload, token)


def _unobserved(operation: str, status: int, seconds: float, bytes_in: int, bytes_out: int) -> None:
    pass


_BUSY = protocol.Problem(
    type=protocol.PROBLEM_TYPE_PREFIX + "busy",
    title="Busy",
    status=503,
    detail="the server is busy; ask again",
    retry_after_s=0.1,
)
_ENDING = _BUSY.model_copy(update={"detail": "the server is ending; ask again soon", "retry_after_s": 1.0})


def _on_the_spot(take: Callable[[zenoh.Query], None]) -> zenoh.handlers.Callback[zenoh.Query]:
    """Called by the thread that has read the query: handing it to another one first costs a third of the rate."""
    return zenoh.handlers.Callback(take, indirect=False)


def _reply(query: zenoh.Query, key: str, answer: bytes) -> int:
    with query:
        try:
            query.reply(key, answer)
        except zenoh.ZError as error:  # the client has gone
            _log.debug("no reply to %s: %s", key, error)
    return len(answer)


def _reply_problem(query: zenoh.Query, problem: protocol.Problem) -> int:
    answer = problem.model_dump_json(exclude_none=True).encode()
    with query:
        try:
            query.reply_err(answer, encoding=protocol.PROBLEM_ENCODING)
        except zenoh.ZError as error:
            _log.debug("no reply to %s: %s", query.key_expr, error)
    return len(answer)
