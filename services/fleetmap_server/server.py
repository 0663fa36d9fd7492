"""One process, one store, two faces: Zenoh for vehicles and mappers, HTTP for people and browsers."""

from __future__ import annotations

import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

import uvicorn

from fleetmap.errors import InputError, RunError
from fleetmap_server.http_service import create_app
from fleetmap_server.library import MapLibrary, open_library
from fleetmap_server.settings import ServerSettings
from fleetmap_server.zenoh_service import serve_zenoh

_STARTUP_S, _SHUTDOWN_S = 10.0, 3
_CHECK_EVERY_S = 1.0


@dataclass(frozen=True)
class RunningServer:
    """Where a running server can be reached."""

    library: MapLibrary
    zenoh_endpoint: str
    http_url: str
    http_thread: threading.Thread


def run_server(settings: ServerSettings, announce: Callable[[str], None] = print) -> None:
    """Serve until SIGINT or SIGTERM; to be called from the main thread.

    Args:
        settings: what to serve, and where.
        announce: gets one line when both faces are ready.

    Raises:
        As ``running_server`` does; RunError also when the HTTP face ends by itself.
    """
    stop = threading.Event()
    with _stop_signals(stop), running_server(settings) as server:
        count = server.library.count()
        announce(
            f"serving {count} map{'' if count == 1 else 's'} of {settings.store}: "
            f"Zenoh {server.zenoh_endpoint}, HTTP {server.http_url}"
        )
        while not stop.wait(_CHECK_EVERY_S):
            if not server.http_thread.is_alive():
                raise RunError(f"the HTTP face at {server.http_url} ended; start the server again")


@contextmanager
def running_server(settings: ServerSettings) -> Iterator[RunningServer]:
    """A server that runs while the block does, both faces ready.

    Raises:
        RunError: an address is in use, or another server uses the store.
        InputError: an address or the store is not what it should be.
        StorageError: the store cannot be written.
    """
    with (
        _listen(settings.http_host, settings.http_port) as http_socket,
        open_library(settings.store) as library,
        serve_zenoh(library, settings.zenoh_endpoint),
        _serve_http(library, http_socket) as http_thread,
    ):
        host, port = http_socket.getsockname()[:2]
        shown = f"[{host}]" if ":" in host else host
        yield RunningServer(library, settings.zenoh_endpoint, f"http://{shown}:{port}", http_thread)


@contextmanager
def _serve_http(library: MapLibrary, listening: socket.socket) -> Iterator[threading.Thread]:
    """Uvicorn in a thread of its own: so signals stay ours."""
    config = uvicorn.Config(
        create_app(library),
        log_level="warning",
        access_log=False,
        lifespan="off",
        ws="none",
        timeout_graceful_shutdown=_SHUTDOWN_S,
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, name="http", daemon=True)
    thread.start()
    try:
        yield thread
    finally:
        server.should_exit = True
        thread.join(2 * _SHUTDOWN_S)


@contextmanager
def _listen(host: str, port: int) -> Iterator[socket.socket]:
    """A socket bound to an address, so that an address in use is told before anything else happens."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError) as error:
        raise InputError(f"'{host}' is no address to serve HTTP on; for instance 127.0.0.1 or 0.0.0.0") from error
    with socket.socket(family, kind, protocol) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind(address)
            listening.listen(128)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise RunError(
                f"cannot serve HTTP on {host}:{port}: {reason}; is a server running already?"
            ) from error
        yield listening


@contextmanager
def _stop_signals(stop: threading.Event) -> Iterator[None]:
    """SIGINT and SIGTERM set ``stop`` instead of ending the process."""

    def ask_to_stop(number: int, frame: FrameType | None) -> None:
        stop.set()

    before = {number: signal.signal(number, ask_to_stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
