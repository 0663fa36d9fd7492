"""A map server that may be away for as long as it likes: what is asked of it waits, with growing pauses."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import Self, TypeVar

import click

from fleetmap.errors import FleetmapError, ServerUnreachableError, StorageError, TransferError
from fleetmap.transport import MapClient

FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0
REQUEST_PATIENCE_S = 5.0  # of the connections: after that the waiting is ours
_AWAY = (ServerUnreachableError, TransferError, StorageError)  # the last: its disk is full, its database down
_LOOK_EVERY_S = 0.2

Answer = TypeVar("Answer")


class PatientServer:
    """One map server, connected to when it is needed; close it, or use it in a ``with`` statement.

    Args:
        connect: makes a connection, or raises ServerUnreachableError.
        check: called several times a second in every pause; what it raises ends the waiting.
    """

    def __init__(self, connect: Callable[[], MapClient], check: Callable[[], None]) -> None:
        self._connect, self._check = connect, check
        self._client: MapClient | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the connection, if there is one."""
        if self._client is not None:
            self._client.close()
        self._client = None

    def ask(self, question: Callable[[MapClient], Answer]) -> Answer:
        """The answer, however long the server is away or cannot store; that is said once.

        Raises:
            FleetmapError: whatever else ``question`` raises, such as ServerRefusedError.
        """
        pause_s, was_told = FIRST_PAUSE_S, False
        while True:
            try:
                answer = question(self._connected())
            except _AWAY as error:
                self.close()
                if not was_told:
                    _say(error)
                    was_told = True
                self._wait(pause_s)
                pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)
                continue
            if was_told:
                click.echo("the map server answers again", err=True)
            return answer

    def _connected(self) -> MapClient:
        if self._client is None:
            self._client = self._connect()
        return self._client

    def _wait(self, pause_s: float) -> None:
        end_s = time.monotonic() + pause_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            self._check()
            time.sleep(min(left_s, _LOOK_EVERY_S))
        self._check()


def _say(error: FleetmapError) -> None:
    click.echo(f"{error}; will be tried again", err=True)
