"""Map packages over Zenoh: the client, the serving side's mechanics, and the protocol. Zenoh lives here only."""

from fleetmap.transport.client import MapClient
from fleetmap.transport.endpoints import DEFAULT_ENDPOINT, DEFAULT_PATIENCE_S, check_endpoint, check_endpoints

__all__ = ["DEFAULT_ENDPOINT", "DEFAULT_PATIENCE_S", "MapClient", "check_endpoint", "check_endpoints"]
