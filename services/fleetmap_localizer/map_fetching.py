"""Fetching what is wished for, on threads of their own, from a source that may be away for a while."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from threading import Condition, Event, Thread

from fleetmap.errors import (
    AccessDeniedError,
    FleetmapError,
    MapPackageError,
    ServerError,
    ServerRefusedError,
    ServerUnreachableError,
    TransferError,
)
from fleetmap_localizer.map_cache import MapCache
from fleetmap_localizer.map_shelf import Shelf
from fleetmap_localizer.map_source import Circle, MapFolder, MapServer, MapSource

_log = logging.getLogger(__name__)

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 1.0, 60.0
_LISTEN_S, _LISTEN_AGAIN_S = 60.0, 5.0


@dataclass(frozen=True)
class CatalogueWish:
    """Which maps there are within a circle, or at all."""

    around: Circle | None
    max_count: int


@dataclass(frozen=True)
class ManifestWish:
    """The manifest of one version."""

    map_id: str
    version: str


@dataclass(frozen=True)
class PartsWish:
    """Some parts of one version, by their SHA-256."""

    map_id: str
    version: str
    sizes_bytes: Mapping[str, int]


Wish = CatalogueWish | ManifestWish | PartsWish


class Fetcher:
    """Fulfils wishes in their order and puts what comes on a shelf.

    A source that leaves is told of once, asked again at growing intervals, and told of when it is back. One that
    is not there at the start is done without if the cache remembers it.

    Args:
        origin: what to open.
        shelf: where to put what comes.
        cache: what earlier days left; None for a source on the disk.
        on_change: called whenever something has come, or will not come.
    """

    def __init__(
        self, origin: MapServer | MapFolder, shelf: Shelf, cache: MapCache | None, on_change: Callable[[], None]
    ) -> None:
        self._origin, self._shelf, self._cache, self._on_change = origin, shelf, cache, on_change
        self._changed = Condition()
        self._closed = Event()
        self._wishes: tuple[Wish, ...] = ()
        self._source: MapSource | None = None
        self._pause_s = self._away_until_s = 0.0
        self.error: Exception | None = None  # that ended it
        self.why_away: ServerError | None = None  # the last reason
        self._threads = [Thread(target=self._run, name="map-fetching", daemon=True)]
        self._threads[0].start()

    @property
    def is_away(self) -> bool:
        """Whether the source cannot be reached now."""
        return self._pause_s > 0.0

    def wish(self, wishes: Sequence[Wish]) -> None:
        """Fetch this from now on, and nothing else."""
        with self._changed:
            self._wishes = tuple(wishes)
            self._changed.notify_all()

    def close(self) -> None:
        """End all; returns when nothing is under way any more."""
        with self._changed:
            self._closed.set()
            self._changed.notify_all()
            source = self._source
        if source is not None:
            source.close()
        for thread in self._threads:
            thread.join()

    def _run(self) -> None:
        """Open the source, then fulfil one wish after the other."""
        while not self._closed.is_set():
            try:
                source = self._source or self._open()
                wish = self._next_wish()
                if wish is not None:
                    self._fulfil(source, wish)
                    self._is_back()
            except ServerError as error:
                self._is_lost(error)
            except Exception as error:  # a folder that is no map, or a mistake of ours
                self.error = error
            self._on_change()
            if self.error is not None:
                return
            self._closed.wait(max(self._away_until_s - time.monotonic(), 0.0))

    def _open(self) -> MapSource:
        """Open the source; where it is not there, go on with what the cache remembers of it."""
        try:
            source = self._origin.open()
        except FleetmapError as error:
            if not self.is_away and not self._is_remembered(error):
                self.error = error
            raise
        with self._changed:
            self._source = source
            if self._closed.is_set():
                source.close()
        self._shelf.doubt_catalogue()
        self._threads.append(Thread(target=self._listen, args=(source,), name="map-news", daemon=True))
        self._threads[-1].start()
        return source

    def _is_remembered(self, error: FleetmapError) -> bool:
        if self._cache is None or not isinstance(error, ServerUnreachableError):
            return False
        entries = self._cache.catalogue(str(self._origin))
        if entries:
            self._shelf.put_catalogue(None, entries)
        return bool(entries)

    def _next_wish(self) -> Wish | None:
        """The first wish that is not fulfilled; None when there is none any more."""
        with self._changed:
            self._changed.wait_for(lambda: self._wishes or self._closed.is_set())
            return None if self._closed.is_set() else self._wishes[0]

    def _fulfil(self, source: MapSource, wish: Wish) -> None:
        """Get what was wished. What is damaged or gone is given up; a source that is away is an error."""
        if isinstance(wish, CatalogueWish):
            self._fetch_catalogue(source, wish)
        elif isinstance(wish, ManifestWish):
            self._fetch_manifest(source, wish)
        else:
            self._fetch_parts(source, wish)
        with self._changed:
            self._wishes = tuple(each for each in self._wishes if each is not wish)

    def _fetch_catalogue(self, source: MapSource, wish: CatalogueWish) -> None:
        news_before = self._shelf.news_count
        try:
            entries = source.maps(wish.around, wish.max_count)
        except ServerRefusedError as error:  # the one map that is wanted is not, or no longer, there
            _raise_if_locked_out(error)
            if not self._shelf.entries():
                self.error = error
            entries = []
        self._shelf.put_catalogue(wish.around, entries)
        if self._shelf.news_count != news_before:
            self._shelf.doubt_catalogue()  # the answer may be older than the news
        if self._cache is not None and not self.error:
            self._cache.keep_catalogue(str(self._origin), self._shelf.entries())

    def _fetch_manifest(self, source: MapSource, wish: ManifestWish) -> None:
        try:
            data = source.manifest(wish.map_id, wish.version)
        except (ServerRefusedError, MapPackageError) as error:
            _raise_if_locked_out(error)
            self._shelf.give_up(wish.version, f"map '{wish.map_id}'", error)
            self._shelf.doubt_catalogue()
        else:
            self._shelf.put_manifest(wish.map_id, wish.version, data)

    def _fetch_parts(self, source: MapSource, wish: PartsWish) -> None:
        """All in one go; one that cannot be had is left out, and the rest asked for again."""
        failed = set[str]()
        left = {
            sha256: size for sha256, size in wish.sizes_bytes.items() if self._shelf.part(sha256, size) is None
        }
        while left and not self._closed.is_set() and not self._is_overtaken(wish):
            try:
                wanted = dict(left)
                parts = source.parts(wish.map_id, wish.version, wanted)
                for sha256, data in zip(wanted, parts, strict=True):
                    self._shelf.put_part(sha256, data)
                    del left[sha256]
                    if self._is_overtaken(wish):
                        break
            except (ServerRefusedError, TransferError, MapPackageError) as error:
                _raise_if_locked_out(error)
                if not source.is_served(wish.map_id, wish.version):  # raises where the server is away
                    self._forgo(list(left), f"version {wish.version[:12]} of map '{wish.map_id}'", error)
                    self._shelf.doubt_catalogue()
                    return
                culprit = next(iter(left))
                if culprit in failed or not isinstance(error, TransferError):
                    self._forgo([culprit], f"a tile of map '{wish.map_id}'", error)
                    del left[culprit]
                failed.add(culprit)  # what was cut off once may come the next time

    def _forgo(self, hashes: Sequence[str], what: str, why: Exception) -> None:
        for sha256 in hashes:
            self._shelf.give_up(sha256, what, why)

    def _is_overtaken(self, wish: PartsWish) -> bool:
        """Whether something else has become more urgent."""
        with self._changed:
            first = self._wishes[0] if self._wishes else None
        is_among = isinstance(first, PartsWish) and first.sizes_bytes.keys() <= wish.sizes_bytes.keys()
        return first is not wish and not is_among

    def _listen(self, source: MapSource) -> None:
        """Note what is announced."""
        announcements = source.announcements()
        while announcements is not None and not self._closed.is_set():
            try:
                entry = announcements.next(_LISTEN_S)
            except ServerError as error:
                self._is_lost(error)
                self._closed.wait(_LISTEN_AGAIN_S)
                continue
            if entry is None:
                self._shelf.doubt_catalogue()  # nobody announces what is retired
            if entry is None or self._shelf.put_news(entry):
                self._on_change()

    def _is_lost(self, error: ServerError) -> None:
        if self._closed.is_set() or self.error is not None:
            return
        with self._changed:
            self.why_away = error
            if not self.is_away:
                _log.warning("%s; going on with the maps at hand", error)
            self._pause_s = min(max(2.0 * self._pause_s, _FIRST_PAUSE_S), _LONGEST_PAUSE_S)
            self._away_until_s = time.monotonic() + self._pause_s
        self._shelf.doubt_catalogue()

    def _is_back(self) -> None:
        with self._changed:
            if self.is_away:
                _log.warning("%s answers again", self._origin)
            self._pause_s = self._away_until_s = 0.0


def _raise_if_locked_out(error: FleetmapError) -> None:
    if isinstance(error, AccessDeniedError):
        raise error
