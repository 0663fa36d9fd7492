"""Reading ahead changes neither the items nor their order, and reads no further than it may."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from fleetmap.read_ahead import read_ahead


def test_the_items_come_in_their_order():
    assert list(read_ahead(range(100), 4)) == list(range(100))
    assert list(read_ahead([], 4)) == []
    assert list(read_ahead([None, None], 1)) == [None, None]


def test_another_thread_makes_them_at_most_so_many_in_advance():
    made: list[tuple[int, str]] = []

    def source() -> Iterator[int]:
        for i in range(20):
            made.append((i, threading.current_thread().name))
            yield i

    for item in read_ahead(source(), 3):
        assert len(made) <= item + 1 + 3 + 1
    assert len(made) == 20
    assert all(name.startswith("read-ahead") for _, name in made)


def test_what_fails_there_is_raised_here_after_the_items_before_it():
    def source() -> Iterator[int]:
        yield 1
        yield 2
        raise ValueError("damaged")

    items = read_ahead(source(), 5)
    assert [next(items), next(items)] == [1, 2]
    with pytest.raises(ValueError, match="damaged"):
        next(items)


def test_giving_up_early_leaves_no_thread_behind():
    before = threading.active_count()
    items = read_ahead(iter(range(10**9)), 2)
    assert next(items) == 0
    items.close()
    assert threading.active_count() == before
