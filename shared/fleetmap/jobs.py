"""What the map server and its clients say to each other about survey drives, and the jobs that map them.

A drive is a recording that somebody sent; its SHA-256 names it. A job is the wish that a drive become a map: any
worker takes it, for as long as it keeps renewing its lease, and the fence tells one taker from the next: what a
worker says counts only together with the fence it was given.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from fleetmap.footprint import bounding_box
from fleetmap.manifest import Int64, LatDeg, LonDeg, MapId, Sha256

MAX_DRIVE_BYTES = 1024**4
MAX_SUMMARY_BYTES = 512 * 1024  # of its JSON
_MAX_TEXT, _MAX_FINDINGS, _MAX_PLACES = 2000, 64, 5000

DriveName = Annotated[str, StringConstraints(min_length=1, max_length=255, pattern=r"^[^\x00-\x1f\x7f/\\]+$")]
JobId = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{8,64}$")]
WorkerName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9._:@-]{1,128}$")]
Stage = Annotated[str, StringConstraints(max_length=64)]
Percent = Annotated[int, Field(ge=0, le=100)]
Reason = Annotated[str, StringConstraints(max_length=_MAX_TEXT)]
Fence = Annotated[int, Field(ge=0, le=2**63 - 1)]
DriveState = Literal["received", "checked"]
JobState = Literal["queued", "running", "done", "failed", "cancelled"]
_Text = Annotated[str, StringConstraints(max_length=_MAX_TEXT)]
_BoxLonLat = tuple[LonDeg, LatDeg, LonDeg, LatDeg]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class DriveFinding(_Model):
    """One aspect of a drive; "unknown" is neither for nor against it."""

    aspect: _Text
    severity: Literal["good", "poor", "bad", "unknown"]
    text: _Text  # the numbers, and what to do where it is not good


class DriveSummary(_Model):
    """What ``fleetmap info`` finds in a recording."""

    verdict: Literal["yes", "yes, with warnings", "no"]  # is it good enough to map?
    reasons: _Text = ""  # the verdict with its reasons, in one line
    findings: Annotated[tuple[DriveFinding, ...], Field(max_length=_MAX_FINDINGS)] = ()
    start_ns: Int64 | None = None  # of the drive, UTC since the epoch
    end_ns: Int64 | None = None
    trajectory_lonlat: Annotated[tuple[tuple[LonDeg, LatDeg], ...], Field(max_length=_MAX_PLACES)] = ()  # of GNSS
    length_m: float | None = Field(default=None, ge=0.0)
    image_count: int = Field(default=0, ge=0)
    image_rate_hz: float | None = Field(default=None, ge=0.0)
    camera_width_px: int | None = Field(default=None, gt=0)
    camera_height_px: int | None = Field(default=None, gt=0)

    @property
    def bbox_lonlat(self) -> tuple[float, float, float, float] | None:
        """West, south, east, north of the trajectory in degrees; west > east where it crosses 180 degrees."""
        return bounding_box(np.array(self.trajectory_lonlat)) if self.trajectory_lonlat else None


class DriveEntry(_Model):
    """A survey drive, as the server lists it."""

    sha256: Sha256
    name: DriveName  # of the file that was sent first
    size_bytes: int = Field(gt=0, le=MAX_DRIVE_BYTES)
    received_ns: Int64  # when all of it had arrived, UTC since the epoch
    start_ns: Int64 | None = None  # of the drive; None where nothing says so
    end_ns: Int64 | None = None
    bbox_lonlat: _BoxLonLat | None = None  # west, south, east, north of the trajectory, degrees
    summary: DriveSummary | None = None
    state: DriveState = "received"  # checked: the summary is a worker's, not its sender's

    @property
    def trajectory_lonlat(self) -> tuple[tuple[float, float], ...]:
        """Where it was driven, degrees; empty where nobody knows."""
        return self.summary.trajectory_lonlat if self.summary is not None else ()


class JobEntry(_Model):
    """A drive to be made into a map: who is at it, until when, how far."""

    job_id: JobId
    drive: Sha256
    map_id: MapId  # under which the map will be published
    state: JobState = "queued"
    stage: Stage = ""  # of the mapping, while it runs
    percent: Percent = 0  # of that stage
    reason: Reason = ""  # why it failed, or was cancelled
    attempts: int = Field(default=0, ge=0)  # how often it was taken
    fence: Fence = 0  # rises each time that it is taken
    worker: str = ""  # who took it last
    lease_until_ns: Int64 = 0  # when others may take it, unless the lease is renewed
    cancel_requested: bool = False  # the worker is asked to stop
    version: Sha256 | None = None  # of the map that came of it
    created_ns: Int64
    updated_ns: Int64

    @property
    def is_over(self) -> bool:
        """Whether nothing more will happen, unless it is tried again."""
        return self.state in ("done", "failed", "cancelled")
