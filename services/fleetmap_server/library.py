"""The maps, drives and jobs of one store: what Zenoh and HTTP both serve, and how new ones come in.

A map is in the catalogue only when all its blobs are live: one transaction looks at the blobs, adds the version,
ends the upload with its claims and, where a worker publishes, its job. So whatever is killed whenever, either all
of that holds or nothing.
"""

from __future__ import annotations

import fcntl
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import lru_cache

from fleetmap.catalogue import MapEntry
from fleetmap.errors import MapPackageError, RunError, StorageError
from fleetmap.manifest import MAX_MANIFEST_BYTES, Manifest, manifest_version, parse_manifest
from fleetmap.transport import protocol
from fleetmap.transport.protocol import BlobTicket, MapPage, UploadStatus
from fleetmap_server import uploads
from fleetmap_server.blobs import Blobs
from fleetmap_server.catalogue import Catalogue, CataloguePart
from fleetmap_server.database import Database
from fleetmap_server.drives import Drives
from fleetmap_server.jobs import Jobs
from fleetmap_server.problems import BadRequestError, IncompleteUploadError, NotFoundError
from fleetmap_server.reception import Reception
from fleetmap_server.search import MapSearch, Near, SearchPage, fitting
from fleetmap_server.settings import ServerSettings
from fleetmap_server.storage import Clock, Storage, open_storage
from fleetmap_server.uploading import Upload, Uploading

_MAPS_PER_PAGE, _PAGE_BYTES = 50, 512 * 1024
_MISSING_PER_ANSWER = 2000
_SIZE_KNOWN_S = 2.0  # how long a blob that was retired may still be asked for


@contextmanager
def open_library(settings: ServerSettings, clock: Clock = time.time_ns) -> Iterator[MapLibrary]:
    """What the settings' store and catalogue hold; on an SQLite catalogue for this process alone.

    Raises:
        RunError: another server uses the catalogue.
        InputError: a newer fleetmap wrote it, or it is none.
        StorageError: the store or the catalogue cannot be reached or written.
    """
    with ExitStack() as stack:
        storage = stack.enter_context(open_storage(settings, clock))
        if storage.database.file is not None:
            stack.enter_context(_only_server(storage.database))
        library = MapLibrary(storage, settings, clock)
        library.jobs.forgive_silence()
        yield library


