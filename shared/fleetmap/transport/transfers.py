"""Whether pieces of something large are coming and going: a server that ends waits for them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Lock

from fleetmap.transport.operations import OPERATIONS

_QUIET_S = 1.0  # without a piece of a transfer: none is under way
_LOOK_EVERY_S = 0.1


class Transfers:
    """Counts requests of transfers; safe to use from several threads."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._under_way = 0
        self._last_s = float("-inf")

    @contextmanager
    def request(self, operation: str) -> Iterator[None]:
        """While the block runs, a request is being answered."""
        if not (OPERATIONS[operation].bulk or operation.startswith("upload/")):
            yield
            return
        self._note(1)
        try:
            yield
        finally:
            self._note(-1)

    def wait_until_quiet(self, timeout_s: float, hurry: Event) -> bool:
        """Wait until none was under way for a while; False if the time was over first, or ``hurry`` was set."""
        deadline_s = time.monotonic() + timeout_s
        while not self._is_quiet():
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0 or hurry.wait(min(left_s, _LOOK_EVERY_S)):
                return False
        return True

    def _note(self, more: int) -> None:
        with self._lock:
            self._under_way += more
            self._last_s = time.monotonic()

    def _is_quiet(self) -> bool:
        with self._lock:
            return self._under_way == 0 and time.monotonic() - self._last_s >= _QUIET_S
