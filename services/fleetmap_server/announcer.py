"""Tells of new latest versions as soon as the catalogue has them, whichever of its servers took them in."""

from __future__ import annotations

import logging
from collections.abc import Callable
from itertools import accumulate
from threading import Event, Thread
from types import TracebackType
from typing import Self

from fleetmap.errors import FleetmapError
from fleetmap.transport.protocol import Announcement, AnnouncementPage
from fleetmap_server.catalogue import Catalogue

_POLL_S = 2.0  # what this server took in itself is told at once
_PAGE_ENTRIES, _PAGE_BYTES = 200, 512 * 1024

_log = logging.getLogger(__name__)


def announcements_after(catalogue: Catalogue, after: int) -> AnnouncementPage:
    """The latest versions that became so after a serial, as many as one message may hold; 0 asks for all."""
    found = catalogue.since(after, _PAGE_ENTRIES)
    ends = accumulate(len(entry.model_dump_json()) if entry.is_latest else 0 for _, entry in found)
    fitting = found[: max(sum(end <= _PAGE_BYTES for end in ends), 1)]
    return AnnouncementPage(
        maps=tuple(entry for _, entry in fitting if entry.is_latest),
        after=fitting[-1][0] if fitting else after,
        more=len(fitting) < len(found) or len(found) == _PAGE_ENTRIES,
    )


class Announcer:
    """Follows a catalogue from now on, in a thread; close it, or use it in a ``with`` statement.

    Args:
        catalogue: what it follows.
        announce: called for each new latest version, in their order.
        poll_s: how often to look for what other servers have taken in.
    """

    def __init__(
        self, catalogue: Catalogue, announce: Callable[[Announcement], None], poll_s: float = _POLL_S
    ) -> None:
        self._catalogue, self._announce, self._poll_s = catalogue, announce, poll_s
        self._told = catalogue.last_serial()
        self._is_cut_off = False
        self._news, self._closed = Event(), Event()
        self._thread = Thread(target=self._follow, name="announcer", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def look(self) -> None:
        """There is something new: look at once."""
        self._news.set()

    def close(self) -> None:
        """Announce nothing more."""
        self._closed.set()
        self._news.set()
        self._thread.join()

    def _follow(self) -> None:
        while True:
            self._news.wait(self._poll_s)
            self._news.clear()
            if self._closed.is_set():
                return
            self._catch_up_if_possible()

    def _catch_up_if_possible(self) -> None:
        try:
            self._catch_up()
            self._is_cut_off = False
        except FleetmapError as error:  # a database that is away
            if not self._is_cut_off:
                _log.warning("new versions are announced later: %s", error)
            self._is_cut_off = True

    def _catch_up(self) -> None:
        while found := self._catalogue.since(self._told, _PAGE_ENTRIES):
            for serial, entry in found:
                if entry.is_latest:
                    self._announce(
                        Announcement(
                            map_id=entry.map_id, version=entry.version, number=entry.number, serial=serial
                        )
                    )
                self._told = serial
