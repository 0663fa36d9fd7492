"""What a map server needs to know before it starts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fleetmap.transport import DEFAULT_ENDPOINT

DEFAULT_HTTP_HOST, DEFAULT_HTTP_PORT = "127.0.0.1", 8000


@dataclass(frozen=True)
class ServerSettings:
    """Where maps are kept and where the server listens."""

    store: Path = Path("maps")
    zenoh_endpoint: str = DEFAULT_ENDPOINT
    http_host: str = DEFAULT_HTTP_HOST
    http_port: int = DEFAULT_HTTP_PORT  # 0: any free port
