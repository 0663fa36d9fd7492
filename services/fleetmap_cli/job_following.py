"""Watching a mapping job until it is over."""

from __future__ import annotations

import time
from collections.abc import Callable

from fleetmap.errors import RunError
from fleetmap.jobs import JobEntry
from fleetmap.transport import MapClient
from fleetmap_cli.patient_server import PatientServer
from fleetmap_cli.progress import StageBar

_LOOK_EVERY_S = 1.0


def follow_job(job_id: str, connect: Callable[[], MapClient]) -> JobEntry:
    """Show how far a job is until it is done; a server that is away is waited for.

    Raises:
        RunError: the job failed, or was cancelled.
        ServerRefusedError: the server has no such job.
    """
    with PatientServer(connect, check=lambda: None) as server, StageBar() as bar:
        while not (job := server.ask(lambda client: client.job(job_id))).is_over:
            bar(job.stage or job.state, job.percent, 100)
            time.sleep(_LOOK_EVERY_S)
        if job.state != "done":
            ended = "failed" if job.state == "failed" else "was cancelled"
            raise RunError(f"job {job.job_id} {ended}: {job.reason}")
        return job
