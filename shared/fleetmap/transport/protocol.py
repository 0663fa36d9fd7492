"""The words of the Zenoh protocol, version 1: keys, limits and every message. No Zenoh in here.

PROTOCOL.md, beside this file, says what they mean; a test holds the two together.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints, model_validator

from fleetmap.catalogue import NEAR_RADIUS_M, MapEntry
from fleetmap.jobs import (
    MAX_DRIVE_BYTES,
    DriveEntry,
    DriveName,
    Fence,
    JobEntry,
    JobId,
    JobState,
    Percent,
    Reason,
    Stage,
    WorkerName,
)
from fleetmap.manifest import MAX_PART_BYTES, Int64, LatDeg, LonDeg, MapId, Sha256

PROTOCOL_VERSION = 1
KEY_PREFIX = f"fleetmap/v{PROTOCOL_VERSION}"
HELLO_KEY = f"{KEY_PREFIX}/hello"
ANY_VERSION_HELLO = "fleetmap/*/hello"  # also a server of another version answers it
ANNOUNCED_PREFIX = f"{KEY_PREFIX}/announced"
SERVERS_PREFIX = f"{KEY_PREFIX}/alive/servers"
VEHICLES_PREFIX = f"{KEY_PREFIX}/alive/vehicles"
CHUNK_BYTES = 256 * 1024
WINDOW_CHUNKS = 3  # a client asks for at most so many at once: 768 KiB, which every transmit queue holds
UPLOAD_CHUNK_BYTES = WINDOW_CHUNKS * CHUNK_BYTES  # uploads go one at a time
MAX_CHUNK_BYTES = 1024 * 1024  # that a server sends, whatever is asked for
PROBLEM_ENCODING = "application/problem+json"
PROBLEM_TYPE_PREFIX = "urn:fleetmap:problem:"
MAX_TOKEN_BYTES = 1024
MAP_SERVER, LOCALIZER = "fleetmap-server", "fleetmap-localizer"  # what says hello

HELLO, ANNOUNCEMENTS = "hello", "announcements"
MAPS, MAPS_ROLLBACK, MAPS_RETIRE = "maps", "maps/rollback", "maps/retire"
MANIFEST, CHUNK, LOCALIZE = "manifest", "chunk", "localize"
UPLOAD_BEGIN, UPLOAD_CHUNK, UPLOAD_COMMIT = "upload/begin", "upload/chunk", "upload/commit"
DRIVES_LIST, DRIVES_BEGIN, DRIVES_COMMIT = "drives/list", "drives/begin", "drives/commit"
JOBS_LIST, JOBS_TAKE, JOBS_REPORT = "jobs/list", "jobs/take", "jobs/report"
JOBS_FINISH, JOBS_CANCEL, JOBS_RETRY = "jobs/finish", "jobs/cancel", "jobs/retry"

VersionName = Annotated[str, StringConstraints(pattern=r"^([0-9a-f]{8,64}|[1-9][0-9]{0,6})$")]  # hash or number
DrivePrefix = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{8,64}$")]
ServerId = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9._-]{0,64}$")]
VehicleId = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9._-]{1,64}$")]
Cursor = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9._~=-]{1,512}$")]


def _four_numbers(value: object) -> object:
    return value.split(",") if isinstance(value, str) else value


AreaLonLat = Annotated[tuple[LonDeg, LatDeg, LonDeg, LatDeg], BeforeValidator(_four_numbers)]


class _Message(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class Hello(_Message):
    """Who answers, and what the asker may do there."""

    service: str
    protocol: int
    fleetmap_version: str = ""
    server_id: ServerId = ""  # of the process; never empty in this version of the protocol
    catalogue_id: str = ""  # of the maps; servers of one catalogue have the same
    may_read: bool = True
    may_write: bool = True


class HelloRequest(_Message):
    """Is a map server there?"""


class Problem(_Message):
    """A problem document (RFC 9457): why a request was not served."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    retry_after_s: float | None = None  # ask again then


