"""A worker's hold on its job: reports that renew the lease, in a thread beside the work.

It has a connection of its own, so that a transfer that stands still does not cost the job. While the server is
away the work goes on; if another worker has the job by then, the next report says so.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Literal, Self

from fleetmap.errors import FleetmapError, JobLostError
from fleetmap.jobs import JobEntry
from fleetmap.transport import MapClient

_REPORTS_PER_LEASE = 4.0
_NEWS_EVERY_S = 2.0  # a new percentage is told no more often than this
_LEAVE_S = 1.0  # how long the end of the block waits for a report under way

End = Literal["lost", "cancelled"]
Standing = tuple[str, int]  # stage, percent of it


class JobLease:
    """Keeps a job for as long as the block runs, and hears when it is over.

    Args:
        job: as it was taken; its lease says how often to report.
        connect: makes a connection to the server, for this thread alone.
    """

    def __init__(self, job: JobEntry, connect: Callable[[], MapClient]) -> None:
        self._job, self._connect = job, connect
        self._renew_every_s = 1e-9 * (job.lease_until_ns - job.updated_ns) / _REPORTS_PER_LEASE
        self._standing: Standing = ("", 0)
        self._told: Standing | None = None
        self._left = threading.Event()
        self._ended: End | None = None
        self._thread = threading.Thread(target=self._keep, name="lease", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._left.set()
        self._thread.join(_LEAVE_S)

    @property
    def ended(self) -> End | None:
        """Why the job is not ours any more; None as long as it is."""
        return self._ended

    def note(self, stage: str, percent: int) -> None:
        """Where the work stands, for the next report."""
        self._standing = (stage, percent)

    def _keep(self) -> None:
        client: MapClient | None = None
        while self._ended is None and not self._wait_for_news():
            try:
                client = client or self._connect()
                self._report(client)
            except JobLostError:
                self._ended = "lost"
            except FleetmapError:  # the server is away or in trouble: the next report comes soon enough
                continue
        if client is not None:
            client.close()

    def _report(self, client: MapClient) -> None:
        standing = self._standing
        job = client.report_job(self._job.job_id, self._job.fence, *standing)
        self._told = standing
        if job.cancel_requested:
            self._ended = "cancelled"

    def _wait_for_news(self) -> bool:
        """Wait until a report is due; True if the block has ended instead."""
        since_s = time.monotonic()
        while not self._left.wait(min(_NEWS_EVERY_S, self._renew_every_s)):
            if self._standing != self._told or time.monotonic() - since_s >= self._renew_every_s:
                return False
        return True
