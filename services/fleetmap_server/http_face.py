"""The HTTP face in a thread of its own, so that signals stay the main thread's."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn
from starlette.types import ASGIApp

from fleetmap.errors import InputError, RunError

_STARTUP_S, _TICK_S = 10.0, 0.01
_CLOSING_S = 3.0  # for what is still under way when nobody waits for it


@contextmanager
def serving_http(app: ASGIApp, listening: socket.socket) -> Iterator[HttpFace]:
    """Serve an application on a socket that listens already, while the block runs. Raises RunError."""
    face = HttpFace(app, listening)
    try:
        face.start()
        yield face
    finally:
        face.close()


class HttpFace:
    """One application on one socket, from ``start`` on until ``close``."""

    def __init__(self, app: ASGIApp, listening: socket.socket) -> None:
        host, port = listening.getsockname()[:2]
        self.url = f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
        config = uvicorn.Config(
            app, log_config=None, log_level="warning", access_log=False, lifespan="off", ws="none"
        )
        self._server = uvicorn.Server(config)
        self.thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [listening]}, name="http", daemon=True
        )

    def start(self) -> None:
        """Begin to serve; raises RunError if that fails."""
        self.thread.start()
        deadline_s = time.monotonic() + _STARTUP_S
        while not self._server.started:
            if not self.thread.is_alive() or time.monotonic() > deadline_s:
                raise RunError(f"the HTTP face at {self.url} did not start; its reason is in the log")
            self.thread.join(_TICK_S)

    def stop(self, within_s: float) -> None:
        """Listen no more and finish what is under way, at most for so long; ``thread`` ends when that is done."""
        patience_s = max(within_s, _TICK_S)  # without any, Uvicorn does not even see that there is nothing
        self._server.config.timeout_graceful_shutdown = patience_s  # type: ignore[assignment]  # any number will do
        self._server.should_exit = True

    def close(self, at_once: bool = False) -> None:
        """End, soon or at once."""
        self._server.force_exit = self._server.force_exit or at_once
        if not self._server.should_exit:
            self.stop(_CLOSING_S)
        self.thread.join(2.0 * _CLOSING_S)


def listening_socket(host: str, port: int) -> socket.socket:
    """A socket bound to an address, so that an address in use is told before anything else happens.

    Raises:
        InputError: it is no address of this machine.
        RunError: something else listens there.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError) as error:
        raise InputError(f"'{host}' is no address to serve HTTP on; for instance 127.0.0.1 or 0.0.0.0") from error
    listening = socket.socket(family, kind, protocol)  # without its protocol asyncio would wait for 40 ms ACKs
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind(address)
        listening.listen(128)
    except (OSError, OverflowError) as error:
        listening.close()
        reason = getattr(error, "strerror", None) or error
        raise RunError(f"cannot serve HTTP on {host}:{port}: {reason}; is a server running already?") from error
    return listening
