"""Localizers that a map server hands images to: the idlest first, and never one image to two of them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from threading import Lock

from pydantic import ValidationError

from fleetmap.errors import ServerError, ServerUnreachableError
from fleetmap.localization import Localized, LocalizeRequest
from fleetmap.transport import protocol
from fleetmap.transport.connecting import connect
from fleetmap.transport.endpoints import check_endpoint
from fleetmap.transport.session import Connection, NoAnswerError, ProblemError

ANSWER_S = 20.0  # that a localizer may take for an image, fetching maps included; a client of ours waits longer
_GREETING_S, _REFUSED_S = 1.8, 0.2
_AVOIDED_S = 2.0  # one that was away is asked last for so long
_STATUS_BUSY = 503


class NoLocalizerError(ServerUnreachableError):
    """No localizer is there to answer, or it was lost while it worked."""

    retry_after_s = 5.0


class LocalizerPool:
    """Connections to localizers, made when they are needed; safe to use from several threads. Close it.

    Args:
        endpoints: ``tcp/HOST:PORT`` of each; they need not be there yet.
        answer_s: how long an answer may take.

    Raises:
        InputError: an endpoint is malformed.
    """

    def __init__(self, endpoints: Sequence[str], answer_s: float = ANSWER_S) -> None:
        self._localizers = [_RemoteLocalizer(check_endpoint(endpoint), answer_s) for endpoint in endpoints]

    def close(self) -> None:
        """End all connections."""
        for localizer in self._localizers:
            localizer.close()

    def localize(self, request: LocalizeRequest, image: bytes, token: str | None) -> Localized:
        """Where an image was taken.

        An image is handed on to the next localizer only if the one before had not begun with it: what kills one
        must not kill all.

        Args:
            request: what goes with it.
            image: a JPEG or PNG.
            token: of whoever asks; localizers ask the map server what it may do.

        Raises:
            ProblemError: a localizer refused.
            NoLocalizerError: none is there, all are busy, or the one that was asked gave no answer.
        """
        why = "the server was started without any; its operator can give it --localizer"
        now_s = time.monotonic()
        for localizer in sorted(self._localizers, key=lambda each: each.reluctance(now_s)):
            try:
                return localizer.localize(request, image, token)
            except _NotBegunError as error:
                why = str(error)
        raise NoLocalizerError(f"no localizer answers: {why}")


class _NotBegunError(ServerError):
    """A localizer has not even looked at the image; another one may."""


class _RemoteLocalizer:
    """One localizer, and the connection to it."""

    def __init__(self, endpoint: str, answer_s: float) -> None:
        self._endpoint, self._answer_s = endpoint, answer_s
        self._lock = Lock()
        self._connection: Connection | None = None
        self._under_way = 0
        self._avoided_until_s = float("-inf")

    def reluctance(self, now_s: float) -> tuple[bool, int]:
        """What to sort by: the one to ask first has the smallest."""
        return now_s < self._avoided_until_s, self._under_way

    def close(self) -> None:
        with self._lock:
            if self._connection is not None:
                self._connection.close()

    def localize(self, request: LocalizeRequest, image: bytes, token: str | None) -> Localized:
        connection = self._connected()
        words = {name: str(value) for name, value in request.model_dump(exclude_none=True).items()}
        begun_s = time.monotonic()
        self._count(1)
        try:
            question = connection.ask(protocol.LOCALIZE, words, image, self._answer_s, bulk=True, token=token)
            return Localized.model_validate_json(question.answer())
        except ProblemError as error:
            if error.problem.status != _STATUS_BUSY:
                raise
            raise _NotBegunError(f"{self._endpoint}: {error.problem.detail}") from error
        except NoAnswerError as error:
            self._doubt(connection, time.monotonic() - begun_s)
            raise NoLocalizerError(
                f"the localizer at {self._endpoint} was lost with this image, or took longer than "
                f"{self._answer_s:g} s; asking again may help"
            ) from error
        except ValidationError as error:
            raise NoLocalizerError(f"what listens at {self._endpoint} answers what is no pose") from error
        finally:
            self._count(-1)

    def _doubt(self, connection: Connection, waited_s: float) -> None:
        """After no answer. What ended before its time was lost with its connection, also if Zenoh does not say so
        yet; where the time was over, others may still be served over it.
        """
        self._avoided_until_s = time.monotonic() + _AVOIDED_S
        if waited_s < 0.9 * self._answer_s:
            connection.close()

    def _connected(self) -> Connection:
        with self._lock:
            if self._connection is not None and not self._connection.is_broken:
                return self._connection
            if self._connection is not None:
                self._connection.close()
            now_s = time.monotonic()
            try:
                self._connection, _ = connect(
                    (self._endpoint,), None, now_s + _GREETING_S, now_s + _REFUSED_S, protocol.LOCALIZER
                )
            except ServerError as error:
                self._avoided_until_s = time.monotonic() + _AVOIDED_S
                raise _NotBegunError(str(error)) from error
            return self._connection

    def _count(self, more: int) -> None:
        with self._lock:
            self._under_way += more
