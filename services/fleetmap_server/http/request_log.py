"""Every HTTP request in figures and in the log, under an id that the client may choose and is told."""

from __future__ import annotations

import asyncio
import logging
import time
from dataclasses import dataclass
from urllib.parse import quote

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fleetmap_server.http.answers import problem_answer
from fleetmap_server.logs import begin_request, log_request
from fleetmap_server.metrics import ServerMetrics
from fleetmap_server.problems import problem_of

_log = logging.getLogger(__name__)

COMPLETED_DRIVE = "completed_drive"  # a route sets it in its request's state when an upload became a drive
_ID_HEADER = "X-Request-ID"
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


class RequestLog:
    """ASGI middleware around the whole application."""

    def __init__(self, app: ASGIApp, metrics: ServerMetrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Hand a request on, and note what became of it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        scope.setdefault("state", {})
        counted = _Counted(begin_request(Headers(scope=scope).get(_ID_HEADER)), receive, send)
        begun_s = time.perf_counter()
        try:
            await self._app(scope, counted.receive, counted.send)
        except Exception as error:
            if counted.started:  # too late to say so: the connection breaks
                _log.error("%s broke off", _operation(scope), exc_info=error)
            else:
                await problem_answer(problem_of(error))(scope, receive, counted.send)
        except asyncio.CancelledError:
            _log.warning("%s was cut off: the server stops", _operation(scope))
        finally:
            self._note(scope, counted, time.perf_counter() - begun_s)

    def _note(self, scope: Scope, counted: _Counted, seconds: float) -> None:
        figures = (_operation(scope), counted.status, seconds, counted.bytes_in, counted.bytes_out)
        self._metrics.observe("http", *figures)
        if scope["state"].get(COMPLETED_DRIVE):
            self._metrics.count_upload("drive", "committed")
        client = scope.get("client")
        path = f"{_method(scope)} {quote(scope['path'], safe='/:@!$&()*+,;=~')}"
        log_request("http", *figures, path=path, client=client[0] if client else "")


@dataclass
class _Counted:
    """A request's two ends, and what has gone through them."""

    request_id: str
    _receive: Receive
    _send: Send
    started: bool = False
    status: int = 500  # of a request that fails before it is answered
    bytes_in: int = 0
    bytes_out: int = 0

    async def receive(self) -> Message:
        message = await self._receive()
        self.bytes_in += len(message.get("body", b""))
        return message

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.started, self.status = True, message["status"]
            MutableHeaders(scope=message)[_ID_HEADER] = self.request_id
        await self._send(message)
        self.bytes_out += len(message.get("body", b""))


def _operation(scope: Scope) -> str:
    """Method and template of the route: of those there are few, of paths any number."""
    route = scope.get("route")
    return f"{_method(scope)} {getattr(route, 'path', None) or 'elsewhere'}"


def _method(scope: Scope) -> str:
    return scope["method"] if scope["method"] in _METHODS else "OTHER"
