"""What can go wrong with a request, and the one table that turns it into a problem document (RFC 9457)."""

from __future__ import annotations

import logging

from pydantic import ValidationError

from fleetmap.errors import FleetmapError, InputError, MapPackageError, RunError, StorageError
from fleetmap.transport.protocol import Problem

PROBLEM_MEDIA_TYPE = "application/problem+json"

_log = logging.getLogger(__name__)


class NotFoundError(InputError):
    """The server has no such map, version or part."""


class IncompleteUploadError(RunError):
    """A commit came before everything had arrived."""


class DamagedBlobError(RunError):
    """A stored blob is no longer what its name says."""


class BadRequestError(InputError):
    """A request that does not say what it must."""


# The first row that fits counts.
_STATUS_AND_TITLE: tuple[tuple[type[Exception], int, str], ...] = (
    (NotFoundError, 404, "Not found"),
    (IncompleteUploadError, 409, "Upload incomplete"),
    (DamagedBlobError, 500, "Stored data damaged"),
    (MapPackageError, 422, "Not an acceptable map"),
    (StorageError, 507, "Storage full or failing"),
    (InputError, 400, "Bad request"),
    (ValidationError, 400, "Bad request"),
    (FleetmapError, 500, "Server error"),
)


def problem_of(error: Exception) -> Problem:
    """The problem document for whatever a request raised; what nobody foresaw is logged and told as 500."""
    for kind, status, title in _STATUS_AND_TITLE:
        if isinstance(error, kind):
            return Problem(title=title, status=status, detail=_detail(error))
    _log.error("request failed", exc_info=error)
    return Problem(title="Internal error", status=500, detail=f"the server failed: {type(error).__name__}")


def _detail(error: Exception) -> str:
    if not isinstance(error, ValidationError):
        return str(error)
    first = error.errors()[0]
    return f"'{'.'.join(str(step) for step in first['loc'])}' does not hold: {first['msg']}"