class MapLibrary:
    """Everything that a map server has; safe to use from several threads."""

    def __init__(self, storage: Storage, settings: ServerSettings, clock: Clock = time.time_ns) -> None:
        self.blobs: Blobs = storage.blobs
        self.catalogue = Catalogue(storage.database, clock)
        self.drives = Drives(storage.database, clock)
        self.jobs = Jobs(storage.database, clock, lease_s=settings.lease_s)
        self.reception = Reception(storage, self.drives, self.jobs, clock)
        self.storage = storage
        self.settings = settings
        self._uploading = Uploading(storage, clock)
        self.clock = clock
        self._manifest = lru_cache(maxsize=16)(self._read_manifest)  # asked for with every chunk of an upload
        self._size_lately = lru_cache(maxsize=4096)(self._size)

    # What is there.

    def count(self) -> int:
        """How many maps there are."""
        return self.catalogue.count()

    def search(self, search: MapSearch) -> SearchPage:
        """Latest versions; raises BadRequestError for a cursor that is not of this search."""
        return self.catalogue.search(search)

    def page(self, request: protocol.MapsRequest) -> MapPage:
        """As many of the maps that a client asks for as one message may hold."""
        if request.map_id is not None and request.versions == "all":
            return _history_page(self.versions(request.map_id), request.after)
        found = self.catalogue.search(_search_of(request))
        return MapPage(maps=found.entries, next_after=found.after)

    def entry(self, map_id: str, version: str | int | None = None) -> MapEntry:
        """One map; without ``version`` its latest. Raises NotFoundError, GoneError."""
        entry = self.catalogue.entry(map_id, version)
        if entry is None:
            which = f"map '{map_id}'" if version is None else f"version {str(version)[:12]} of map '{map_id}'"
            raise NotFoundError(f"the server has no {which}; 'fleetmap maps list' names those it has")
        return entry

    def versions(self, map_id: str) -> list[MapEntry]:
        """A map's versions that are not retired, oldest first. Raises NotFoundError, GoneError."""
        self.entry(map_id)
        return self.catalogue.versions(map_id)

    def parts(self, map_id: str, version: str | int | None = None) -> list[CataloguePart]:
        """What a map's manifest names. Raises NotFoundError, GoneError."""
        return self.catalogue.parts(self.entry(map_id, version).version)

    def manifest(self, version: str) -> Manifest:
        """The manifest of a version. Raises NotFoundError, DamagedBlobError."""
        return self._manifest(version)[0]

    def manifest_ticket(self, map_id: str, version: str | int | None) -> BlobTicket:
        """Where to find a manifest. Raises NotFoundError, GoneError."""
        version = self.entry(map_id, version).version
        size_bytes = self.catalogue.blob_size(version, version) or 0
        return BlobTicket(version=version, sha256=version, size_bytes=size_bytes)

    def chunk(self, version: str | None, sha256: str, offset: int, length: int) -> bytes:
        """Bytes from ``offset`` on of a published manifest or part, without ``version`` of a drive's recording.

        Raises NotFoundError, DamagedBlobError.
        """
        size_bytes = self._size_lately(version, sha256, int(time.monotonic() / _SIZE_KNOWN_S))
        if size_bytes is None or offset >= size_bytes:
            of = "no drive" if version is None else f"version {version[:12]}"
            raise NotFoundError(f"{of} has no data {sha256[:12]} at {offset}")
        return self.blobs.read(sha256, offset, length)

    def check_part(self, map_id: str, sha256: str) -> None:
        """Raise NotFoundError if no version of a map that is not retired has this part."""
        if not self.catalogue.has_part(map_id, sha256):
            raise NotFoundError(f"map '{map_id}' has no part {sha256}")

    def serves(self, sha256: str) -> bool:
        """Whether a blob belongs to a map or drive that is not retired."""
        return self.catalogue.has_blob(sha256) or self.drives.find(sha256) is not None

    # How maps come in, and go.

    def begin(self, request: protocol.BeginRequest) -> UploadStatus:
        """What is missing of a map about to be published, and which version is the latest before it.

        Raises:
            MapPackageError: its manifest is too large.
            StorageError: there is no room for it.
        """
        version, map_id = request.version, request.map_id
        _check_manifest_size(request.size_bytes)
        upload = Upload(version, "map", map_id or version[:12], request.size_bytes)
        missing = self._uploading.missing(upload, {version: request.size_bytes})
        if not missing:
            manifest = self.manifest(version)
            map_id = manifest.map_id
            missing = self._uploading.missing(upload, _part_sizes(manifest))
        latest = self._latest(map_id) if map_id is not None else None
        missing_bytes = sum(blob.size_bytes - blob.received_bytes for blob in missing)
        whole_bytes = max((blob.size_bytes for blob in missing), default=0)  # lies beside its pieces for a moment
        self._uploading.check_room(missing_bytes + whole_bytes)
        return UploadStatus(
            missing=tuple(missing[:_MISSING_PER_ANSWER]),
            missing_bytes=missing_bytes,
            latest=latest.version if latest else None,
        )

    def receive(self, version: str, sha256: str, size_bytes: int, offset: int, data: bytes) -> int:
        """Take bytes of a manifest or part; returns how many of them are here.

        Raises:
            NotFoundError: the manifest is not here yet.
            MapPackageError: the manifest names no such part, or the bytes are not what they should be.
            StorageError: the disk is full or refuses.
        """
        if sha256 == version:
            _check_manifest_size(size_bytes)
            return self.blobs.append(sha256, size_bytes, offset, data, accept=_check_manifest)
        if _part_sizes(self._manifest(version)[0]).get(sha256) != size_bytes:
            raise MapPackageError(f"the manifest names no part {sha256[:12]} of {size_bytes} bytes")
        self._uploading.keep(version)
        return self.blobs.append(sha256, size_bytes, offset, data)

    def commit(self, request: protocol.CommitRequest) -> MapEntry:
        """Make a map visible, all of whose blobs are here; once more for the same version changes nothing.

        Raises:
            NotFoundError: not even the manifest is here.
            IncompleteUploadError: parts are missing.
            ConflictError: another version became the latest since this upload began.
            JobLostError: the job that made it belongs to another worker by now.
            BadRequestError: the job asks for another map.
        """
        version = request.version
        manifest, manifest_bytes = self._manifest(version)
        with self.storage.database.writing() as connection:
            missing = self.blobs.missing(connection, {version: manifest_bytes, **_part_sizes(manifest)})
            if missing:
                raise IncompleteUploadError(
                    f"map '{manifest.map_id}' cannot be committed: {len(missing)} parts are missing; publish again"
                )
            entry = self.catalogue.add(connection, manifest, version, manifest_bytes, request.predecessor)
            if request.job_id is not None and request.fence is not None:
                job = self.jobs.fulfil(connection, request.job_id, request.fence, version)
                if job.map_id != manifest.map_id:
                    raise BadRequestError(f"job {job.job_id} asks for map '{job.map_id}', not '{manifest.map_id}'")
            uploads.end(connection, version)
        return entry

    def rollback(self, map_id: str, version: str | int, latest: str | None = None) -> MapEntry:
        """Make an older content the latest again, see Catalogue.rollback."""
        with self.storage.database.writing() as connection:
            return self.catalogue.rollback(connection, map_id, version, latest)

    def retire(self, map_id: str, version: str | int | None = None) -> int:
        """Take a version, or the whole map, out of service; see Catalogue.retire."""
        with self.storage.database.writing() as connection:
            return self.catalogue.retire(connection, map_id, version)

    # Behind it.

    def _latest(self, map_id: str) -> MapEntry | None:
        with self.storage.database.reading() as connection:
            return self.catalogue.latest(connection, map_id)

    def _size(self, version: str | None, sha256: str, when: int) -> int | None:
        """Size of what may be fetched; ``when`` makes the memory of it short."""
        if version is not None:
            return self.catalogue.blob_size(version, sha256)
        drive = self.drives.find(sha256)
        return None if drive is None else drive.size_bytes

    def _read_manifest(self, version: str) -> tuple[Manifest, int]:
        """A manifest in the store, published or not, and its length in bytes."""
        data = self.blobs.read(version, 0, MAX_MANIFEST_BYTES)
        return parse_manifest(data, f"version {version[:12]}"), len(data)


