"""The server's log: text for people or JSON for machines, and the request each line belongs to."""

from __future__ import annotations

import logging
import re
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TextIO

from pythonjsonlogger.json import JsonFormatter

from fleetmap_server.settings import LogFormat

_server = logging.getLogger("fleetmap_server")
_requests = _server.getChild("requests")
_request_id: ContextVar[str] = ContextVar("request_id", default="")
_caller: ContextVar[str] = ContextVar("caller", default="")
_SANE_ID = re.compile(r"[A-Za-z0-9._:/+=-]{1,128}")


@contextmanager
def logging_as(log_format: LogFormat | None, stream: TextIO | None = None) -> Iterator[None]:
    """While the block runs, everything that is logged goes to a stream (None: stderr) in this format.

    With a format the server tells what it does, one line for each request; without one only what goes wrong.
    """
    handler = logging.StreamHandler(stream or sys.stderr)
    handler.setFormatter(_formatter(log_format))
    handler.addFilter(_name_request)
    root = logging.getLogger()
    before, root.handlers = root.handlers, [handler]
    level = _server.level
    _server.setLevel(logging.WARNING if log_format is None else logging.INFO)
    try:
        yield
    finally:
        root.handlers = before
        _server.setLevel(level)


def begin_request(proposed_id: str | None = None) -> str:
    """From here on, what this task or thread logs belongs to a request; returns its id.

    Args:
        proposed_id: the caller's own id for it, taken if it is a short plain word.
    """
    sane = proposed_id is not None and _SANE_ID.fullmatch(proposed_id) is not None
    request_id = proposed_id if sane and proposed_id else uuid.uuid4().hex
    _request_id.set(request_id)
    _caller.set("")
    return request_id


def name_caller(name: str | None) -> None:
    """Say whose token the present request came with; None if it came without."""
    _caller.set(name or "")


def log_request(
    face: str,
    operation: str,
    status: int,
    seconds: float,
    bytes_in: int,
    bytes_out: int,
    **more: str,
) -> None:
    """One line for a request that was answered, and the end of it; ``more`` are further fields of the line."""
    if _requests.isEnabledFor(logging.INFO):
        duration_ms = round(1000.0 * seconds, 3)
        fields = {
            **{"face": face, "operation": operation, "status": status, "duration_ms": duration_ms},
            **{"bytes_in": bytes_in, "bytes_out": bytes_out},
            **more,
        }
        text = "%s %s -> %d in %.1f ms, %d bytes in, %d out"
        _requests.info(
            text, face, more.get("path", operation), status, duration_ms, bytes_in, bytes_out, extra=fields
        )
    _request_id.set("")
    _caller.set("")


def _name_request(record: logging.LogRecord) -> bool:
    """A handler's filter that lets everything pass and says what request it belongs to, and whose that is."""
    record.request_id, record.caller = _request_id.get(), _caller.get()
    return True


class _TextFormatter(logging.Formatter):
    """``2026-01-31T12:00:00.123Z INFO http GET /maps -> 200 in 3.1 ms, ... [request id and caller]``."""

    default_time_format = "%Y-%m-%dT%H:%M:%S"
    default_msec_format = "%s.%03dZ"

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(message)s")
        self.converter = time.gmtime

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the base class's name
        line = super().formatMessage(record)
        whose = " ".join(filter(None, (getattr(record, "request_id", ""), getattr(record, "caller", ""))))
        return f"{line} [{whose}]" if whose else line


def _formatter(log_format: LogFormat | None) -> logging.Formatter:
    if log_format is None:
        return logging.Formatter("%(levelname)s: %(message)s")
    if log_format == "text":
        return _TextFormatter()
    return JsonFormatter(
        "%(levelname)s %(name)s %(message)s %(request_id)s %(caller)s",
        rename_fields={"levelname": "level", "name": "logger"},
        timestamp="time",
    )
