"""One process, one store, two faces: Zenoh for vehicles and mappers, HTTP for people and browsers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from threading import Event, Thread

from fleetmap.errors import RunError
from fleetmap.transport.localizers import LocalizerPool
from fleetmap_server.access import Access, read_access
from fleetmap_server.http.app import create_app
from fleetmap_server.http_face import HttpFace, listening_socket, serving_http
from fleetmap_server.library import MapLibrary, open_library
from fleetmap_server.logs import log_request, logging_as
from fleetmap_server.metrics import ServerMetrics
from fleetmap_server.readiness import Readiness
from fleetmap_server.settings import ServerSettings
from fleetmap_server.stop_signals import StopRequests, stop_requests
from fleetmap_server.tidying import tidying
from fleetmap_server.zenoh_service import ZenohFace

_CHECK_EVERY_S = 1.0
_LOOK_EVERY_S = 0.05


@dataclass(frozen=True)
class RunningServer:
    """A running server, and where it can be reached."""

    library: MapLibrary
    zenoh_endpoint: str
    http_url: str
    zenoh: ZenohFace
    http: HttpFace

    def drain(self, within_s: float, hurry: Event) -> bool:
        """Take no new work and let transfers under way come to their ends, on both faces.

        Args:
            within_s: how long at most.
            hurry: ends the waiting once it is set.

        Returns:
            Whether all of them did.
        """
        self.http.stop(within_s)
        zenoh = Thread(target=self.zenoh.drain, args=(within_s, hurry), name="drain", daemon=True)
        zenoh.start()
        while (zenoh.is_alive() or self.http.thread.is_alive()) and not hurry.wait(_LOOK_EVERY_S):
            pass
        return not hurry.is_set()


def run_server(settings: ServerSettings, announce: Callable[[str], None] = print) -> None:
    """Serve until SIGINT or SIGTERM, then finish what is under way; to be called from the main thread.

    Args:
        settings: what to serve, and where.
        announce: gets one line when both faces are ready.

    Raises:
        As ``running_server`` does; RunError also when the HTTP face ends by itself, or when a second signal cuts
        off what is under way.
    """
    with logging_as(settings.log_format), stop_requests() as asked, running_server(settings) as server:
        count = server.library.count()
        announce(
            f"serving {count} map{'' if count == 1 else 's'} of {settings.store}: "
            f"Zenoh {server.zenoh_endpoint}, HTTP {server.http_url}"
        )
        _serve_until(asked, server)
        if not server.drain(settings.drain_s, asked.at_once):
            server.http.close(at_once=True)
            raise RunError("stopped at once by a second signal; what was under way is cut off")


@contextmanager
def running_server(settings: ServerSettings) -> Iterator[RunningServer]:
    """A server that runs while the block does, both faces ready.

    Raises:
        RunError: an address is in use, or another server uses the store.
        InputError: an address, the store or the access file is not what it should be.
        StorageError: the store cannot be written.
    """
    access = Access() if settings.access_file is None else read_access(settings.access_file)
    with (
        closing(listening_socket(settings.http_host, settings.http_port)) as listening,
        open_library(settings) as library,
        tidying(library),
    ):
        metrics = ServerMetrics(library.storage.database, library.storage.objects.free_bytes)
        observe = partial(_note_request, metrics)
        with (
            closing(LocalizerPool(settings.localizers)) as localizers,
            ZenohFace(library, settings.zenoh_endpoint, settings.peers, access, observe, localizers) as zenoh,
        ):
            metrics.count_vehicles(zenoh.vehicles_online)
            app = create_app(library, access, metrics, _readiness(library), localizers)
            with serving_http(app, listening) as http:
                yield RunningServer(library, settings.zenoh_endpoint, http.url, zenoh, http)


def _readiness(library: MapLibrary) -> Readiness:
    return Readiness({"catalogue": library.catalogue.last_serial, "store": library.storage.objects.check})


def _serve_until(asked: StopRequests, server: RunningServer) -> None:
    while not asked.stop.wait(_CHECK_EVERY_S):
        if not server.http.thread.is_alive():
            raise RunError(f"the HTTP face at {server.http_url} ended; start the server again")


def _note_request(
    metrics: ServerMetrics, operation: str, status: int, seconds: float, bytes_in: int, bytes_out: int
) -> None:
    metrics.observe("zenoh", operation, status, seconds, bytes_in, bytes_out)
    log_request("zenoh", operation, status, seconds, bytes_in, bytes_out)
