"""What a client hears of new versions: those of before, each new one once, also over a restart."""

from __future__ import annotations

import json
import threading
from contextlib import ExitStack
from typing import Any

import pytest

from fleetmap.catalogue import MapEntry
from fleetmap.errors import TransferError
from fleetmap.transport import MapClient, protocol
from fleetmap.transport.protocol import Announcement, AnnouncementPage, Hello, Problem
from fleetmap.transport.service import Request, RequestService
from fleetmap_server.server import running_server
from fleetmap_server.settings import ServerSettings


def publish(client: MapClient, one: Any) -> None:
    client.publish(one.manifest_bytes, one.parts.__getitem__)


def test_a_late_joiner_hears_the_last_version_of_each_map_and_then_every_new_one(server, make_map):
    maps = [make_map(part_sizes=(100,), seed=seed) for seed in range(3)]
    other = make_map(map_id="other", part_sizes=(100,), seed=9)
    with MapClient(server.zenoh_endpoint) as client, MapClient(server.zenoh_endpoint) as publisher:
        for one in (maps[0], other, maps[1]):
            publish(publisher, one)
        heard = client.announcements()
        assert [entry.version for entry in (heard.next(10.0), heard.next(10.0)) if entry] == [
            other.version,
            maps[1].version,
        ]
        publish(publisher, maps[2])
        assert next(iter(heard)).version == maps[2].version
        publisher.rollback("karlsruhe", maps[0].version[:8], maps[2].version)
        entry = heard.next(10.0)
        assert entry is not None
        assert (entry.version, entry.number, entry.origin) == (maps[0].version, 4, "rollback")
        publisher.rollback("karlsruhe", "1")  # is the latest already
        assert heard.next(0.2) is None


def test_who_wants_news_only_does_not_hear_of_what_was_there_before(server, make_map):
    maps = [make_map(part_sizes=(100,), seed=seed) for seed in range(3)]
    with MapClient(server.zenoh_endpoint) as client, MapClient(server.zenoh_endpoint) as publisher:
        publish(publisher, make_map(map_id="other", part_sizes=(100,), seed=9))
        publish(publisher, maps[0])
        heard = client.announcements(news_only=True)
        assert heard.next(0.0) is None
        for one in maps[1:]:
            publish(publisher, one)
            assert (entry := heard.next(10.0)) is not None
            assert entry.version == one.version
        assert heard.next(0.0) is None


def test_announcements_go_on_after_a_restart_of_the_server(tmp_path, endpoint, make_map):
    settings = ServerSettings(tmp_path, endpoint, http_port=0)
    with ExitStack() as clients:
        with running_server(settings):
            client = clients.enter_context(MapClient(endpoint))
            publish(client, make_map(part_sizes=(100,)))
            heard = client.announcements()
            assert (entry := heard.next(10.0)) is not None
            assert entry.number == 1
        with running_server(settings):
            with MapClient(endpoint) as publisher:
                publish(publisher, make_map(part_sizes=(100,), seed=1))
            assert (entry := heard.next(30.0)) is not None
            assert entry.number == 2
            assert heard.next(0.2) is None


def test_another_store_in_the_servers_place_is_heard_from_its_beginning(tmp_path, endpoint, make_map):
    with ExitStack() as clients:
        with running_server(ServerSettings(tmp_path / "one", endpoint, http_port=0)):
            client = clients.enter_context(MapClient(endpoint))
            for seed in range(3):
                publish(client, make_map(part_sizes=(100,), seed=seed))
            heard = client.announcements()
            assert (entry := heard.next(10.0)) is not None
            assert entry.number == 3
        with running_server(ServerSettings(tmp_path / "other", endpoint, http_port=0)):
            with MapClient(endpoint) as publisher:
                publish(publisher, make_map(part_sizes=(100,), seed=9))
            assert (entry := heard.next(30.0)) is not None
            assert entry.number == 1


