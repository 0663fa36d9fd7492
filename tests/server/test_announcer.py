"""The announcer follows its catalogue, whoever writes it, and outlives a database that is away."""

from __future__ import annotations

import logging
import queue

import pytest

from fleetmap.errors import StorageError
from fleetmap_server.announcer import Announcer, announcements_after
from fleetmap_server.catalogue import Catalogue
from fleetmap_server.database import Database


@pytest.fixture
def catalogue(database_url):
    database = Database(database_url)
    yield Catalogue(database)
    database.close()


def add(catalogue, one, predecessor=None) -> None:
    with catalogue.database.writing() as connection:
        catalogue.add(connection, one.manifest, one.version, len(one.manifest_bytes), predecessor)


def test_what_another_writes_is_announced_in_order_from_now_on(catalogue, database_url, make_map):
    add(catalogue, make_map(map_id="before"))
    heard: queue.SimpleQueue = queue.SimpleQueue()
    other = Database(database_url)
    with Announcer(catalogue, heard.put, poll_s=0.01):
        first, second = make_map(), make_map(seed=1)
        add(Catalogue(other), first)
        told = heard.get(timeout=10.0)
        assert (told.map_id, told.version, told.number) == ("karlsruhe", first.version, 1)
        add(Catalogue(other), second, first.version)
        later = heard.get(timeout=10.0)
        assert (later.version, later.number) == (second.version, 2)
        assert later.serial > told.serial
        assert [entry.version for entry in announcements_after(catalogue, later.serial - 1).maps] == [
            second.version
        ]
    other.close()
    assert heard.empty()


def test_one_who_looks_is_not_kept_waiting(catalogue, make_map):
    heard: queue.SimpleQueue = queue.SimpleQueue()
    with Announcer(catalogue, heard.put, poll_s=3600.0) as announcer:
        add(catalogue, make_map())
        announcer.look()
        assert heard.get(timeout=10.0).number == 1


def test_a_database_that_is_away_is_told_once_and_nothing_is_missed(catalogue, make_map, monkeypatch, caplog):
    heard: queue.SimpleQueue = queue.SimpleQueue()
    failures: queue.SimpleQueue = queue.SimpleQueue()
    since = catalogue.since

    def fail(serial: int, limit: int) -> None:
        failures.put(serial)
        raise StorageError("the database is away")

    with caplog.at_level(logging.WARNING), Announcer(catalogue, heard.put, poll_s=0.01):
        monkeypatch.setattr(catalogue, "since", fail)
        add(catalogue, make_map())
        for _ in range(5):
            failures.get(timeout=10.0)
        assert [record.message for record in caplog.records] == [
            "new versions are announced later: the database is away"
        ]
        monkeypatch.setattr(catalogue, "since", since)
        assert heard.get(timeout=10.0).number == 1


def test_the_answer_to_a_late_joiner_comes_in_pages_that_leave_nothing_out(catalogue, make_map, monkeypatch):
    monkeypatch.setattr("fleetmap_server.announcer._PAGE_ENTRIES", 3)
    for number in range(7):
        add(catalogue, make_map(map_id=f"map-{number}"))
    add(catalogue, make_map(map_id="map-2", seed=1), make_map(map_id="map-2").version)
    with catalogue.database.writing() as connection:
        catalogue.retire(connection, "map-5")
    heard, after, more = [], 0, True
    while more:
        page = announcements_after(catalogue, after)
        heard += [(entry.map_id, entry.number) for entry in page.maps]
        assert page.after > after
        after, more = page.after, page.more
    assert heard == [*((f"map-{number}", 1) for number in (0, 1, 3, 4, 6)), ("map-2", 2)]
    assert announcements_after(catalogue, after).maps == ()
    monkeypatch.setattr("fleetmap_server.announcer._PAGE_BYTES", 1)
    assert [len(announcements_after(catalogue, serial).maps) for serial in (0, 1)] == [1, 1]
