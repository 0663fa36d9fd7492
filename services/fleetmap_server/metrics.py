"""What an operator's monitoring reads of a server: requests, transfers, and how much it keeps.

Each server has a registry of its own, so several can run in one process.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, Info, ProcessCollector
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from fleetmap import __version__
from fleetmap.errors import FleetmapError
from fleetmap_server.catalogue_size import CatalogueSize, SparingCount
from fleetmap_server.database import Database

_BUCKETS_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)

_log = logging.getLogger(__name__)


class ServerMetrics:
    """Counts what a server does; read it through ``registry``.

    Args:
        database: where the size of the catalogue is looked up at each reading; None: it is left out.
        free_bytes: room left in the store; None where nobody knows.
    """

    def __init__(
        self,
        database: Database | None = None,
        free_bytes: Callable[[], int | None] = lambda: None,
    ) -> None:
        self.registry = CollectorRegistry()
        labels = ("face", "operation")
        self._requests = Counter(
            "fleetmap_requests", "Requests answered.", (*labels, "status"), registry=self.registry
        )
        self._seconds = Histogram(
            "fleetmap_request_duration_seconds",
            "From a request's arrival to the end of its answer.",
            labels,
            buckets=_BUCKETS_S,
            registry=self.registry,
        )
        self._received = Counter(
            "fleetmap_received_bytes", "Bytes of the payloads of requests.", ("face",), registry=self.registry
        )
        self._sent = Counter(
            "fleetmap_sent_bytes", "Bytes of the payloads of answers.", ("face",), registry=self.registry
        )
        self._uploads = Counter(
            "fleetmap_uploads", "Uploads by what became of them.", ("kind", "outcome"), registry=self.registry
        )
        for face in ("zenoh", "http"):
            self._received.labels(face)
            self._sent.labels(face)
        for kind in ("map", "drive"):
            for outcome in ("begun", "committed", "failed"):
                self._uploads.labels(kind, outcome)
        Info("fleetmap_build", "The running software.", registry=self.registry).info({"version": __version__})
        ProcessCollector(registry=self.registry)
        if database is not None:
            self.registry.register(_CatalogueCollector(database, free_bytes))

    def count_vehicles(self, online: Callable[[], int]) -> None:
        """Tell also how many vehicles are connected."""
        vehicles = Gauge("fleetmap_vehicles_online", "Vehicles connected over Zenoh.", registry=self.registry)
        vehicles.set_function(online)

    def observe(
        self, face: str, operation: str, status: int, seconds: float, bytes_in: int, bytes_out: int
    ) -> None:
        """Count one request. ``operation`` comes from a short list, not from the caller's words."""
        self._requests.labels(face, operation, str(status)).inc()
        self._seconds.labels(face, operation).observe(seconds)
        self._received.labels(face).inc(bytes_in)
        self._sent.labels(face).inc(bytes_out)
        kind, outcome = _upload_outcome(operation, status)
        if outcome:
            self.count_upload(kind, outcome)

    def count_upload(self, kind: str, outcome: str) -> None:
        """Count an upload of a "map" or "drive" that was begun, committed, or failed."""
        self._uploads.labels(kind, outcome).inc()


# operation -> what is uploaded, and what has become of it once the operation succeeds
_UPLOAD_STEPS = {
    "upload/begin": ("map", "begun"),
    "upload/commit": ("map", "committed"),
    "drives/begin": ("drive", "begun"),
    "drives/commit": ("drive", "committed"),
    "POST /drives/uploads": ("drive", "begun"),
}
_TUS_PATCH = "PATCH /drives/uploads/{sha256}"  # which of them completes an upload, only its route knows
_REFUSED = 422


def _upload_outcome(operation: str, status: int) -> tuple[str, str]:
    """What a request says about an upload; two empty words if nothing."""
    if operation == _TUS_PATCH:
        return "drive", "failed" if status == _REFUSED else ""
    kind, outcome = _UPLOAD_STEPS.get(operation, ("", ""))
    return kind, outcome if status < 400 or not outcome else "failed"


class _CatalogueCollector(Collector):
    """Looks up at each reading what changes without this server's doing."""

    def __init__(self, database: Database, free_bytes: Callable[[], int | None]) -> None:
        self._size = SparingCount(database)
        self._free_bytes = free_bytes

    def collect(self) -> Iterator[Metric]:
        try:
            families = _families(self._size.read(), self._free_bytes())
        except FleetmapError as error:
            _log.warning("what the server keeps cannot be counted: %s", error)
            families = []
        yield GaugeMetricFamily("fleetmap_catalogue_up", "1 if the catalogue answers.", value=bool(families))
        yield from families


def _families(size: CatalogueSize, free_bytes: int | None) -> list[Metric]:
    families: list[Metric] = [
        GaugeMetricFamily("fleetmap_maps", "Maps in the catalogue.", value=size.maps),
        GaugeMetricFamily("fleetmap_versions", "Versions of maps that can be fetched.", value=size.versions),
        GaugeMetricFamily("fleetmap_drives", "Survey drives in the catalogue.", value=size.drives),
        _by_label("fleetmap_jobs", "Mapping jobs.", "state", size.jobs),
        _by_label("fleetmap_uploads_under_way", "Begun, not ended.", "kind", size.uploads_under_way),
        GaugeMetricFamily("fleetmap_stored_bytes", "All blobs together.", value=size.stored_bytes),
    ]
    if free_bytes is not None:
        families.append(GaugeMetricFamily("fleetmap_store_free_bytes", "Room left on the disk.", value=free_bytes))
    return families


def _by_label(name: str, documentation: str, label: str, counts: Mapping[str, int]) -> Metric:
    family = GaugeMetricFamily(name, documentation, labels=(label,))
    for value, count in counts.items():
        family.add_metric((value,), count)
    return family
