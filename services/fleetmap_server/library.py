"""The maps of one store: what Zenoh and HTTP both serve, and how new ones come in."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import lru_cache
from itertools import accumulate
from pathlib import Path

from fleetmap.catalogue import MapEntry, MapPage, search_box_lonlat
from fleetmap.errors import MapPackageError, RunError, StorageError
from fleetmap.manifest import MAX_MANIFEST_BYTES, Manifest, manifest_version, parse_manifest
from fleetmap.transport.protocol import CHUNK_BYTES, BlobTicket, MissingBlob, UploadStatus
from fleetmap_server.catalogue import Catalogue, LonLatBox
from fleetmap_server.problems import IncompleteUploadError, NotFoundError
from fleetmap_server.store import BlobStore, storage_error

_MAPS_PER_PAGE, _PAGE_BYTES = 50, 512 * 1024
_MISSING_PER_ANSWER = 2000
_RESERVE_BYTES = 32 * 1024 * 1024  # left on the disk for the catalogue


@contextmanager
def open_library(folder: Path) -> Iterator[MapLibrary]:
    """The maps in ``folder``, for this process alone until the block ends.

    Raises:
        RunError: another server uses the folder.
        InputError: a newer fleetmap wrote it, or it is no store.
        StorageError: it cannot be made or written.
    """
    with ExitStack() as stack:
        blobs = BlobStore(folder)
        stack.enter_context(_only_server(folder))
        catalogue = Catalogue(folder / "catalogue.sqlite")
        stack.callback(catalogue.close)
        yield MapLibrary(folder, blobs, catalogue)


class MapLibrary:
    """Blobs and catalogue together; a map is in the catalogue only when all its blobs are in the store."""

    def __init__(self, folder: Path, blobs: BlobStore, catalogue: Catalogue) -> None:
        self.folder = folder
        self._blobs = blobs
        self._catalogue = catalogue
        self._manifest = lru_cache(maxsize=16)(self._read_manifest)  # asked for with every chunk of an upload

    def maps(self, box: LonLatBox | None, limit: int, offset: int) -> list[MapEntry]:
        """Latest versions whose bounding boxes meet ``box``, newest first."""
        return self._catalogue.entries(box, limit, offset)

    def count(self, box: LonLatBox | None = None) -> int:
        """How many maps there are, whose bounding boxes meet ``box``."""
        return self._catalogue.count(box)

    def page(self, offset: int) -> MapPage:
        """A page of all maps, newest first."""
        found = self._catalogue.entries(None, _MAPS_PER_PAGE + 1, offset)
        return _page(found, offset)

    def page_near(self, lat_deg: float, lon_deg: float, radius_m: float, offset: int) -> MapPage:
        """A page of the maps whose trajectory passes within ``radius_m``, nearest first."""
        around = self._catalogue.entries(search_box_lonlat(lat_deg, lon_deg, radius_m))
        distances_m = {entry.map_id: entry.distance_m(lat_deg, lon_deg) for entry in around}
        within = [entry for entry in around if distances_m[entry.map_id] <= radius_m]
        within.sort(key=lambda entry: distances_m[entry.map_id])
        return _page(within[offset : offset + _MAPS_PER_PAGE + 1], offset)

    def entry(self, map_id: str, version: str | None = None) -> MapEntry:
        """One map; without ``version`` its latest. Raises NotFoundError."""
        entry = self._catalogue.entry(map_id, version)
        if entry is None:
            which = f"map '{map_id}'" if version is None else f"version {version[:12]} of map '{map_id}'"
            raise NotFoundError(f"the server has no {which}; 'fleetmap maps list' names those it has")
        return entry

    def manifest_ticket(self, map_id: str, version: str | None) -> BlobTicket:
        """Where to find a manifest. Raises NotFoundError."""
        version = self.entry(map_id, version).version
        size_bytes = self._catalogue.blob_size(version, version) or 0
        return BlobTicket(version=version, sha256=version, size_bytes=size_bytes)

    def manifest_path(self, map_id: str) -> tuple[Path, str]:
        """The file of a map's latest manifest, and its SHA-256. Raises NotFoundError, DamagedBlobError."""
        version = self.entry(map_id).version
        return self._blobs.path(version), version

    def part_path(self, map_id: str, sha256: str) -> Path:
        """The file of a part of any version of a map. Raises NotFoundError, DamagedBlobError."""
        if not self._catalogue.has_part(map_id, sha256):
            raise NotFoundError(f"map '{map_id}' has no part {sha256}")
        return self._blobs.path(sha256)

    def chunk(self, version: str, sha256: str, offset: int) -> bytes:
        """Bytes of a published manifest or part from ``offset`` on. Raises NotFoundError, DamagedBlobError."""
        size_bytes = self._catalogue.blob_size(version, sha256)
        if size_bytes is None or offset >= size_bytes:
            raise NotFoundError(f"version {version[:12]} has no data {sha256[:12]} at {offset}")
        return self._blobs.read(sha256, offset, CHUNK_BYTES)

    def begin(self, version: str, manifest_bytes: int) -> UploadStatus:
        """What is missing of a map about to be published.

        Raises:
            MapPackageError: its manifest is too large.
            StorageError: there is no room for it.
        """
        _check_manifest_size(manifest_bytes)
        missing = self._missing({version: manifest_bytes}) or self._missing(self._part_sizes(version))
        missing_bytes = sum(blob.size_bytes - blob.received_bytes for blob in missing)
        if missing_bytes > (room := self._blobs.free_bytes() - _RESERVE_BYTES):
            raise StorageError(
                f"the disk under the server's store has room for {max(room, 0) / 1e6:.0f} MB, "
                f"the map needs {missing_bytes / 1e6:.0f} MB more"
            )
        return UploadStatus(missing=tuple(missing[:_MISSING_PER_ANSWER]), missing_bytes=missing_bytes)

    def receive(self, version: str, sha256: str, size_bytes: int, offset: int, data: bytes) -> int:
        """Take bytes of a manifest or part; returns how many of them are here.

        Raises:
            NotFoundError: the manifest is not here yet.
            MapPackageError: the manifest names no such part, or the bytes are not what they should be.
            StorageError: the disk is full or refuses.
        """
        if sha256 == version:
            _check_manifest_size(size_bytes)
            return self._blobs.append(sha256, size_bytes, offset, data, accept=_check_manifest)
        if self._part_sizes(version).get(sha256) != size_bytes:
            raise MapPackageError(f"the manifest names no part {sha256[:12]} of {size_bytes} bytes")
        return self._blobs.append(sha256, size_bytes, offset, data)

    def commit(self, version: str) -> MapEntry:
        """Make a map visible, all of whose blobs are here; once more for the same version changes nothing.

        Raises:
            NotFoundError: not even the manifest is here.
            IncompleteUploadError: parts are missing.
        """
        manifest, manifest_bytes = self._manifest(version)
        missing = self._missing({version: manifest_bytes, **self._part_sizes(version)})
        if missing:
            raise IncompleteUploadError(
                f"map '{manifest.map_id}' cannot be committed: {len(missing)} parts are missing; publish again"
            )
        return self._catalogue.add(manifest, version, manifest_bytes)

    def _missing(self, sizes_bytes: dict[str, int]) -> list[MissingBlob]:
        """Those of some blobs that are not whole yet."""
        received = {sha256: self._blobs.received_bytes(sha256, size) for sha256, size in sizes_bytes.items()}
        return [
            MissingBlob(sha256=sha256, size_bytes=size, received_bytes=received[sha256])
            for sha256, size in sizes_bytes.items()
            if received[sha256] < size
        ]

    def _part_sizes(self, version: str) -> dict[str, int]:
        return {part.sha256: part.size_bytes for part in self._manifest(version)[0].parts}

    def _read_manifest(self, version: str) -> tuple[Manifest, int]:
        """A manifest in the store, published or not, and its length in bytes."""
        data = self._blobs.path(version).read_bytes()
        return parse_manifest(data, f"version {version[:12]}"), len(data)


