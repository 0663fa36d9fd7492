"""A map package: a folder with ``manifest.json`` and content-addressed parts, ``parts/<sha256>.bin``.

There is one part per 128 m UTM cell that holds keyframes (see fleetmap.cells: what a localizer needs, of those
keyframes and landmarks that were chosen for it), one full part (see fleetmap.full_part: everything, for mapping
on) and, since format 1.1, a quality part (see fleetmap.quality_part: how good the map is along the road). The
map's version is the SHA-256 of the manifest's bytes.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from fleetmap.cells import decode_cell, merge_cells
from fleetmap.errors import MapPackageError, OutputExistsError, StorageError
from fleetmap.files import atomic_path, refuse_existing
from fleetmap.full_part import decode_full
from fleetmap.manifest import (
    FORMAT_NAME,
    MAX_MANIFEST_BYTES,
    Manifest,
    PartRecord,
    Provenance,
    Quality,
    check_map_id,
    manifest_version,
    parse_manifest,
)
from fleetmap.package_encoding import check_counts, encode_package
from fleetmap.quality_part import decode_quality
from fleetmap.road_quality import RoadQuality
from fleetmap.visual_map import LocalizationMap, VisualMap

MANIFEST_NAME = "manifest.json"
PARTS_NAME = "parts"


@dataclass(frozen=True)
class MapPackage:
    """An opened package: its manifest is checked, its parts are checked whenever they are read."""

    folder: Path
    manifest: Manifest
    manifest_bytes: bytes

    @property
    def version(self) -> str:
        """SHA-256 of the manifest's bytes, in hex."""
        return manifest_version(self.manifest_bytes)

    def part_bytes(self, sha256: str) -> bytes:
        """The bytes of one part of the manifest.

        Raises:
            MapPackageError: the manifest does not list it, the file is missing, or its size or hash is another.
        """
        for record in self.manifest.parts:
            if record.sha256 == sha256:
                return self._read(record)
        raise MapPackageError(f"the manifest of {self.folder} lists no part {sha256[:64]!r}")

    def localization_map(self) -> LocalizationMap:
        """All cells, merged into what a localizer needs.

        Raises:
            MapPackageError: a cell part is missing or damaged.
        """
        records = [record for record in self.manifest.parts if record.kind == "cell"]
        return decode_cells(self.manifest, [self._read(record) for record in records])

    def visual_map(self) -> VisualMap:
        """The whole map from the full part, equal to the one that was written.

        Raises:
            MapPackageError: the package has no full part, or it is damaged.
        """
        for record in self.manifest.parts:
            if record.kind == "full":
                return decode_full(self._read(record), self.manifest, str(self._path(record)))
        raise MapPackageError(f"{self.folder} holds no full part, only cells; mapping on needs the whole package")

    def road_quality(self) -> RoadQuality | None:
        """How good the map is along the road; None for a map whose writer did not say.

        Raises:
            MapPackageError: the quality part is missing or damaged.
        """
        for record in self.manifest.parts:
            if record.kind == "quality":
                anchor = self.manifest.anchor.to_anchor()
                return decode_quality(self._read(record), anchor, str(self._path(record)))
        return None

    def _path(self, record: PartRecord) -> Path:
        return self.folder / PARTS_NAME / f"{record.sha256}.bin"

    def _read(self, record: PartRecord) -> bytes:
        path = self._path(record)
        data = _read_file(path, record.size_bytes)
        if len(data) != record.size_bytes:
            raise MapPackageError(
                f"{path} is not the {record.size_bytes} bytes long that the manifest says; {_AGAIN}"
            )
        if hashlib.sha256(data).hexdigest() != record.sha256:
            raise MapPackageError(f"{path} is damaged or was tampered with: its SHA-256 is another; {_AGAIN}")
        return data


_AGAIN = "copy or download the map again"


def write_package(
    folder: Path,
    visual_map: VisualMap,
    *,
    map_id: str,
    quality: Quality,
    provenance: Provenance,
    road_quality: RoadQuality | None = None,
    localizable: LocalizationMap | None = None,
    force: bool = False,
) -> Manifest:
    """Write a map as a package. The folder is there whole or not at all; the same map gives the same bytes.

    ``localizable`` is what of the map goes into the cells (see fleetmap.landmark_choice), by default all of it.

    Raises:
        OutputExistsError: the folder exists and ``force`` is not given, or what exists is not a map package.
        MapPackageError: the map is empty, contradicts itself or its quality record, or ``map_id`` is no map id.
        StorageError: the disk is full or refuses.
    """
    check_map_id(map_id)
    target = folder.resolve()
    check_target(target, force)
    parts, manifest = encode_package(visual_map, localizable, map_id, quality, provenance, road_quality)
    manifest_bytes = manifest.to_bytes()
    if len(manifest_bytes) > MAX_MANIFEST_BYTES:
        raise MapPackageError(f"manifest of map '{map_id}' exceeds {MAX_MANIFEST_BYTES} bytes; split the drive")
    with atomic_path(target) as draft:
        (draft / PARTS_NAME).mkdir(parents=True)
        for record, data in zip(manifest.parts, parts, strict=True):
            _write_file(draft / PARTS_NAME / f"{record.sha256}.bin", data)
        _write_file(draft / MANIFEST_NAME, manifest_bytes)
    return manifest