@contextmanager
def _only_server(database: Database) -> Iterator[None]:
    """Keep every other server away from an SQLite file; the lock ends with the process, however it ends."""
    assert database.file is not None
    path = database.file.with_name(".lock")
    try:
        file = path.open("w")
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror or error}; check its permissions") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise RunError(
                f"another map server uses the store {database.file.parent}; stop it, give another --store, or "
                "give several servers one --catalogue postgresql://..."
            ) from error
        yield


def _history_page(versions: Sequence[MapEntry], after: str | None) -> MapPage:
    """A map's versions, newest first; a page begins below the number that the one before ended with."""
    if after is not None and not (after.isascii() and after.isdigit()):
        raise BadRequestError(f"'{after}' is no page of a map's versions; begin again with the first page")
    older = [entry for entry in reversed(versions) if after is None or entry.number < int(after)]
    page = fitting(older[:_MAPS_PER_PAGE], _PAGE_BYTES)
    return MapPage(maps=page, next_after=str(page[-1].number) if len(page) < len(older) else None)


def _search_of(request: protocol.MapsRequest) -> MapSearch:
    near = None
    if request.lat_deg is not None and request.lon_deg is not None:
        near = Near(request.lat_deg, request.lon_deg, request.radius_m)
    return MapSearch(
        box=request.area_lonlat,
        near=near,
        start_ns=request.from_ns,
        end_ns=request.until_ns,
        ids=None if request.map_id is None else (request.map_id,),
        limit=_MAPS_PER_PAGE,
        max_bytes=_PAGE_BYTES,
        after=request.after,
    )


def _part_sizes(manifest: Manifest) -> dict[str, int]:
    return {part.sha256: part.size_bytes for part in manifest.parts}


def _check_manifest(pieces: Iterable[bytes]) -> None:
    """Refuse what is no manifest, or would make an entry that no page of the catalogue can hold."""
    data = b"".join(pieces)
    manifest = parse_manifest(data, "the map sent")
    entry = MapEntry.from_manifest(manifest, manifest_version(data), len(data), published_ns=0)
    if len(entry.model_dump_json()) > _PAGE_BYTES:
        raise MapPackageError(
            f"the trajectory and warnings of map '{manifest.map_id}' are too long for a catalogue; thin them out"
        )


def _check_manifest_size(size_bytes: int) -> None:
    if size_bytes > MAX_MANIFEST_BYTES:
        raise MapPackageError(f"a manifest of {size_bytes} bytes is too large; {MAX_MANIFEST_BYTES} is the limit")
