"""Rendering many images at once, in order, with the same bytes as one after the other.

Threads, not processes: nearly all of a frame's time is spent in compiled code that lets other threads run, so that
two threads measured as fast as two processes, and the world, which may take hundreds of megabytes, is in memory
once. Ctrl-C and errors arrive in the caller's thread as they do without any of this.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from fleetmap.errors import InputError

Job = TypeVar("Job")
Result = TypeVar("Result")

_AHEAD = 2  # results that may wait for the caller, beside those being made


def render_many(
    render_one: Callable[[Job], Result], jobs: Iterable[Job], workers: int | None = None
) -> Iterator[Result]:
    """What ``render_one`` makes of each job, in the order of the jobs, with several jobs at work at a time.

    Args:
        render_one: a pure function of its job, called from several threads; let it encode the image as well.
        jobs: such as poses or indices; read only a few ahead of the results, so it may be endless.
        workers: how many jobs are at work at a time; by default as many as this process has cores. At most two
            more results are kept in memory.

    Raises:
        InputError: less than one worker.
        Exception: whatever ``render_one`` or ``jobs`` raises, when the caller reaches the result of that job. Jobs
            that have not begun are dropped then, and also when the caller stops or is interrupted.
    """
    count = usable_cores() if workers is None else workers
    if count < 1:
        raise InputError(f"images are rendered by at least 1 worker, not {count}")
    return map(render_one, jobs) if count == 1 else _render_ahead(render_one, jobs, count)


def usable_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _render_ahead(render_one: Callable[[Job], Result], jobs: Iterable[Job], workers: int) -> Iterator[Result]:
    executor = ThreadPoolExecutor(workers, thread_name_prefix="render")
    waiting: deque[Future[Result]] = deque()
    try:
        for job in jobs:
            waiting.append(executor.submit(render_one, job))
            if len(waiting) >= workers + _AHEAD:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        executor.shutdown(wait=True, cancel_futures=True)
