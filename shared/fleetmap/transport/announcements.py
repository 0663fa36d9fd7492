"""New versions of maps as they come, and first of all those that are there already."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from threading import Event

from pydantic import ValidationError

from fleetmap.catalogue import MapEntry
from fleetmap.transport import protocol
from fleetmap.transport.link import ServerLink
from fleetmap.transport.session import Connection

_LOOK_EVERY_S = 0.2  # whether the connection still stands
_END = 2**63 - 1  # nothing comes after it, and every hint names something before
_ASK_EVERY_S = 60.0  # also without a word; what is announced can get lost with a server


class Announcements:
    """Each map's latest version once: those of now, then every new one; iterate over it, or call ``next``.

    ``news_only`` leaves out those of now, and with them what is announced while there is no connection.

    What servers announce is a hint to ask the catalogue, never believed by itself. So it does not matter whether a
    hint comes late, twice, from several servers, or not at all because the server restarts: once there is a
    connection again, the catalogue tells what was missed.
    """

    def __init__(self, link: ServerLink, *, news_only: bool = False) -> None:
        self._link = link
        self._begin_after = _END if news_only else 0
        self._catalogue_id = link.hello.catalogue_id
        self._asked_after = self._begin_after
        self._known: dict[str, tuple[int, str]] = {}  # map_id -> number and version told last
        self._found: deque[MapEntry] = deque()
        self._news = Event()
        link.attach(self._subscribe)

    def __iter__(self) -> Iterator[MapEntry]:
        return self

    def __next__(self) -> MapEntry:
        """Wait for the next one; raises as ``next``, and goes on when asked again."""
        while (entry := self.next(_ASK_EVERY_S)) is None:
            pass
        return entry

    def next(self, timeout_s: float) -> MapEntry | None:
        """The next one; None if there is none in time.

        Raises:
            ServerError: the server is away for longer than the client's patience, or refuses.
        """
        deadline_s = time.monotonic() + timeout_s
        ask_at_s = min(deadline_s, time.monotonic() + _ASK_EVERY_S)
        while not self._found:
            left_s = ask_at_s - time.monotonic()
            if left_s > 0.0 and not self._link.is_broken and not self._news.wait(min(left_s, _LOOK_EVERY_S)):
                continue
            self._ask()
            if not self._found and time.monotonic() >= deadline_s:
                return None
            ask_at_s = min(deadline_s, time.monotonic() + _ASK_EVERY_S)
        return self._found.popleft()

    def _subscribe(self, connection: Connection) -> None:
        """Listen first and ask afterwards, so that nothing can fall in between."""
        connection.watch(f"{protocol.ANNOUNCED_PREFIX}/*", self._notice)
        self._news.set()

    def _notice(self, sample: bytes) -> None:
        try:
            announced = protocol.Announcement.model_validate_json(sample)
        except ValidationError:
            return
        if self._known.get(announced.map_id) != (announced.number, announced.version):
            self._asked_after = min(
                self._asked_after, announced.serial - 1
            )  # less in a catalogue put back in time
            self._news.set()

    def _ask(self) -> None:
        """Ask the catalogue for what became the latest since, and keep what is new."""
        self._news.clear()
        if self._link.hello.catalogue_id != self._catalogue_id:  # another store in the server's place
            self._catalogue_id = self._link.hello.catalogue_id
            self._asked_after, self._known = self._begin_after, {}
        more = True
        while more:
            named = {"after": self._asked_after}
            page = self._link.request(protocol.AnnouncementPage, protocol.ANNOUNCEMENTS, named)
            self._asked_after, more = page.after, page.more
            for entry in page.maps:
                number, version = self._known.get(entry.map_id, (0, ""))
                if entry.number >= number and (entry.number, entry.version) != (number, version):
                    self._known[entry.map_id] = (entry.number, entry.version)
                    self._found.append(entry)