class _Somewhere(_Message):
    """Where and when; what is not given does not count."""

    area_lonlat: AreaLonLat | None = None  # west, south, east, north; west > east crosses 180 degrees
    from_ns: Int64 | None = None  # the drive's time overlaps from..until, UTC since the epoch
    until_ns: Int64 | None = None
    after: Cursor | None = None  # ``next_after`` of the page before

    @model_validator(mode="after")
    def _is_somewhere(self) -> _Somewhere:
        if self.area_lonlat is not None and self.area_lonlat[1] > self.area_lonlat[3]:
            raise ValueError("the area's south lies north of its north; write west,south,east,north")
        if self.from_ns is not None and self.until_ns is not None and self.from_ns > self.until_ns:
            raise ValueError("from_ns lies after until_ns")
        return self


class MapsRequest(_Somewhere):
    """Which maps to list."""

    lat_deg: LatDeg | None = None
    lon_deg: LonDeg | None = None
    radius_m: float = Field(default=NEAR_RADIUS_M, gt=0.0, le=1_000_000.0)
    map_id: MapId | None = None
    versions: Literal["latest", "all"] = "latest"

    @model_validator(mode="after")
    def _fits_together(self) -> MapsRequest:
        if (self.lat_deg is None) != (self.lon_deg is None):
            raise ValueError("lat_deg and lon_deg go together")
        if self.versions == "all" and self.map_id is None:
            raise ValueError("versions=all needs a map_id")
        return self


class MapPage(_Message):
    """Maps, and where the next page begins; None on the last."""

    maps: tuple[MapEntry, ...]
    next_after: Cursor | None = None


class RollbackRequest(_Message):
    """Make the content of an older version the latest again; with ``latest`` only if that is the latest now."""

    map_id: MapId
    version: VersionName
    latest: Sha256 | None = None


class RetireRequest(_Message):
    """Take a version that is not the latest, or without ``version`` the whole map, out of service."""

    map_id: MapId
    version: VersionName | None = None


class Retired(_Message):
    """What is out of service now; without ``version`` the whole map."""

    map_id: MapId
    version: VersionName | None = None
    retired: int = Field(default=0, ge=0)  # how many numbers of the map's history that took; 0: it was so already


class ManifestRequest(_Message):
    """Which map's manifest; without a version the latest."""

    map_id: MapId
    version: VersionName | None = None


class BlobTicket(_Message):
    """A blob that the server has."""

    version: Sha256
    sha256: Sha256
    size_bytes: int = Field(gt=0)


class ChunkRequest(_Message):
    """A piece of a blob of a published version, or without ``version`` of a drive."""

    version: Sha256 | None = None
    sha256: Sha256
    offset: int = Field(ge=0, le=MAX_DRIVE_BYTES)
    length_bytes: int = Field(default=CHUNK_BYTES, gt=0, le=MAX_CHUNK_BYTES)


class BeginRequest(_Message):
    """A version about to be published, and the length of its manifest."""

    map_id: MapId | None = None
    version: Sha256
    size_bytes: int = Field(gt=0)


class MissingBlob(_Message):
    """A blob the server still needs, and how many of its bytes it already has."""

    sha256: Sha256
    size_bytes: int = Field(gt=0)
    received_bytes: int = Field(ge=0)


class UploadStatus(_Message):
    """What is missing before a commit; ``missing`` may be only the first of them, ``missing_bytes`` counts all."""

    missing: tuple[MissingBlob, ...]
    missing_bytes: int = Field(ge=0)
    latest: Sha256 | None = None  # version of the map that is the latest now; None where there is no such map


class UploadChunkRequest(_Message):
    """The bytes of a blob from ``offset`` on; of a version, or without ``version`` of a drive."""

    version: Sha256 | None = None
    sha256: Sha256
    size_bytes: int = Field(gt=0, le=MAX_DRIVE_BYTES)
    offset: int = Field(ge=0, le=MAX_DRIVE_BYTES)

    @model_validator(mode="after")
    def _is_no_giant_part(self) -> UploadChunkRequest:
        if self.version is not None and self.size_bytes > MAX_PART_BYTES:
            raise ValueError(f"a part has at most {MAX_PART_BYTES} bytes")
        return self


