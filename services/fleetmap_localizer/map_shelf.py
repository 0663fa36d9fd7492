"""What has come from a map source so far: catalogue entries, manifests and parts; and what did not come."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable
from collections.abc import Set as AbstractSet
from threading import RLock

from fleetmap.catalogue import MapEntry
from fleetmap.errors import MapPackageError
from fleetmap.manifest import MAX_MANIFEST_BYTES, Manifest, parse_manifest
from fleetmap_localizer.map_source import Circle
from fleetmap_localizer.part_cache import PartCache

_log = logging.getLogger(__name__)

_TRY_AGAIN_S = 60.0
_MAX_MANIFESTS = 4096


class Shelf:
    """Shared by the thread that fetches and the one that prepares views. Parts lie in memory while they are
    wanted, and on the disk as long as there is room.

    Args:
        disk: None for a source that is on the disk itself.
    """

    def __init__(self, disk: PartCache | None) -> None:
        self._disk = disk
        self._lock = RLock()
        self._entries: dict[str, MapEntry] = {}
        self._asked: list[Circle | None] = []  # of the catalogue
        self._manifests: dict[str, Manifest] = {}
        self._parts: dict[str, bytes] = {}
        self._missing: dict[str, float] = {}  # hash -> time at which to ask for it again
        self.news_count = 0

    def entries(self) -> list[MapEntry]:
        """The latest versions known of, newest survey first."""
        with self._lock:
            return sorted(self._entries.values(), key=lambda entry: (-entry.end_ns, entry.map_id))

    def knows(self, circle: Circle | None) -> bool:
        """Whether the catalogue was asked about a circle, or about everything."""
        with self._lock:
            return any(asked is None or (circle is not None and asked.encloses(circle)) for asked in self._asked)

    def put_catalogue(self, circle: Circle | None, entries: Iterable[MapEntry]) -> None:
        """What a catalogue answered about a circle or everything: what it does not name is there no more."""
        with self._lock:
            fresh = {entry.map_id: entry for entry in entries}
            elsewhere = {
                map_id: entry
                for map_id, entry in self._entries.items()
                if circle is not None and not circle.holds(entry)
            }
            self._entries = elsewhere | fresh
            self._asked = [circle] if circle is None else [*self._asked[-3:], circle]

    def put_news(self, entry: MapEntry) -> bool:
        """A version that became the latest, or was retired; False if it is old, or far from all that was asked."""
        with self._lock:
            known = self._entries.get(entry.map_id)
            is_here = known is not None or any(asked is None or asked.holds(entry) for asked in self._asked)
            if known == entry or not is_here:
                return False
            self.news_count += 1
            if entry.retired:
                self._entries.pop(entry.map_id, None)
            else:
                self._entries[entry.map_id] = entry
            return True

    def doubt_catalogue(self) -> None:
        """It is to be asked anew; what it told counts until then."""
        with self._lock:
            self._asked.clear()

    def manifest(self, map_id: str, version: str) -> Manifest | None:
        """A manifest that has come, now or on an earlier day."""
        found = self._manifests.get(version)
        if found is None and self._disk is not None:
            data = self._disk.get(version, MAX_MANIFEST_BYTES)
            found = None if data is None else self._parsed(map_id, version, data)
        return found

    def put_manifest(self, map_id: str, version: str, data: bytes) -> None:
        """A manifest that was fetched."""
        if self._parsed(map_id, version, data) is not None and self._disk is not None:
            self._disk.keep(version, data)

    def part(self, sha256: str, size_bytes: int) -> bytes | None:
        """A part that has come, now or on an earlier day."""
        found = self._parts.get(sha256)
        if found is None and self._disk is not None:
            found = self._disk.get(sha256, size_bytes)
            if found is not None:
                with self._lock:
                    self._parts[sha256] = found
        return found

    def put_part(self, sha256: str, data: bytes) -> None:
        """A part that was fetched."""
        with self._lock:
            self._parts[sha256] = data
        if self._disk is not None:
            self._disk.keep(sha256, data)

    def keep_only(self, wanted: AbstractSet[str]) -> None:
        """Let go of the parts in memory that are not wanted."""
        with self._lock:
            self._parts = {sha256: data for sha256, data in self._parts.items() if sha256 in wanted}

    def give_up(self, sha256: str, what: str, why: object) -> None:
        """Do without a manifest or part for a while; a warning the first time."""
        with self._lock:
            if sha256 not in self._missing:
                _log.warning("%s is left out: %s", what, why)
            self._missing[sha256] = time.monotonic() + _TRY_AGAIN_S

    def is_given_up(self, sha256: str) -> bool:
        """Whether to do without it now."""
        return self._missing.get(sha256, 0.0) > time.monotonic()

    def _parsed(self, map_id: str, version: str, data: bytes) -> Manifest | None:
        try:
            manifest = parse_manifest(data, f"map '{map_id}'")
        except MapPackageError as error:
            self.give_up(version, f"map '{map_id}'", error)
            return None
        if len(self._manifests) >= _MAX_MANIFESTS:
            self._manifests.clear()
        self._manifests[version] = manifest
        return manifest
