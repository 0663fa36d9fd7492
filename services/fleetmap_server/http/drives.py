"""Jobs of mapping drives over HTTP, and taking drives out of service; the drives themselves are STAC items."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query, Response

from fleetmap.jobs import JobEntry, JobId, JobState
from fleetmap.manifest import Sha256
from fleetmap.transport.protocol import Cursor, JobPage
from fleetmap_server.http.answers import problems
from fleetmap_server.library import MapLibrary

_MAX_LIMIT, _LIMIT = 1000, 100

_Job = Annotated[JobId, Path(description="Of the job, as the list of jobs has it")]


def drive_router(library: MapLibrary) -> APIRouter:
    """The routes ``/jobs`` and ``/drives``."""
    router = APIRouter(tags=["drives"])

    @router.get("/jobs")
    def jobs(
        state: JobState | None = None,
        drive: Annotated[Sha256 | None, Query(description="SHA-256 of the recording")] = None,
        after: Annotated[Cursor | None, Query(description="next_after of the page before")] = None,
        limit: Annotated[int, Query(ge=1)] = _LIMIT,
    ) -> JobPage:
        """Jobs, newest first."""
        return library.jobs.page(state=state, drive=drive, limit=min(limit, _MAX_LIMIT), after=after)

    @router.get("/jobs/{job_id}", responses=problems(404))
    def job(job_id: _Job) -> JobEntry:
        """One job."""
        return library.jobs.get(job_id)

    @router.post("/jobs/{job_id}/cancel", responses=problems(404, 409))
    def cancel(job_id: _Job) -> JobEntry:
        """End a job that waits; ask the worker of a running one to stop."""
        return library.jobs.cancel(job_id)

    @router.post("/jobs/{job_id}/retry", responses=problems(404, 409))
    def retry(job_id: _Job) -> JobEntry:
        """Queue a job once more that failed or was cancelled."""
        return library.jobs.retry(job_id)

    @router.delete("/drives/{sha256}", status_code=204, response_class=Response, responses=problems(404))
    def retire(sha256: Annotated[Sha256, Path(description="SHA-256 of the recording")]) -> Response:
        """Take a drive out of service, with its jobs; maps that were made of it stay."""
        library.reception.retire(sha256)
        return Response(status_code=204)

    return router
