"""Requests to one map server that outlive a broken connection and a restart of the server."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from threading import RLock
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from fleetmap.errors import (
    AccessDeniedError,
    ConflictError,
    JobLostError,
    RunError,
    ServerRefusedError,
    ServerUnreachableError,
    StorageError,
    TransferError,
)
from fleetmap.transport import protocol
from fleetmap.transport.connecting import connect
from fleetmap.transport.endpoints import check_endpoints
from fleetmap.transport.operations import OPERATIONS
from fleetmap.transport.pace import Pace
from fleetmap.transport.session import Connection, NoAnswerError, ProblemError, Question

_GREETING_S = 1.8  # a server that is not there is told within 2 s,
_REFUSED_S = 0.5  # sooner where its machine is there and says so; it may be starting just now
_MAX_TIMEOUT_GROWTH = 8
_PAUSE_S = 0.1  # between two attempts at the same request
_STATUS_BUSY, _STATUS_DISK_FULL = 503, 507
_NO_LOCALIZER = f"{protocol.PROBLEM_TYPE_PREFIX}no-localizer"  # nor will there soon be one
_REFUSALS: dict[str, type[RunError]] = {
    "unauthorized": AccessDeniedError,
    "forbidden": AccessDeniedError,
    "conflict": ConflictError,
    "job-lost": JobLostError,
}

Parameters = Mapping[str, str | int | float]
Message = TypeVar("Message", bound=BaseModel)


class ServerLink:
    """A connection to one map server; every request of the protocol may be asked again, and is.

    Args:
        endpoint: ``tcp/HOST:PORT``, or several of servers that have the same maps, with commas between.
        timeout_s: how long one request may take on a connection that stands.
        patience_s: how long a server may give no answer before a request is given up.
        token: goes with every request.

    Raises:
        InputError: the endpoint is malformed.
        AccessDeniedError: the server wants a token, or another one.
        ServerRefusedError: it speaks another version of the protocol.
        ServerUnreachableError: no map server answered within 2 s.
    """

    def __init__(
        self,
        endpoint: str,
        timeout_s: float,
        patience_s: float,
        token: str | None = None,
    ) -> None:
        self.endpoint = endpoint
        self._endpoints = check_endpoints(endpoint)
        self._token = token
        self._prepare: list[Callable[[Connection], None]] = []
        self._lock = RLock()  # of the connection's replacement
        self._is_closed = False
        self._timeout_s = timeout_s
        self._patience_s = patience_s
        self.pace = {protocol.CHUNK: Pace(), protocol.UPLOAD_CHUNK: Pace()}
        now_s = time.monotonic()
        self._connection = self._connect(now_s + _GREETING_S, now_s + _REFUSED_S)

    def close(self) -> None:
        """End the connection for good; what is under way in other threads ends without an answer."""
        self._is_closed = True
        self._connection.close()

    @property
    def is_broken(self) -> bool:
        """Whether the next request will need a new connection."""
        return self._connection.is_broken

    def attach(self, prepare: Callable[[Connection], None]) -> None:
        """Have something done with the connection, and with each that replaces it."""
        with self._lock:
            self._prepare.append(prepare)
            prepare(self._connection)

    def request(self, message: type[Message], operation: str, parameters: Parameters) -> Message:
        """Ask for a JSON message.

        Raises:
            ServerRefusedError, StorageError: the server said why not.
            TransferError: no answer came, or not the one the protocol promises.
        """
        return self.read(message, self.start(operation, parameters).finish())

    def read(self, message: type[Message], data: bytes) -> Message:
        """A JSON message that the server sent."""
        try:
            return message.model_validate_json(data)
        except ValidationError as error:
            raise TransferError(f"map server at {self.endpoint} answers what no {message.__name__} is") from error

    def start(self, operation: str, parameters: Parameters, payload: bytes | None = None) -> PendingRequest:
        """Send a request without waiting; those of bulk operations give way to small ones."""
        return PendingRequest(self, operation, parameters, payload)

    def send(self, operation: str, parameters: Parameters, payload: bytes | None, attempts: int = 0) -> Question:
        """One attempt at a request, more patient than those before: what is slow must not begin anew forever."""
        words = {name: str(value) for name, value in parameters.items()}
        bulk = OPERATIONS[operation].bulk
        return self._connection.ask(
            operation, words, payload, self._timeout_s * min(2**attempts, _MAX_TIMEOUT_GROWTH), bulk
        )

    def answer(self, question: Question, operation: str, parameters: Parameters, payload: bytes | None) -> bytes:
        """The answer to a request already sent.

        Where none comes it is asked again over a new connection. Patience runs from the first time on, and
        ends only after at least one more attempt, if there is a server to connect to.
        """
        deadline_s: float | None = None
        losses = 0
        while True:
            try:
                answer = question.answer()
                if operation in self.pace:
                    carried_bytes = len(answer) + len(payload or b"")
                    self.pace[operation].note_answer(carried_bytes, question.asked_s, question.answered_s)
                return answer
            except ProblemError as error:
                deadline_s = deadline_s or time.monotonic() + self._patience_s
                is_busy = error.problem.status == _STATUS_BUSY and error.problem.type != _NO_LOCALIZER
                if not is_busy or time.monotonic() > deadline_s:
                    raise self._refusal(error.problem) from error
                time.sleep(_PAUSE_S)
            except NoAnswerError as error:
                if deadline_s is not None and time.monotonic() > deadline_s:
                    raise NoAnswerError(f"map server at {self.endpoint} answers no more") from error
                deadline_s = deadline_s or time.monotonic() + self._patience_s
                self._replace(question.connection, deadline_s)
                for pace in self.pace.values():
                    pace.note_loss()
                losses += 1
            question = self.send(operation, parameters, payload, losses)

    def _replace(self, failed: Connection, deadline_s: float) -> None:
        """Connect anew, unless that was done since ``failed`` failed; raises NoAnswerError at the deadline."""
        with self._lock:
            if failed is not self._connection:
                return
            failed.close()
            try:
                if not self._is_closed:
                    self._connection = self._connect(deadline_s, deadline_s)
            except ServerUnreachableError as error:
                raise NoAnswerError(f"map server at {self.endpoint} answers no more") from error
            if self._is_closed:  # before, or meanwhile
                self._connection.close()
                raise NoAnswerError(f"the connection to {self.endpoint} was closed")

    def _connect(self, deadline_s: float, refused_deadline_s: float) -> Connection:
        """A connection to a map server that says hello; raises as ``connect``."""
        connection, self.hello = connect(self._endpoints, self._token, deadline_s, refused_deadline_s)
        for prepare in self._prepare:
            prepare(connection)
        return connection

    def _refusal(self, problem: protocol.Problem) -> RunError:
        kind = _REFUSALS.get(problem.type.removeprefix(protocol.PROBLEM_TYPE_PREFIX), ServerRefusedError)
        if problem.status == _STATUS_DISK_FULL:
            kind = StorageError
        elif problem.status == _STATUS_BUSY:  # for all of our patience: as good as away
            kind = ServerUnreachableError
        return kind(f"map server at {self.endpoint}: {problem.detail}")


class PendingRequest:
    """A request on its way to the server."""

    def __init__(self, link: ServerLink, operation: str, parameters: Parameters, payload: bytes | None) -> None:
        self._link = link
        self._request = (operation, parameters, payload)
        self._question = link.send(*self._request)

    def finish(self) -> bytes:
        """Wait for the answer; raises as ``ServerLink.request`` does."""
        return self._link.answer(self._question, *self._request)
