"""The requests of the protocol: what each takes, what answers it, and what its asker must be allowed to do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pydantic import BaseModel

from fleetmap.catalogue import MapEntry
from fleetmap.jobs import DriveSummary, JobEntry
from fleetmap.localization import Localized, LocalizeRequest
from fleetmap.transport import protocol

Right = Literal["none", "read", "write"]


@dataclass(frozen=True)
class Operation:
    """One kind of request: its parameters, what answers it, what the asker must be allowed to do."""

    request: type[BaseModel]
    answer: type[BaseModel] | None  # None: bytes
    right: Right
    payload: type[BaseModel] | Literal["bytes"] | None = None
    bulk: bool = False  # gives way to the others


OPERATIONS: dict[str, Operation] = {
    protocol.HELLO: Operation(protocol.HelloRequest, protocol.Hello, "none"),
    protocol.MAPS: Operation(protocol.MapsRequest, protocol.MapPage, "read"),
    protocol.MAPS_ROLLBACK: Operation(protocol.RollbackRequest, MapEntry, "write"),
    protocol.MAPS_RETIRE: Operation(protocol.RetireRequest, protocol.Retired, "write"),
    protocol.ANNOUNCEMENTS: Operation(protocol.AnnouncementsRequest, protocol.AnnouncementPage, "read"),
    protocol.MANIFEST: Operation(protocol.ManifestRequest, protocol.BlobTicket, "read"),
    protocol.CHUNK: Operation(protocol.ChunkRequest, None, "read", bulk=True),
    protocol.LOCALIZE: Operation(LocalizeRequest, Localized, "read", "bytes", bulk=True),
    protocol.UPLOAD_BEGIN: Operation(protocol.BeginRequest, protocol.UploadStatus, "write"),
    protocol.UPLOAD_CHUNK: Operation(protocol.UploadChunkRequest, protocol.Received, "write", "bytes", bulk=True),
    protocol.UPLOAD_COMMIT: Operation(protocol.CommitRequest, MapEntry, "write"),
    protocol.DRIVES_LIST: Operation(protocol.DrivesRequest, protocol.DrivePage, "read"),
    protocol.DRIVES_BEGIN: Operation(protocol.DriveBeginRequest, protocol.DriveStatus, "write"),
    protocol.DRIVES_COMMIT: Operation(protocol.DriveCommitRequest, protocol.DriveCommitted, "write", DriveSummary),
    protocol.JOBS_LIST: Operation(protocol.JobsRequest, protocol.JobPage, "read"),
    protocol.JOBS_TAKE: Operation(protocol.TakeRequest, protocol.TakenJob, "write"),
    protocol.JOBS_REPORT: Operation(protocol.ReportRequest, JobEntry, "write", DriveSummary),
    protocol.JOBS_FINISH: Operation(protocol.FinishRequest, JobEntry, "write"),
    protocol.JOBS_CANCEL: Operation(protocol.JobRequest, JobEntry, "write"),
    protocol.JOBS_RETRY: Operation(protocol.JobRequest, JobEntry, "write"),
}
