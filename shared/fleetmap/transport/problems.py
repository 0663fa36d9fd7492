"""Problem documents (RFC 9457) for what was raised while a request was served."""

from __future__ import annotations

import logging
from collections.abc import Iterable

from pydantic import ValidationError

from fleetmap.transport.protocol import PROBLEM_TYPE_PREFIX, Problem
from fleetmap.transport.session import ProblemError

# Kind, status, the end of the problem's type, title.
ProblemRow = tuple[type[Exception], int, str, str]

_log = logging.getLogger(__name__)


def problem_document(error: Exception, rows: Iterable[ProblemRow], service: str) -> Problem:
    """The document by the first row that fits; what nobody foresaw is logged and told as 500.

    Args:
        error: its ``retry_after_s`` is told too, if it has one.
        rows: the service's errors.
        service: its name for people.
    """
    if isinstance(error, ProblemError):  # another service's, which was asked in turn
        return error.problem
    for kind, status, name, title in rows:
        if isinstance(error, kind):
            return Problem(
                type=PROBLEM_TYPE_PREFIX + name,
                title=title,
                status=status,
                detail=_detail(error),
                retry_after_s=getattr(error, "retry_after_s", None),
            )
    _log.error("request failed", exc_info=error)
    return Problem(
        type=PROBLEM_TYPE_PREFIX + "failed",
        title="Internal error",
        status=500,
        detail=f"the {service} failed: {type(error).__name__}",
    )


def _detail(error: Exception) -> str:
    if not isinstance(error, ValidationError):
        return str(error)
    first = error.errors()[0]
    message = first["msg"].removeprefix("Value error, ")
    where = ".".join(str(step) for step in first["loc"])
    return f"'{where}' does not hold: {message}" if where else message
