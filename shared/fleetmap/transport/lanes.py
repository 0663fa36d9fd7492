"""Threads for requests of one kind, so that no kind waits for another."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import BoundedSemaphore


class Lane:
    """A few threads, and a bounded number of requests that wait for them or are being served.

    Args:
        name: of the threads.
        threads: how many.
        places: how many requests may be here at once.
    """

    def __init__(self, name: str, threads: int, places: int) -> None:
        self.is_closed = False
        self._places = BoundedSemaphore(places)
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix=name)

    def take(self, work: Callable[[], None]) -> bool:
        """Have some work done, unless there is no place for it, or the lane is closed; never blocks."""
        if not self._places.acquire(blocking=False):
            return False
        try:
            self._pool.submit(self._do, work)
        except RuntimeError:  # the pool is shut down
            self._places.release()
            return False
        return True

    def close(self) -> None:
        """Take no more; returns when all that was taken is done."""
        self.is_closed = True
        self._pool.shutdown(wait=True)

    def _do(self, work: Callable[[], None]) -> None:
        try:
            work()
        finally:
            self._places.release()
