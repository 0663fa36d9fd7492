"""What comes next is made while what came before is being used."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar, cast

T = TypeVar("T")


def read_ahead(items: Iterable[T], depth: int) -> Iterator[T]:
    """The same items in the same order, taken by one other thread, at most ``depth`` of them in advance.

    What raises there is raised here, after the items before it.
    """
    iterator, end = iter(items), object()
    with ThreadPoolExecutor(1, thread_name_prefix="read-ahead") as worker:
        coming = deque(worker.submit(next, iterator, end) for _ in range(depth))
        try:
            while (item := coming.popleft().result()) is not end:
                coming.append(worker.submit(next, iterator, end))
                yield cast(T, item)
        finally:
            for future in coming:
                future.cancel()
