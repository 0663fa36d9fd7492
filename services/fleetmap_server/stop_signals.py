"""SIGINT and SIGTERM as requests: the first to stop in good order, another one to stop at once."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Event
from types import FrameType

_ONE_REQUEST_S = 0.5  # a terminal and the program that started us may both pass on one Ctrl-C


@dataclass(frozen=True)
class StopRequests:
    """What has been asked for so far."""

    stop: Event = field(default_factory=Event)
    at_once: Event = field(default_factory=Event)


@contextmanager
def stop_requests() -> Iterator[StopRequests]:
    """While the block runs the two signals set events instead of ending the process; for the main thread."""
    asked = StopRequests()
    first_s = 0.0

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal first_s
        if not asked.stop.is_set():
            first_s = time.monotonic()
            asked.stop.set()
        elif time.monotonic() - first_s > _ONE_REQUEST_S:
            asked.at_once.set()

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