class Received(_Message):
    """How many bytes of a blob the server has, from its start."""

    received_bytes: int = Field(ge=0)


class CommitRequest(_Message):
    """A version all of whose blobs have arrived; becomes the latest if ``predecessor`` still is."""

    version: Sha256
    predecessor: Sha256 | None = None  # ``latest`` of the first begin; None: there was no such map
    job_id: JobId | None = None  # of the job that made it, with the worker's fence
    fence: Fence | None = None

    @model_validator(mode="after")
    def _fits_together(self) -> CommitRequest:
        if (self.job_id is None) != (self.fence is None):
            raise ValueError("job_id and fence go together")
        return self


class AnnouncementsRequest(_Message):
    """The latest versions that became so after ``after``; 0 asks for all."""

    after: int = Field(default=0, ge=0, le=2**63 - 1)


class Announcement(_Message):
    """A map has a new latest version. A hint, no fact: ``announcements`` tells what the catalogue has."""

    map_id: MapId
    version: Sha256
    number: int = Field(ge=1)
    serial: int = Field(ge=1)  # ask ``announcements`` after the one before


class AnnouncementPage(_Message):
    """Latest versions in the order in which they became so."""

    maps: tuple[MapEntry, ...]
    after: int = Field(ge=0)  # ask from there on the next time
    more: bool  # whether there is more at once


class DrivesRequest(_Somewhere):
    """Which drives to list; ``drive`` is the beginning of a hash."""

    drive: DrivePrefix | None = None


class DrivePage(_Message):
    """Drives, newest first, and where the next page begins; None on the last."""

    drives: tuple[DriveEntry, ...]
    next_after: Cursor | None = None


class DriveBeginRequest(_Message):
    """A recording about to be sent."""

    sha256: Sha256
    name: DriveName
    size_bytes: int = Field(gt=0, le=MAX_DRIVE_BYTES)


class DriveStatus(_Message):
    """How much of a recording the server has; ``drive`` once it is listed."""

    received_bytes: int = Field(ge=0)
    drive: DriveEntry | None = None


class DriveCommitRequest(_Message):
    """A recording that has arrived; the payload may be its DriveSummary. With ``map_id`` a job is queued."""

    sha256: Sha256
    map_id: MapId | None = None


class DriveCommitted(_Message):
    """The drive as it is listed, and the job that will map it."""

    drive: DriveEntry
    job: JobEntry | None = None


class JobsRequest(_Message):
    """Which jobs to list."""

    job_id: JobId | None = None
    drive: Sha256 | None = None
    state: JobState | None = None
    after: Cursor | None = None


class JobPage(_Message):
    """Jobs, newest first, and where the next page begins; None on the last."""

    jobs: tuple[JobEntry, ...]
    next_after: Cursor | None = None


class TakeRequest(_Message):
    """A worker with nothing to do; its name is its own, and new each time that it starts."""

    worker: WorkerName


class TakenJob(_Message):
    """A job for the worker; None: there is none now."""

    job: JobEntry | None


class ReportRequest(_Message):
    """How far a job is; renews the lease. The payload may be the worker's DriveSummary."""

    job_id: JobId
    fence: Fence
    stage: Stage
    percent: Percent


class FinishRequest(_Message):
    """The end of a job without a map; ``give_back`` leaves it to another worker, and counts as no attempt."""

    job_id: JobId
    fence: Fence
    reason: Reason = ""
    give_back: bool = False


class JobRequest(_Message):
    """Which job to cancel, or to try again."""

    job_id: JobId


def server_key(server_id: str, operation: str) -> str:
    """Where one server of a mesh, and no other, takes requests for an operation."""
    return f"{KEY_PREFIX}/at/{server_id}/{operation}"
