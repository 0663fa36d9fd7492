"""Drives that wait to be mapped, and the workers that are at them.

A worker takes a job for the length of a lease and renews it with every report. Where a lease has run out, the job
goes to whoever asks next. Each taking raises the job's fence, and only who knows the present fence is heard, so a
worker that was thought dead cannot disturb its successor; the fence is checked in the very transaction that
publishes the map, so of one job comes one map at most.

Leases in the catalogue's own transactions rather than a queue library: those that are well kept serve PostgreSQL
alone or want a broker of their own, none serves SQLite as well, and none could take part in the transaction that
publishes.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from fleetmap.errors import ConflictError, JobLostError
from fleetmap.jobs import JobEntry, JobState
from fleetmap.transport.protocol import JobPage
from fleetmap_server.database import Database
from fleetmap_server.keyset import Keyset, Term
from fleetmap_server.problems import NotFoundError

LEASE_S = 60.0
MAX_ATTEMPTS = 3  # a recording on which so many workers died is at fault itself
_PAGE = 100

_COLUMNS = ", ".join(JobEntry.model_fields)
_OVERDUE = "state = 'running' AND lease_until_ns < :now"
_TO_BE_ENDED = f"{_OVERDUE} AND (cancel_requested = 1 OR attempts >= {MAX_ATTEMPTS})"
_TAKEABLE = f"(state = 'queued' OR ({_OVERDUE}))"
_NEWEST_FIRST = (Term("created_ns", int, True), Term("job_id", str, True))


class Jobs:
    """The jobs of one catalogue; safe to use from several threads and processes.

    Args:
        database: that of the catalogue.
        clock: UTC since the epoch in nanoseconds.
        lease_s: how long a worker may be silent before its job is given to another.
    """

    def __init__(
        self, database: Database, clock: Callable[[], int] = time.time_ns, lease_s: float = LEASE_S
    ) -> None:
        self._database = database
        self._clock = clock
        self._lease_ns = round(lease_s * 1e9)

    def queue(self, connection: Connection, drive: str, map_id: str) -> JobEntry:
        """A job that maps a drive: the one that waits, runs or is done already, else a new one.

        Raises:
            NotFoundError: there is no such drive.
        """
        now_ns = self._clock()
        self._end_overdue(connection, now_ns)
        _check_drive(connection, drive)
        found = _rows(
            connection,
            "drive = :drive AND map_id = :map_id AND state IN ('queued', 'running', 'done')"
            " ORDER BY CASE state WHEN 'done' THEN 1 ELSE 0 END, created_ns DESC LIMIT 1",
            drive=drive,
            map_id=map_id,
        )
        if found:
            return found[0]
        job = JobEntry(
            job_id=uuid.uuid4().hex[:16], drive=drive, map_id=map_id, created_ns=now_ns, updated_ns=now_ns
        )
        places = ", ".join(f":{name}" for name in JobEntry.model_fields)
        values = job.model_dump() | {"cancel_requested": 0}
        connection.execute(sa.text(f"INSERT INTO jobs ({_COLUMNS}) VALUES ({places})"), values)
        return job

    def take(self, worker: str) -> JobEntry | None:
        """The job that has waited longest, now leased to a worker; None if there is none.

        Asked again by a worker that holds a job, it gives the same one: the first answer was lost.
        """
        if not self._is_work_there(worker):
            return None
        with self._database.writing() as connection:
            now_ns = self._clock()
            self._end_overdue(connection, now_ns)
            held = _rows(
                connection, "state = 'running' AND worker = :worker AND cancel_requested = 0", worker=worker
            )
            if held:
                return self._update(connection, held[0], now_ns, lease_until_ns=now_ns + self._lease_ns)
            waiting = _rows(connection, f"{_TAKEABLE} ORDER BY created_ns, job_id LIMIT 1", now=now_ns)
            if not waiting:
                return None
            job = waiting[0]
            taken = {"state": "running", "attempts": job.attempts + 1, "fence": job.fence + 1, "worker": worker}
            until_ns = now_ns + self._lease_ns
            return self._update(connection, job, now_ns, **(_AFRESH | taken | {"lease_until_ns": until_ns}))

    def forgive_silence(self) -> None:
        """Let every lease begin anew, when a server starts: its workers had nobody to report to."""
        now_ns = self._clock()
        with self._database.writing() as connection:
            sql = (
                "UPDATE jobs SET lease_until_ns = :until"
                " WHERE state = 'running' AND cancel_requested = 0 AND lease_until_ns < :until"
            )
            connection.execute(sa.text(sql), {"until": now_ns + self._lease_ns})

    def report(self, job_id: str, fence: int, stage: str, percent: int) -> JobEntry:
        """Note how far a job is and renew its lease, unless the worker is to stop (``cancel_requested``).

        Raises:
            NotFoundError: there is no such job.
            JobLostError: it is not, or no longer, the worker's with this fence.
        """
        with self._database.writing() as connection:
            now_ns = self._clock()
            job = _held(connection, job_id, fence)
            until_ns = job.lease_until_ns if job.cancel_requested else now_ns + self._lease_ns
            return self._update(connection, job, now_ns, stage=stage, percent=percent, lease_until_ns=until_ns)

    def finish(self, job_id: str, fence: int, reason: str, give_back: bool = False) -> JobEntry:
        """End a job without a map: as failed, as cancelled where that was asked for, or ``give_back`` it.

        A job given back is queued again, and this attempt does not count. Said twice it changes nothing.

        Raises:
            NotFoundError, JobLostError: as ``report``.
        """
        with self._database.writing() as connection:
            now_ns = self._clock()
            job = _job(connection, job_id)
            if job.fence == fence and job.state in ("queued", "failed", "cancelled"):
                return job  # the answer was lost
            job = _held(connection, job_id, fence)
            if job.cancel_requested:
                return self._update(connection, job, now_ns, state="cancelled", reason=reason or "cancelled")
            if give_back:
                attempts = max(job.attempts - 1, 0)
                return self._update(connection, job, now_ns, **_AFRESH, state="queued", attempts=attempts)
            reason = reason or "its worker gave no reason"
            return self._update(connection, job, now_ns, state="failed", reason=reason)

    def fulfil(self, connection: Connection, job_id: str, fence: int, version: str) -> JobEntry:
        """End a job with a map, inside the transaction that publishes it; said twice it changes nothing.

        Raises:
            NotFoundError, JobLostError: as ``report``; also JobLostError if the job is being cancelled.
        """
        job = _job(connection, job_id)
        if (job.state, job.fence, job.version) == ("done", fence, version):
            return job
        job = _held(connection, job_id, fence)
        if job.cancel_requested:
            raise JobLostError(f"job {job_id} is being cancelled; its map is not wanted any more")
        return self._update(connection, job, self._clock(), state="done", percent=100, version=version)

    def cancel(self, job_id: str) -> JobEntry:
        """End a job that waits; ask the worker of a running one to stop.

        Raises:
            NotFoundError: there is no such job.
            ConflictError: it is over.
        """
        with self._database.writing() as connection:
            return self._cancel(connection, _job(connection, job_id), "cancelled")

    def retry(self, job_id: str) -> JobEntry:
        """Queue a job once more that failed or was cancelled.

        Raises:
            NotFoundError: there is no such job, or its drive is gone.
            ConflictError: it is done, or its drive has another job for the same map.
        """
        with self._database.writing() as connection:
            now_ns = self._clock()
            self._end_overdue(connection, now_ns)
            job = _job(connection, job_id)
            if job.state in ("queued", "running"):
                return job
            if job.state == "done":
                raise ConflictError(f"job {job_id} is done; its map is version {(job.version or '')[:12]}")
            _check_drive(connection, job.drive)
            others = _rows(
                connection,
                "drive = :drive AND map_id = :map_id AND state IN ('queued', 'running')",
                drive=job.drive,
                map_id=job.map_id,
            )
            if others:
                raise ConflictError(f"job {others[0].job_id} makes the same map of the same drive; wait for it")
            return self._update(connection, job, now_ns, **_AFRESH, state="queued", attempts=0)

    def cancel_all_of(self, connection: Connection, drive: str) -> None:
        """Cancel the jobs of a drive that is given up."""
        for job in _rows(connection, "drive = :drive AND state IN ('queued', 'running')", drive=drive):
            self._cancel(connection, job, "its drive was retired")

    def get(self, job_id: str) -> JobEntry:
        """One job. Raises NotFoundError."""
        self._end_overdue_if_any()
        with self._database.reading() as connection:
            return _job(connection, job_id)

    def page(
        self,
        *,
        state: JobState | None = None,
        drive: str | None = None,
        limit: int = _PAGE,
        after: str | None = None,
    ) -> JobPage:
        """Jobs, newest first, behind ``next_after`` of the page before; raises BadRequestError for another."""
        self._end_overdue_if_any()
        order = Keyset("jobs", _NEWEST_FIRST, after)
        where, values = order.behind(order.begin)
        for name, value in (("state", state), ("drive", drive)):
            if value is not None:
                where += f" AND {name} = :{name}"
                values[name] = value
        with self._database.reading() as connection:
            found = _rows(connection, f"{where} ORDER BY {order.sql} LIMIT {limit + 1}", **values)
        page = tuple(found[:limit])
        return JobPage(jobs=page, next_after=order.cursor(page[-1]) if len(found) > limit else None)

    def counts(self) -> dict[JobState, int]:
        """How many jobs there are in each state."""
        self._end_overdue_if_any()
        with self._database.reading() as connection:
            rows = connection.execute(sa.text("SELECT state, count(*) FROM jobs GROUP BY state")).all()
        none: dict[JobState, int] = dict.fromkeys(("queued", "running", "done", "failed", "cancelled"), 0)
        return none | {state: int(count) for state, count in rows}

    def _is_work_there(self, worker: str) -> bool:
        """Workers ask often: they need not take turns with those who write in order to hear no."""
        where = f"{_TAKEABLE} OR (state = 'running' AND worker = :worker) LIMIT 1"
        with self._database.reading() as connection:
            return bool(_rows(connection, where, now=self._clock(), worker=worker))

    def _end_overdue_if_any(self) -> None:
        with self._database.reading() as connection:
            if not _rows(connection, f"{_TO_BE_ENDED} LIMIT 1", now=self._clock()):
                return
        with self._database.writing() as connection:
            self._end_overdue(connection, self._clock())

    def _end_overdue(self, connection: Connection, now_ns: int) -> None:
        """What nobody is at any more, and nobody else is to try."""
        for job in _rows(connection, _TO_BE_ENDED, now=now_ns):
            if job.cancel_requested:
                self._update(connection, job, now_ns, state="cancelled", reason="cancelled")
                continue
            reason = f"{job.attempts} workers fell silent over it, the last ('{job.worker}') "
            reason += f"at {job.stage} {job.percent} %" if job.stage else "before its first report"
            self._update(connection, job, now_ns, state="failed", reason=reason)

    def _cancel(self, connection: Connection, job: JobEntry, reason: str) -> JobEntry:
        now_ns = self._clock()
        if job.state == "queued" or (job.state == "running" and job.lease_until_ns < now_ns):
            return self._update(connection, job, now_ns, state="cancelled", reason=reason)
        if job.state == "running":
            return self._update(connection, job, now_ns, cancel_requested=1)
        if job.state == "cancelled":
            return job
        raise ConflictError(f"job {job.job_id} is over: it {'failed' if job.state == 'failed' else 'is done'}")

    def _update(self, connection: Connection, job: JobEntry, now_ns: int, **changes: object) -> JobEntry:
        changes["updated_ns"] = now_ns
        assignments = ", ".join(f"{name} = :{name}" for name in changes)
        sql = f"UPDATE jobs SET {assignments} WHERE job_id = :job_id"
        connection.execute(sa.text(sql), changes | {"job_id": job.job_id})
        return JobEntry.model_validate(job.model_dump() | changes)


_AFRESH = {"stage": "", "percent": 0, "reason": "", "worker": "", "cancel_requested": 0, "lease_until_ns": 0}


def _held(connection: Connection, job_id: str, fence: int) -> JobEntry:
    """A running job, for the one who has its fence. Raises NotFoundError, JobLostError."""
    job = _job(connection, job_id)
    if job.state != "running":
        raise JobLostError(f"job {job_id} is not running any more, it is {job.state}; take another")
    if job.fence != fence:
        raise JobLostError(f"job {job_id} was taken over by '{job.worker}' since; take another")
    return job


def _job(connection: Connection, job_id: str) -> JobEntry:
    found = _rows(connection, "job_id = :job_id", job_id=job_id)
    if not found:
        raise NotFoundError(f"the server has no job {job_id}; 'fleetmap jobs list' names those it has")
    return found[0]


def _check_drive(connection: Connection, drive: str) -> None:
    sql = "SELECT 1 FROM drives WHERE sha256 = :drive AND retired_ns IS NULL"
    if connection.execute(sa.text(sql), {"drive": drive}).first() is None:
        raise NotFoundError(f"the server has no drive {drive[:12]}; upload it")


def _rows(connection: Connection, where: str, **values: object) -> list[JobEntry]:
    rows = connection.execute(sa.text(f"SELECT {_COLUMNS} FROM jobs WHERE {where}"), values)
    return [JobEntry.model_validate(dict(row)) for row in rows.mappings()]
