"""A vehicle's token of life."""

from __future__ import annotations

from contextlib import suppress
from threading import Event, Thread

from fleetmap.errors import ServerError
from fleetmap.transport import protocol
from fleetmap.transport.link import ServerLink

_LOOK_EVERY_S = 0.5


class VehiclePresence:
    """Keeps a vehicle alive in the eyes of its servers, also while it asks for nothing."""

    def __init__(self, link: ServerLink, vehicle_id: str) -> None:
        self._link = link
        self._closed = Event()
        link.attach(lambda connection: connection.be_alive_as(f"{protocol.VEHICLES_PREFIX}/{vehicle_id}"))
        self._thread = Thread(target=self._keep, name="presence", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leave it to the connection, which takes the token with it."""
        self._closed.set()

    def _keep(self) -> None:
        while not self._closed.wait(_LOOK_EVERY_S):
            if self._link.is_broken:
                with suppress(ServerError):  # still away
                    self._link.request(protocol.Hello, protocol.HELLO, {})
