"""Map packages over Zenoh: the client, the serving side's mechanics, and the protocol. Zenoh lives here only."""

from fleetmap.transport.client import MapClient
from fleetmap.transport.protocol import DEFAULT_ENDPOINT, check_endpoint

__all__ = ["DEFAULT_ENDPOINT", "MapClient", "check_endpoint"]