def check_target(folder: Path, force: bool) -> None:
    """Refuse to write a package where one is already, and even with ``force`` where something else is.

    Worth asking before the map is made: mapping takes minutes.

    Raises:
        OutputExistsError: the folder exists and ``force`` is not given, or what exists is not a map package.
        StorageError: the place cannot be looked at.
    """
    try:
        refuse_existing(folder, force)
        is_replaceable = not folder.exists() or (folder.is_dir() and (_is_package(folder) or _is_empty(folder)))
    except OSError as error:
        raise StorageError(f"cannot write {folder}: {error.strerror or error}") from error
    if not is_replaceable:
        raise OutputExistsError(f"{folder} is not a map package, --force will not replace it; give another name")


def open_package(folder: Path) -> MapPackage:
    """Open a package; its parts are read later, when they are asked for.

    Raises:
        MapPackageError: no package there, or its manifest does not hold.
    """
    with _reading(folder):
        if not folder.is_dir():
            raise MapPackageError(f"there is no map package at {folder}; make one with 'fleetmap map'")
        if not (folder / MANIFEST_NAME).exists():
            raise MapPackageError(f"{folder} is no map package: it holds no {MANIFEST_NAME}")
    manifest_bytes = _read_file(folder / MANIFEST_NAME, MAX_MANIFEST_BYTES)
    return MapPackage(folder, parse_manifest(manifest_bytes, str(folder)), manifest_bytes)


def decode_cells(manifest: Manifest, parts: Sequence[bytes]) -> LocalizationMap:
    """Cell parts of a map, as read or fetched in any order and number, merged into what a localizer needs.

    Raises:
        MapPackageError: bytes that are no cell part of this manifest, or that do not decode.
    """
    anchor = manifest.anchor.to_anchor()
    records = {record.sha256: record for record in manifest.parts if record.kind == "cell"}
    fetched = {hashlib.sha256(data).hexdigest(): data for data in parts}
    cells = []
    for sha256 in sorted(fetched):
        if sha256 not in records:
            raise MapPackageError(
                f"bytes with SHA-256 {sha256} are no cell part of map '{manifest.map_id}'; {_AGAIN}"
            )
        origin = f"part {sha256}.bin of map '{manifest.map_id}'"
        cells.append(decode_cell(fetched[sha256], records[sha256], anchor, origin))
    return merge_cells(anchor, cells)


def verify_package(package: MapPackage) -> None:
    """Read every part: all present, undamaged, decodable, and holding as much as the manifest says.

    Raises:
        MapPackageError: what does not hold, and in which file.
    """
    manifest, origin = package.manifest, str(package.folder)
    for record in manifest.parts:
        if record.kind not in ("cell", "full", "quality"):
            package.part_bytes(record.sha256)
    merged, told = package.localization_map(), manifest.localizable
    keyframes = manifest.quality.keyframes if told is None else told.keyframes
    check_counts(keyframes, {"keyframes of all cells": len(merged.keyframes)}, origin)
    if told is not None:
        check_counts(told.landmarks, {"landmarks of all cells": len(merged.landmarks)}, origin)
    visual_map, road_quality = package.visual_map(), package.road_quality()
    counted = {}
    if road_quality is not None:
        counted["keyframes of the quality part"] = len(road_quality.keyframes)
    full = next(record for record in manifest.parts if record.kind == "full")
    counted |= {"keyframes of the full part": full.keyframes, "keyframes read": len(visual_map.keyframes)}
    check_counts(manifest.quality.keyframes, counted, origin)
    check_counts(
        manifest.quality.landmarks,
        {"landmarks of the full part": full.landmarks, "landmarks read": len(visual_map.landmarks)},
        origin,
    )
    check_counts(manifest.quality.observations, {"observations read": len(visual_map.observations)}, origin)


def _is_package(folder: Path) -> bool:
    """Whether a folder holds a map package, be it damaged or of another version."""
    manifest = folder / MANIFEST_NAME
    return manifest.is_file() and FORMAT_NAME.encode() in _read_file(manifest, MAX_MANIFEST_BYTES)


def _is_empty(folder: Path) -> bool:
    return next(folder.iterdir(), None) is None


def _read_file(path: Path, limit_bytes: int) -> bytes:
    """A file's bytes, at most one more than the limit: enough to tell that a file is too long."""
    with _reading(path):
        if not path.is_file():
            raise MapPackageError(f"{path} is missing; {_AGAIN}")
        with path.open("rb") as file:
            return file.read(min(path.stat().st_size, limit_bytes) + 1)


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise MapPackageError(f"{path} cannot be read: {error.strerror or error}") from error


def _write_file(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
