"""What a map server needs to know before it starts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sqlalchemy.engine import URL

from fleetmap.errors import InputError
from fleetmap.transport import DEFAULT_ENDPOINT

DEFAULT_HTTP_HOST, DEFAULT_HTTP_PORT = "127.0.0.1", 8000
CATALOGUE_NAME = "catalogue.sqlite"
DEFAULT_DRAIN_S, DEFAULT_LEASE_S = 30.0, 60.0

LogFormat = Literal["text", "json"]


@dataclass(frozen=True)
class ServerSettings:
    """Where maps are kept, where the server listens, and how it behaves."""

    store: Path | str = Path("maps")  # a folder, or s3://BUCKET/PREFIX, gs://.., az://..
    zenoh_endpoint: str = DEFAULT_ENDPOINT
    http_host: str = DEFAULT_HTTP_HOST
    http_port: int = DEFAULT_HTTP_PORT  # 0: any free port
    catalogue: str | None = None  # URL of a database; None: an SQLite file in the store's folder
    access_file: Path | None = None  # who may read and write; None: everyone may
    peers: tuple[str, ...] = ()  # Zenoh endpoints of other servers of the same mesh
    localizers: tuple[str, ...] = ()  # Zenoh endpoints of services that say where images were taken
    keep_versions: int | None = None  # of each map; None: all
    drain_s: float = DEFAULT_DRAIN_S  # how long transfers under way may go on after SIGTERM
    lease_s: float = DEFAULT_LEASE_S  # how long a worker may be silent before its job is given to another
    log_format: LogFormat | None = None  # one line for each request; None: only what goes wrong, as text

    @property
    def store_is_folder(self) -> bool:
        """Whether maps are kept in a folder of this machine."""
        return isinstance(self.store, Path) or "://" not in self.store

    @property
    def catalogue_url(self) -> str:
        """URL of the catalogue's database.

        Raises:
            InputError: the store is a bucket, and no catalogue was given to go with it.
        """
        if self.catalogue is not None:
            return self.catalogue
        if not self.store_is_folder:
            raise InputError(
                f"the store {self.store} cannot hold a catalogue itself: give --catalogue, for instance "
                "postgresql://USER:PASSWORD@HOST:5432/DATABASE or sqlite:///FILE"
            )
        file = Path(self.store) / CATALOGUE_NAME
        return URL.create("sqlite", database=str(file)).render_as_string(hide_password=False)