@contextmanager
def _only_server(folder: Path) -> Iterator[None]:
    """Keep every other server out of the store; the lock ends with the process, however it ends."""
    path = folder / ".lock"
    try:
        file = path.open("w")
    except OSError as error:
        raise storage_error(path, error) from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise RunError(
                f"another map server uses the store {folder}; stop it or give another --store"
            ) from error
        yield


def _page(found: list[MapEntry], offset: int) -> MapPage:
    """As many entries as one message may hold; where some are left over there is a next page."""
    ends = accumulate(len(entry.model_dump_json()) for entry in found)
    fitting = max(sum(end <= _PAGE_BYTES for end in ends), 1)
    page = tuple(found[: min(fitting, _MAPS_PER_PAGE)])
    return MapPage(maps=page, next_offset=offset + len(page) if len(found) > len(page) else None)


def _check_manifest(data: bytes) -> None:
    """Refuse what is no manifest, or would make an entry that no page of the catalogue can hold."""
    manifest = parse_manifest(data, "the map sent")
    entry = MapEntry.from_manifest(manifest, manifest_version(data), len(data), published_ns=0)
    if len(entry.model_dump_json()) > _PAGE_BYTES:
        raise MapPackageError(
            f"the trajectory and warnings of map '{manifest.map_id}' are too long for a catalogue; thin them out"
        )


def _check_manifest_size(size_bytes: int) -> None:
    if size_bytes > MAX_MANIFEST_BYTES:
        raise MapPackageError(f"a manifest of {size_bytes} bytes is too large; {MAX_MANIFEST_BYTES} is the limit")
