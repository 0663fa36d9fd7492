"""The serving side of the protocol: a Zenoh router that hands requests to plain functions.

Whatever a function does, its client gets an answer: the bytes it returns, or a problem document for
whatever it raises. Zenoh runs the callbacks of a queryable one after the other, and swallows what they
raise; so a callback only hands the request to a pool of threads.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import BoundedSemaphore
from types import TracebackType
from typing import Self

import zenoh

from fleetmap.transport import protocol
from fleetmap.transport.session import open_router

Handler = Callable[[Mapping[str, str], bytes], bytes]  # parameters, payload -> answer
Explain = Callable[[Exception], protocol.Problem]

_THREADS = 8
_MAX_WAITING = 64  # requests of all clients, each holding at most a few chunks' worth of memory

_log = logging.getLogger(__name__)


class RequestService:
    """Answers requests while it stands; use it in a ``with`` statement, or close it.

    Args:
        endpoint: ``tcp/HOST:PORT`` to listen on.
        handlers: one function for each operation of the protocol; called from several threads.
        explain: the problem document for what a handler raised.

    Raises:
        InputError: the endpoint is malformed.
        RunError: the endpoint cannot be listened on.
    """

    def __init__(self, endpoint: str, handlers: Mapping[str, Handler], explain: Explain) -> None:
        self._explain = explain
        self._room = BoundedSemaphore(_MAX_WAITING)
        self._session = open_router(protocol.check_endpoint(endpoint))
        self._pool = ThreadPoolExecutor(_THREADS, thread_name_prefix="request")
        self._queryables = [
            self._session.declare_queryable(_key(operation), partial(self._take, operation, handler))
            for operation, handler in handlers.items()
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Finish what has been taken, take no more, and hang up."""
        for queryable in self._queryables:
            queryable.undeclare()  # type: ignore[no-untyped-call]
        self._pool.shutdown(wait=True)
        self._session.close()  # type: ignore[no-untyped-call]

    def _take(self, operation: str, handler: Handler, query: zenoh.Query) -> None:
        """Zenoh's callback: never blocks, never raises."""
        if not self._room.acquire(blocking=False):
            _reply_problem(query, _BUSY)
            return
        try:
            self._pool.submit(self._serve, operation, handler, query)
        except RuntimeError:  # the pool is shut down
            self._room.release()
            _reply_problem(query, _BUSY)

    def _serve(self, operation: str, handler: Handler, query: zenoh.Query) -> None:
        try:
            answer = _call(handler, query)
        except Exception as error:
            _reply_problem(query, self._explain(error))
        else:
            _reply(query, operation, answer)
        finally:
            self._room.release()


_BUSY = protocol.Problem(title="Busy", status=503, detail="the server is busy; ask again")


def _key(operation: str) -> str:
    return f"{protocol.KEY_PREFIX}/{operation}"


def _call(handler: Handler, query: zenoh.Query) -> bytes:
    parameters = dict(query.parameters)  # type: ignore[call-overload]  # the stub names a list
    payload = b"" if query.payload is None else query.payload.to_bytes()
    return handler(parameters, payload)


def _reply(query: zenoh.Query, operation: str, answer: bytes) -> None:
    with query:
        try:
            query.reply(_key(operation), answer)
        except zenoh.ZError as error:  # the client has gone
            _log.debug("no reply to %s: %s", operation, error)


def _reply_problem(query: zenoh.Query, problem: protocol.Problem) -> None:
    with query:
        try:
            query.reply_err(problem.model_dump_json().encode(), encoding=protocol.PROBLEM_ENCODING)
        except zenoh.ZError as error:
            _log.debug("no reply to %s: %s", query.key_expr, error)