def test_closing_the_client_ends_the_wait_for_news_and_connects_no_more(server):
    client = MapClient(server.zenoh_endpoint, vehicle_id="truck-7")
    heard, ends = client.announcements(), []

    def listen() -> None:
        with pytest.raises(TransferError, match="was closed"):
            heard.next(60.0)
        ends.append("told")

    listener = threading.Thread(target=listen)
    listener.start()
    assert server.zenoh._service.vehicles.wait_for(frozenset({"truck-7"}), 10.0)
    client.close()
    listener.join(10.0)
    assert ends == ["told"]
    assert server.zenoh._service.vehicles.wait_for(frozenset(), 10.0)


class Catalogue:
    """A server whose catalogue is a list of entries, to be changed as a test likes."""

    def __init__(self, endpoint: str, entry: MapEntry) -> None:
        self._entry = entry
        self.history: list[MapEntry] = []
        self.asked: list[int] = []
        handlers = {"hello": self._hello, "announcements": self._tell}
        self.service = RequestService(
            endpoint, handlers, lambda error: Problem(title="Test", status=500, detail=str(error))
        )

    def add(self, number: int, version: str, announce: bool = True) -> None:
        self.history.append(self._entry.model_copy(update={"number": number, "version": version * 64}))
        if announce:
            serial = len(self.history)
            self.service.announce(
                Announcement(map_id=self._entry.map_id, version=version * 64, number=number, serial=serial)
            )

    def _hello(self, request: Request) -> bytes:
        hello = Hello(service="test", protocol=1, fleetmap_version="0", server_id=request.server_id)
        return hello.model_dump_json().encode()

    def _tell(self, request: Request) -> bytes:
        after = int(request.parameters["after"])
        self.asked.append(after)
        page = AnnouncementPage(
            maps=tuple(self.history[after : after + 1]),  # one at a time
            after=min(after + 1, len(self.history)) if after < len(self.history) else after,
            more=after + 1 < len(self.history),
        )
        return page.model_dump_json().encode()


@pytest.fixture
def catalogue(endpoint, make_map):
    one = make_map()
    made = Catalogue(endpoint, MapEntry.from_manifest(one.manifest, one.version, 100, 1))
    with made.service:
        yield made


def told(heard: Any, count: int) -> list[tuple[int, str]]:
    entries = [heard.next(10.0) for _ in range(count)]
    assert heard.next(0.1) is None
    return [(entry.number, entry.version[0]) for entry in entries]


def test_what_is_announced_without_being_in_the_catalogue_is_not_believed(catalogue, endpoint):
    catalogue.add(1, "a")
    with MapClient(endpoint) as client:
        heard = client.announcements()
        assert told(heard, 1) == [(1, "a")]
        key = f"{protocol.ANNOUNCED_PREFIX}/karlsruhe"
        forged = {"map_id": "karlsruhe", "version": "f" * 64, "number": 99, "serial": 99}
        for sample in (b"\xff", b"{}", json.dumps(forged).encode()):
            catalogue.service._session.put(key, sample)
        assert told(heard, 0) == []
        catalogue.add(2, "b")
        assert told(heard, 1) == [(2, "b")]


def test_a_catalogue_put_back_in_time_is_followed(catalogue, endpoint):
    for number, version in enumerate("abc", start=1):
        catalogue.add(number, version)
    with MapClient(endpoint) as client:
        heard = client.announcements()
        assert told(heard, 3) == [(1, "a"), (2, "b"), (3, "c")]
        del catalogue.history[1:]  # a backup was restored
        catalogue.add(2, "d")  # less than what the client knows: it may not go back
        assert told(heard, 0) == []
        catalogue.add(3, "e")
        assert told(heard, 1) == [(3, "e")]


def test_a_hint_that_comes_twice_is_asked_about_once(catalogue, endpoint):
    catalogue.add(1, "a")
    with MapClient(endpoint) as client:
        heard = client.announcements()
        assert told(heard, 1) == [(1, "a")]
        catalogue.add(2, "b")
        assert told(heard, 1) == [(2, "b")]
        asked = len(catalogue.asked)
        again = Announcement(map_id="karlsruhe", version="b" * 64, number=2, serial=2)
        for _ in range(5):
            catalogue.service.announce(again)
        assert told(heard, 0) == []
        assert len(catalogue.asked) == asked + 1  # when the time was over
