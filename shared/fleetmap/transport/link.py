"""Requests to one map server that outlive a broken connection and a restart of the server."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from fleetmap.errors import ServerError, ServerRefusedError, ServerUnreachableError, StorageError, TransferError
from fleetmap.transport import protocol
from fleetmap.transport.session import (
    NoAnswerError,
    ProblemError,
    Question,
    ask,
    open_client,
    unreachable,
)

_CONNECT_TIMEOUT_S = 2.0
_HELLO_TIMEOUT_S = 3.0  # from the first attempt to connect
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
        deadline_s = time.monotonic() + _HELLO_TIMEOUT_S
        self._session = open_client(endpoint, _CONNECT_TIMEOUT_S)
        try:
            self._await_hello(deadline_s)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the connection."""
        self._session.close()  # type: ignore[no-untyped-call]

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
        return ask(self._session, operation, words, payload, self._timeout_s, bulk)

    def answer(self, first: Question, operation: str, parameters: Parameters, payload: bytes | None) -> bytes:
        """The answer to a request already sent, which is sent again as long as patience lasts."""
        question, deadline_s = first, time.monotonic() + self._patience_s
        while True:
            try:
                return question.answer()
            except ProblemError as error:
                if error.problem.status != _STATUS_BUSY or time.monotonic() > deadline_s:
                    raise self._refusal(error.problem) from error
            except NoAnswerError as error:
                if time.monotonic() > deadline_s:
                    raise NoAnswerError(f"map server at {self.endpoint} answers no more") from error
            time.sleep(_PAUSE_S)
            question = self.send(operation, parameters, payload)

    def _await_hello(self, deadline_s: float) -> None:
        """Make sure that a map server is behind the connection: Zenoh alone does not tell."""
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            try:
                hello = ask(self._session, protocol.HELLO, {}, None, timeout_s=left_s).answer()
            except NoAnswerError:
                time.sleep(_PAUSE_S)
                continue
            self.read(protocol.Hello, hello)
            return
        raise ServerUnreachableError(unreachable(self.endpoint))

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
