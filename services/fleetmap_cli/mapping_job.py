"""One job of the map server's queue: a drive fetched, checked, mapped and published, or an honest end without."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import click

from fleetmap.catalogue import MapEntry
from fleetmap.errors import ConflictError, FleetmapError, JobLostError, RunError, StorageError
from fleetmap.jobs import DriveEntry, DriveSummary, JobEntry
from fleetmap.map_package import open_package
from fleetmap.transport import MapClient
from fleetmap_cli.drive_summary import reasons_against
from fleetmap_cli.job_lease import JobLease
from fleetmap_cli.mapping_process import Checked, Failed, Mapped, MappingTask, Message, Stage, mapping_process
from fleetmap_cli.patient_server import PatientServer
from fleetmap_mapper.settings import MapperSettings

_LISTEN_S = 0.2
_MAX_REASON = 2000
_MOST_CONFLICTS = 5  # versions of the same map that others publish while we do, before we give up

Ending = Literal["done", "failed", "given back", "cancelled", "lost"]


@dataclass(frozen=True)
class Workplace:
    """What a worker has: a way to its server, a folder of its own, and how it maps."""

    connect: Callable[[], MapClient]
    folder: Path
    settings: MapperSettings

    @property
    def drives(self) -> Path:
        """Recordings, whole and in part."""
        return self.folder / "drives"

    @property
    def maps(self) -> Path:
        """Packages that are being made."""
        return self.folder / "maps"


class _GiveBackError(Exception):
    """The job is for another worker, or a later time; str() says why."""


class _GoneError(Exception):
    """The job is not ours any more."""


class _UnfitError(RunError):
    """The drive, or the map that came of it, is not good enough; str() says why."""


def run_job(job: JobEntry, place: Workplace, stop: threading.Event) -> Ending:
    """See a job through to its end, and tell the server of it.

    A server that is away is waited for. ``stop`` gives the job back at once.
    """
    with JobLease(job, place.connect) as lease:
        work = _Work(job, place, lease, stop)
        with work.server:
            return work.run()


class _Work:
    """A job under way."""

    def __init__(self, job: JobEntry, place: Workplace, lease: JobLease, stop: threading.Event) -> None:
        self._job, self._place, self._lease, self._stop = job, place, lease, stop
        self._recording = place.drives / f"{job.drive}.mcap"
        self._package = place.maps / f"{job.job_id}-{job.fence}"
        self.server = PatientServer(place.connect, self._check)

    def run(self) -> Ending:
        """From the drive to the published map; every way to end is here."""
        try:
            drive = self._fetch_drive()
            self._map_drive(drive)
            entry = self._publish()
        except (_GoneError, JobLostError):
            return self._leave()
        except _GiveBackError as reason:
            return self._give_back(str(reason))
        except StorageError as error:  # of this machine
            return self._give_back(str(error))
        except FleetmapError as error:
            return self._fail(str(error))
        finally:
            shutil.rmtree(self._package, ignore_errors=True)
        self._recording.unlink(missing_ok=True)
        self._say(f"done, version {entry.version[:12]} of map '{entry.map_id}'")
        return "done"

    def _fetch_drive(self) -> DriveEntry:
        """What the drive is called; its recording lies in the folder afterwards."""
        drive = self.server.ask(lambda client: client.drive(self._job.drive))
        self._say(f"map '{self._job.map_id}' of {drive.name}, attempt {self._job.attempts}")
        if not self._recording.exists():  # else an earlier attempt fetched and verified it
            self.server.ask(lambda client: self._download(client, drive))
        return drive

    def _download(self, client: MapClient, drive: DriveEntry) -> None:
        try:
            client.download_drive(drive, self._recording, self._teller("downloading"))
        except StorageError as error:  # our disk, most likely: another worker may have room
            raise _GiveBackError(str(error)) from error

    def _map_drive(self, drive: DriveEntry) -> None:
        """Check and map in a process of its own, to which we listen, and which we end when the job is over."""
        task = MappingTask(
            self._recording, drive.name, self._package, self._job.map_id, settings=self._place.settings
        )
        with mapping_process(task) as child:
            while True:
                self._check()
                message = child.next_message(_LISTEN_S)
                if isinstance(message, Mapped):
                    return
                if message is not None:
                    self._hear(message)

    def _hear(self, message: Message) -> None:
        if isinstance(message, Stage):
            self._lease.note(message.name, message.percent)
        elif isinstance(message, Checked):
            self._report(message.summary)
            if message.summary.verdict == "no":
                raise _UnfitError(f"the drive is not good enough to map: {reasons_against(message.summary)}")
        elif isinstance(message, Failed):
            raise _GiveBackError(message.reason) if message.is_own_fault else RunError(message.reason)

    def _report(self, summary: DriveSummary) -> None:
        """What the full check found replaces what the drive's sender said."""
        job = self._job
        self.server.ask(lambda client: client.report_job(job.job_id, job.fence, "checked", 100, summary))

    def _publish(self) -> MapEntry:
        """Publish with the job's fence; whatever else of this map was published meanwhile, ours comes after it."""
        package = open_package(self._package)
        if not package.manifest.quality.publishable:
            reasons = "; ".join(package.manifest.quality.warnings) or "its quality check says so"
            raise _UnfitError(f"the map should not be published: {reasons}")
        tell = self._teller("publishing")

        def publish(client: MapClient) -> MapEntry:
            return client.publish(package.manifest_bytes, package.part_bytes, tell, job=self._job)

        for conflicts in range(_MOST_CONFLICTS + 1):
            try:
                return self.server.ask(publish)
            except ConflictError:
                if conflicts == _MOST_CONFLICTS:
                    raise
        raise AssertionError("unreachable")

    def _teller(self, stage: str) -> Callable[[int, int], None]:
        """Progress of a transfer, which ends with the job."""

        def tell(done_bytes: int, total_bytes: int) -> None:
            if done_bytes < total_bytes:  # else it may be published, and the job no longer ours for that reason
                self._check()
            self._lease.note(stage, 100 * done_bytes // total_bytes if total_bytes else 0)

        return tell

    def _check(self) -> None:
        if self._lease.ended is not None:
            raise _GoneError
        if self._stop.is_set():
            raise _GiveBackError("the worker was asked to stop")

    def _fail(self, reason: str) -> Ending:
        self._recording.unlink(missing_ok=True)
        self._say(f"failed: {reason}")
        short = reason[:_MAX_REASON]
        with suppress(_GoneError, _GiveBackError, JobLostError):  # then the lease runs out
            self.server.ask(lambda client: client.finish_job(self._job.job_id, self._job.fence, short))
        return "failed"

    def _give_back(self, reason: str) -> Ending:
        self._say(f"given back: {reason}")
        self._hand_over()
        return "given back"

    def _leave(self) -> Ending:
        """The job was cancelled, or another worker has it."""
        self._recording.unlink(missing_ok=True)
        if self._lease.ended != "cancelled":
            self._say("lost: another worker has it, or it is over")
            return "lost"
        self._say("cancelled")
        self._hand_over()
        return "cancelled"

    def _hand_over(self) -> None:
        """Say at once that we are not at it any more; where that does not arrive, the lease runs out."""
        with suppress(FleetmapError), self._place.connect() as client:
            client.finish_job(self._job.job_id, self._job.fence, give_back=True)

    def _say(self, text: str) -> None:
        click.echo(f"job {self._job.job_id[:12]}: {text}", err=True)


def clear_remains(place: Workplace, older_than_s: float, now_s: float) -> None:
    """Remove the maps that a killed worker left half made, and recordings that nobody came back for."""
    shutil.rmtree(place.maps, ignore_errors=True)
    for recording in place.drives.glob("*"):
        with suppress(OSError):
            if now_s - recording.stat().st_mtime > older_than_s:
                recording.unlink()
