"""What can go wrong with a request, and the one table that turns it into a problem document (RFC 9457)."""

from __future__ import annotations

from pydantic import ValidationError

from fleetmap.errors import (
    ConflictError,
    DriveError,
    FleetmapError,
    InputError,
    JobLostError,
    MapPackageError,
    RunError,
    StorageError,
)
from fleetmap.transport.localizers import NoLocalizerError
from fleetmap.transport.problems import ProblemRow, problem_document
from fleetmap.transport.protocol import Problem

PROBLEM_MEDIA_TYPE = "application/problem+json"


class NotFoundError(InputError):
    """The server has no such map, version, part, drive or job."""


class GoneError(InputError):
    """The server had it, and took it out of service."""


class IncompleteUploadError(RunError):
    """A commit came before everything had arrived."""


class DamagedBlobError(RunError):
    """A stored blob is no longer what its name says."""


class BadRequestError(InputError):
    """A request that does not say what it must."""


class UnauthorizedError(RunError):
    """No token, or one that the server does not know."""


class ForbiddenError(RunError):
    """A token that may not do this."""


class BusyError(RunError):
    """The server cannot serve this now; asking again later helps."""

    retry_after_s = 1.0


# The first row that fits counts.
_PROBLEMS: tuple[ProblemRow, ...] = (
    (UnauthorizedError, 401, "unauthorized", "Token needed"),
    (ForbiddenError, 403, "forbidden", "Not allowed"),
    (NotFoundError, 404, "not-found", "Not found"),
    (GoneError, 410, "gone", "Retired"),
    (IncompleteUploadError, 409, "incomplete", "Upload incomplete"),
    (ConflictError, 409, "conflict", "Not as it was expected"),
    (JobLostError, 409, "job-lost", "The job is not yours"),
    (DamagedBlobError, 500, "damaged", "Stored data damaged"),
    (MapPackageError, 422, "unacceptable", "Not an acceptable map"),
    (DriveError, 422, "unacceptable", "Not an acceptable drive"),
    (StorageError, 507, "storage", "Storage full or failing"),
    (BusyError, 503, "busy", "Busy"),
    (NoLocalizerError, 503, "no-localizer", "No localizer"),
    (InputError, 400, "bad-request", "Bad request"),
    (ValidationError, 400, "bad-request", "Bad request"),
    (FleetmapError, 500, "failed", "Server error"),
)


def problem_of(error: Exception) -> Problem:
    """The problem document for whatever a request raised; what nobody foresaw is logged and told as 500."""
    return problem_document(error, _PROBLEMS, "server")
