"""Requests to one map server that outlive a broken connection and a restart of the server."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from fleetmap.errors import ServerError, ServerRefusedError, ServerUnreachableError, StorageError, TransferError
from fleetmap.transport import protocol
from fleetmap.transport.session import Connection, NoAnswerError, ProblemError, Question, unreachable

_CONNECT_TIMEOUT_S = 2.0
_HELLO_TIMEOUT_S = 2.5  # from the first attempt to connect
_PAUSE_S = 0.1  # between two attempts at the same request
_STATUS_BUSY, _STATUS_DISK_FULL = 503, 507

Parameters = Mapping[str, str | int | float]
Message = TypeVar("Message", bound=BaseModel)


class ServerLink:
    """A connection to one map server; every request of the protocol may be asked again, and is.

    Args:
        endpoint: ``tcp/HOST:PORT``.
        timeout_s: how long one request may take on a connection that stands.
        patience_s: how long a server may give no answer before a request is given up.

    Raises:
        InputError: the endpoint is malformed.
        ServerUnreachableError: no map server answered within about 3 s.
    """

    def __init__(self, endpoint: str, timeout_s: float, patience_s: float) -> None:
        self.endpoint = protocol.check_endpoint(endpoint)
        self._timeout_s = timeout_s
        self._patience_s = patience_s
        self._connection = self._connect(time.monotonic() + _HELLO_TIMEOUT_S)

    def close(self) -> None:
        """End the connection."""
        self._connection.close()

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
        """Send a request without waiting; requests with a payload, and for chunks, give way to small ones."""
        return PendingRequest(self, operation, parameters, payload)

    def send(self, operation: str, parameters: Parameters, payload: bytes | None) -> Question:
        """One attempt at a request."""
        words = {name: str(value) for name, value in parameters.items()}
        bulk = payload is not None or operation == protocol.CHUNK
        return self._connection.ask(operation, words, payload, self._timeout_s, bulk)

    def answer(self, question: Question, operation: str, parameters: Parameters, payload: bytes | None) -> bytes:
        """The answer to a request already sent.

        Where none comes it is asked again over a new connection. Patience runs from the first time on, and
        ends only after at least one more attempt, if there is a server to connect to.
        """
        deadline_s: float | None = None
        while True:
            try:
                return question.answer()
            except ProblemError as error:
                deadline_s = deadline_s or time.monotonic() + self._patience_s
                if error.problem.status != _STATUS_BUSY or time.monotonic() > deadline_s:
                    raise self._refusal(error.problem) from error
                time.sleep(_PAUSE_S)
            except NoAnswerError as error:
                if deadline_s is not None and time.monotonic() > deadline_s:
                    raise NoAnswerError(f"map server at {self.endpoint} answers no more") from error
                deadline_s = deadline_s or time.monotonic() + self._patience_s
                self._replace(question.connection, deadline_s)
            question = self.send(operation, parameters, payload)

    def _replace(self, failed: Connection, deadline_s: float) -> None:
        """Connect anew, unless that was done since ``failed`` failed; raises NoAnswerError at the deadline."""
        if failed is not self._connection:
            return
        failed.close()
        try:
            self._connection = self._connect(deadline_s)
        except ServerUnreachableError as error:
            raise NoAnswerError(f"map server at {self.endpoint} answers no more") from error

    def _connect(self, deadline_s: float) -> Connection:
        """A connection to a map server that says hello; raises ServerUnreachableError at the deadline."""
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            try:
                connection = Connection(self.endpoint, min(left_s, _CONNECT_TIMEOUT_S))
            except ServerUnreachableError:
                time.sleep(_PAUSE_S)
                continue
            try:
                self._await_hello(connection, deadline_s)
                return connection
            except NoAnswerError:
                connection.close()
            except BaseException:
                connection.close()
                raise
        raise ServerUnreachableError(unreachable(self.endpoint))

    def _await_hello(self, connection: Connection, deadline_s: float) -> None:
        """Make sure that a map server is behind the connection: Zenoh alone does not tell."""
        while not connection.is_broken and (left_s := deadline_s - time.monotonic()) > 0.0:
            try:
                hello = connection.ask(protocol.HELLO, {}, None, timeout_s=left_s).answer()
            except (NoAnswerError, ProblemError):  # not there yet, or busy
                time.sleep(_PAUSE_S)
                continue
            self.read(protocol.Hello, hello)
            return
        raise NoAnswerError("no map server says hello")

    def _refusal(self, problem: protocol.Problem) -> ServerError | StorageError:
        kind = StorageError if problem.status == _STATUS_DISK_FULL else ServerRefusedError
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
