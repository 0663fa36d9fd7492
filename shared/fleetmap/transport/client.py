"""A client of the map server: list, fetch and publish maps, send drives and map them, every byte verified."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

from pydantic import TypeAdapter, ValidationError

from fleetmap.catalogue import NEAR_RADIUS_M, MapEntry
from fleetmap.errors import InputError, TransferError
from fleetmap.jobs import DriveEntry, DriveSummary, JobEntry
from fleetmap.localization import Localized, LocalizeRequest
from fleetmap.manifest import MAX_MANIFEST_BYTES, parse_manifest
from fleetmap.transport import protocol
from fleetmap.transport.announcements import Announcements
from fleetmap.transport.download import Blob, Progress, download, download_to
from fleetmap.transport.endpoints import DEFAULT_ENDPOINT, DEFAULT_PATIENCE_S
from fleetmap.transport.link import Parameters, ServerLink
from fleetmap.transport.presence import VehiclePresence
from fleetmap.transport.protocol import BlobTicket, MapPage
from fleetmap.transport.sending import send_drive, send_map

_Page = TypeVar("_Page", MapPage, protocol.DrivePage, protocol.JobPage)
AreaLonLat = tuple[float, float, float, float]  # west, south, east, north in degrees


def _unseen(done_bytes: int, total_bytes: int) -> None:
    pass


class MapClient:
    """A connection to one map server; close it, or use it in a ``with`` statement.

    Requests are asked again when the connection breaks or the server restarts, until no answer has come
    for ``patience_s``. Each method raises ServerRefusedError where the server says no (AccessDeniedError without
    the right token), and TransferError where it answers no more.

    Args:
        endpoint: ``tcp/HOST:PORT`` of the server; or of several that have the same maps, with commas between: one
            that dies is replaced by the next.
        timeout_s: how long one request may take on a connection that stands.
        patience_s: how long the server may be away in the middle of something.
        token: what the server's operator gave us, if it wants one.
        vehicle_id: the vehicle that we are; servers see it as long as we are connected.

    Raises:
        InputError: the endpoint, or the vehicle's id, is malformed.
        AccessDeniedError: the server wants a token, or another one.
        ServerRefusedError: it speaks another version of the protocol.
        ServerUnreachableError: no map server answered within 2 s.
    """

    def __init__(
        self,
        endpoint: str = DEFAULT_ENDPOINT,
        timeout_s: float = 30.0,
        patience_s: float = DEFAULT_PATIENCE_S,
        token: str | None = None,
        vehicle_id: str | None = None,
    ) -> None:
        if vehicle_id is not None:
            _check_vehicle_id(vehicle_id)
        self._link = ServerLink(endpoint, timeout_s, patience_s, token)
        self._presence = VehiclePresence(self._link, vehicle_id) if vehicle_id is not None else None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the connection."""
        if self._presence is not None:
            self._presence.close()
        self._link.close()

    @property
    def endpoint(self) -> str:
        """Where the server is."""
        return self._link.endpoint

    @property
    def hello(self) -> protocol.Hello:
        """Which server it is, and what we may do there."""
        return self._link.hello

    def list_maps(
        self,
        near: tuple[float, float] | None = None,
        radius_m: float = NEAR_RADIUS_M,
        *,
        area_lonlat: AreaLonLat | None = None,
        from_ns: int | None = None,
        until_ns: int | None = None,
        max_count: int | None = None,
    ) -> list[MapEntry]:
        """The latest version of every map, newest first; of the first ``max_count``, if that is given.

        Args:
            near: latitude and longitude in degrees; only the maps whose trajectory passes within ``radius_m`` of
                it, nearest first.
            radius_m: see ``near``.
            area_lonlat: only maps whose trajectory meets this box.
            from_ns: only maps whose survey ended then or later (UTC since the epoch).
            until_ns: only maps whose survey began then or earlier.

        Raises:
            InputError: there is no such place on the globe.
        """
        where: dict[str, str | int | float | None] = {**_somewhere(area_lonlat, from_ns, until_ns)}
        if near is not None:
            if not (abs(near[0]) <= 90.0 and abs(near[1]) <= 180.0):
                raise InputError(f"latitude {near[0]}, longitude {near[1]} is no place on the globe")
            where |= {"lat_deg": near[0], "lon_deg": near[1], "radius_m": radius_m}
        return list(islice(self._each_map(_given(**where)), max_count))

    def versions(self, map_id: str) -> list[MapEntry]:
        """All versions of a map that are not retired, newest first."""
        return list(self._each_map({"map_id": map_id, "versions": "all"}))

    def rollback(self, map_id: str, version: str, latest: str | None = None) -> MapEntry:
        """Make the content of an older version the latest again.

        Args:
            map_id: the map.
            version: its hash, the beginning of it (8 digits or more), or its number.
            latest: the version that we take for the latest; None to go back whatever it is.

        Raises:
            ConflictError: another version became the latest since.
        """
        named = _given(map_id=map_id, version=version, latest=latest)
        return self._link.request(MapEntry, protocol.MAPS_ROLLBACK, named)

    def retire(self, map_id: str, version: str | None = None) -> int:
        """Take a version that is not the latest, or the whole map, out of service; how many numbers it was."""
        named = _given(map_id=map_id, version=version)
        return self._link.request(protocol.Retired, protocol.MAPS_RETIRE, named).retired

    def announcements(self, *, news_only: bool = False) -> Announcements:
        """The latest version of each map, unless ``news_only``, and then each new one as it comes."""
        return Announcements(self._link, news_only=news_only)

    def manifest(self, map_id: str, version: str | None = None) -> bytes:
        """The manifest of a map, byte for byte; ``version`` as in ``rollback``, without it that of the latest.

        Raises:
            TransferError: it did not arrive whole, or is that of another map.
        """
        ticket = self._link.request(BlobTicket, protocol.MANIFEST, _given(map_id=map_id, version=version))
        if ticket.size_bytes > MAX_MANIFEST_BYTES or not _names(version, ticket.version):
            raise TransferError(f"map server at {self.endpoint} offers no manifest of map '{map_id}'")
        data = self.part(map_id, ticket.version, ticket.version, ticket.size_bytes)
        if parse_manifest(data, f"map '{map_id}'").map_id != map_id:
            raise TransferError(f"map server at {self.endpoint} sent the manifest of another map than '{map_id}'")
        return data

    def part(self, map_id: str, version: str, sha256: str, size_bytes: int) -> bytes:
        """One part of a map, its length and hash verified; raises TransferError if it did not arrive whole."""
        return next(self.parts(map_id, version, {sha256: size_bytes}))

    def parts(self, map_id: str, version: str, sizes_bytes: Mapping[str, int]) -> Iterator[bytes]:
        """Parts of a map by their SHA-256, in turn; while one is worked on the next are under way.

        Raises:
            ServerRefusedError: the server has no such part.
            TransferError: one did not arrive whole.
        """
        wanted = [
            Blob(sha256, size_bytes, version, f"part {sha256[:12]} of map '{map_id}'")
            for sha256, size_bytes in sizes_bytes.items()
        ]
        return download(self._link, wanted)

    def localize_image(self, image: bytes, request: LocalizeRequest) -> Localized:
        """Where an image (JPEG or PNG) was taken, as the server's localizer finds it."""
        pending = self._link.start(protocol.LOCALIZE, request.model_dump(exclude_none=True), image)
        return self._link.read(Localized, pending.finish())

    def publish(
        self,
        manifest: bytes,
        part: Callable[[str], bytes],
        progress: Progress | None = None,
        job: JobEntry | None = None,
    ) -> MapEntry:
        """Send a map; what the server already has is not sent again.

        Args:
            manifest: the manifest's bytes.
            part: gives the bytes of the part with this SHA-256.
            progress: called with the bytes that the server has, and the bytes of the whole map.
            job: the worker's, as it was taken; publishing ends it.

        Raises:
            MapPackageError: the manifest does not hold, or a part is not what the manifest says.
            ConflictError: another version of the map became the latest since we began.
            JobLostError: the job belongs to another worker by now.
            StorageError: the server's disk is full.
            TransferError: the connection was lost; publishing again goes on from there.
        """
        return send_map(self._link, manifest, part, progress or _unseen, job)

    def drives(
        self,
        drive: str | None = None,
        *,
        area_lonlat: AreaLonLat | None = None,
        from_ns: int | None = None,
        until_ns: int | None = None,
    ) -> list[DriveEntry]:
        """Survey drives, newest first; ``drive`` is the beginning of a hash, the others as in ``list_maps``."""
        where = _given(drive=drive, **_somewhere(area_lonlat, from_ns, until_ns))
        pages = self._pages(protocol.DrivePage, protocol.DRIVES_LIST, where)
        return [drive for page in pages for drive in page.drives]

    def drive(self, sha256: str) -> DriveEntry:
        """One drive. Raises InputError where the server has none of this name."""
        found = self.drives(sha256)
        if len(found) != 1:
            raise InputError(f"map server at {self.endpoint} has {len(found)} drives '{sha256[:12]}'")
        return found[0]

    def upload_drive(
        self,
        recording: Path,
        sha256: str,
        name: str | None = None,
        *,
        map_id: str | None = None,
        summary: DriveSummary | None = None,
        progress: Progress | None = None,
    ) -> protocol.DriveCommitted:
        """Send a recording, and have it mapped as ``map_id``; what the server already has is not sent again.

        Args:
            recording: an MCAP file.
            sha256: its hash.
            name: what to call it; without it the file's name.
            map_id: of the map to be made of it; None: it is only kept.
            summary: what is known of it.
            progress: called with the bytes that the server has, and the bytes of the whole file.

        Raises:
            InputError: the file cannot be read.
            StorageError: the server's disk is full.
            TransferError: the connection was lost; sending again goes on from there.
        """
        try:
            size_bytes = recording.stat().st_size
            request = protocol.DriveBeginRequest(sha256=sha256, name=name or recording.name, size_bytes=size_bytes)
        except OSError as error:
            raise InputError(f"cannot read {recording}: {error.strerror or error}") from error
        except ValidationError as error:
            raise InputError(f"{recording} cannot be sent: its name or length is no drive's") from error
        return send_drive(self._link, recording, request, map_id, summary, progress or _unseen)

    def download_drive(self, drive: DriveEntry, path: Path, progress: Progress | None = None) -> None:
        """A recording into a file, in bounded memory; one that was cut goes on from what lies beside ``path``.

        Raises:
            RunError: another download is filling the same file.
            StorageError: the disk is full or refuses.
            TransferError: it did not arrive whole; what has come until then is kept for the next time.
        """
        blob = Blob(drive.sha256, drive.size_bytes, None, f"drive {drive.sha256[:12]}")
        download_to(path, self._link, blob, progress or _unseen)

    def jobs(self, *, drive: str | None = None, state: str | None = None) -> list[JobEntry]:
        """Mapping jobs, newest first: of all drives or one, in every state or one."""
        where = _given(drive=drive, state=state)
        return [job for page in self._pages(protocol.JobPage, protocol.JOBS_LIST, where) for job in page.jobs]

    def job(self, job_id: str) -> JobEntry:
        """One job."""
        (job,) = self._link.request(protocol.JobPage, protocol.JOBS_LIST, {"job_id": job_id}).jobs
        return job

    def take_job(self, worker: str) -> JobEntry | None:
        """A job for a worker that has none; None if there is none now."""
        return self._link.request(protocol.TakenJob, protocol.JOBS_TAKE, {"worker": worker}).job

    def report_job(
        self, job_id: str, fence: int, stage: str, percent: int, summary: DriveSummary | None = None
    ) -> JobEntry:
        """Say how far a job is, which renews its lease, and what was found in its drive.

        Raises:
            JobLostError: it belongs to another worker by now.
        """
        named: Parameters = {"job_id": job_id, "fence": fence, "stage": stage, "percent": percent}
        payload = None if summary is None else summary.model_dump_json().encode()
        return self._link.read(JobEntry, self._link.start(protocol.JOBS_REPORT, named, payload).finish())

    def finish_job(self, job_id: str, fence: int, reason: str = "", *, give_back: bool = False) -> JobEntry:
        """End a job without a map, or give it back for another worker. Raises JobLostError."""
        named: Parameters = {"job_id": job_id, "fence": fence, "reason": reason, "give_back": int(give_back)}
        return self._link.request(JobEntry, protocol.JOBS_FINISH, named)

    def cancel_job(self, job_id: str) -> JobEntry:
        """End a job that waits, or ask the worker of a running one to stop."""
        return self._link.request(JobEntry, protocol.JOBS_CANCEL, {"job_id": job_id})

    def retry_job(self, job_id: str) -> JobEntry:
        """Queue a job that failed or was cancelled once more."""
        return self._link.request(JobEntry, protocol.JOBS_RETRY, {"job_id": job_id})

    def _each_map(self, where: Parameters) -> Iterator[MapEntry]:
        return (entry for page in self._pages(MapPage, protocol.MAPS, where) for entry in page.maps)

    def _pages(self, kind: type[_Page], operation: str, where: Parameters) -> Iterator[_Page]:
        """A list's pages from the first to the last."""
        page = self._link.request(kind, operation, where)
        yield page
        while page.next_after is not None:
            page = self._link.request(kind, operation, {**where, "after": page.next_after})
            yield page


def _somewhere(
    area_lonlat: AreaLonLat | None, from_ns: int | None, until_ns: int | None
) -> dict[str, str | int | None]:
    area = None if area_lonlat is None else ",".join(f"{degrees:.9g}" for degrees in area_lonlat)
    return {"area_lonlat": area, "from_ns": from_ns, "until_ns": until_ns}


def _given(**values: str | int | float | None) -> dict[str, str | int | float]:
    return {name: value for name, value in values.items() if value is not None}


def _names(asked: str | None, version: str) -> bool:
    """Whether a version may be what was asked for: its hash, the beginning of it, a number, or just the latest."""
    return asked is None or version.startswith(asked) or re.fullmatch("[0-9]{1,7}", asked) is not None


def _check_vehicle_id(vehicle_id: str) -> None:
    try:
        TypeAdapter(protocol.VehicleId).validate_python(vehicle_id)
    except ValidationError as error:
        raise InputError(
            f"{vehicle_id!r} is no vehicle's id; write 1 to 64 letters, digits, dots, underscores and hyphens"
        ) from error
