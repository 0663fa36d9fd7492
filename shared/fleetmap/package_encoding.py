"""A map as the parts of its package and the manifest that lists them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from fleetmap.cell import Cell, CellIndex
from fleetmap.cells import encode_cell, split_into_cells, whole_map
from fleetmap.errors import MapPackageError
from fleetmap.footprint import bounding_box, keyframes_lonlat, thinned
from fleetmap.full_part import check_visual_map, encode_full
from fleetmap.geometry import Sim3, quat_xyzw_from_rotations
from fleetmap.landmark_precision import with_precision
from fleetmap.manifest import MAX_PART_BYTES, Localizable, Manifest, Provenance, Quality, make_manifest
from fleetmap.quality_part import encode_quality
from fleetmap.road_quality import RoadQuality
from fleetmap.visual_map import LocalizationMap, VisualMap


def encode_package(
    visual_map: VisualMap,
    localizable: LocalizationMap | None,
    map_id: str,
    quality: Quality,
    provenance: Provenance,
    road_quality: RoadQuality | None,
) -> tuple[list[bytes], Manifest]:
    """All parts, and the manifest that lists them in the same order.

    Raises:
        MapPackageError: the map is empty or too large, or contradicts itself or its quality record.
    """
    origin = f"map '{map_id}'"
    check_visual_map(visual_map, origin)
    keyframes, landmarks = visual_map.keyframes, visual_map.landmarks
    if len(keyframes) == 0:
        raise MapPackageError(f"{origin} holds no keyframes")
    check_counts(quality.keyframes, {"keyframes": len(keyframes)}, origin)
    check_counts(quality.landmarks, {"landmarks": len(landmarks)}, origin)
    check_counts(quality.observations, {"observations": len(visual_map.observations)}, origin)
    if road_quality is not None:
        check_counts(quality.keyframes, {"keyframes along the road": len(road_quality.keyframes)}, origin)
    localizable = localizable or whole_map(with_precision(visual_map))
    parts, records = _encode_parts(visual_map, localizable, road_quality)
    lonlat = keyframes_lonlat(visual_map.anchor, keyframes)
    fields = {
        "map_id": map_id,
        "anchor": asdict(visual_map.anchor),
        "map_from_vis": _sim3_fields(visual_map.map_from_vis),
        "camera": asdict(visual_map.camera),
        "bbox_lonlat": bounding_box(lonlat),
        "trajectory_lonlat": lonlat[thinned(keyframes.positions_m)].tolist(),
        "parts": records,
        "localizable": _localizable(localizable, records),
        "quality": quality,
        "provenance": provenance,
    }
    return parts, make_manifest(fields, origin)


def cell_parts(localizable: LocalizationMap) -> dict[CellIndex, tuple[bytes, Cell]]:
    """The cells of a map or of what was chosen of it, encoded, in order of their index.

    Raises:
        MapPackageError: a cell is too large.
    """
    return {
        index: (encode_cell(index, cell, localizable.anchor), cell)
        for index, cell in split_into_cells(localizable).items()
    }


def check_counts(wanted: int, counted: dict[str, int], origin: str) -> None:
    """Hold what was counted against what the quality record says.

    Raises:
        MapPackageError: what is too many or too few.
    """
    for what, count in counted.items():
        if count != wanted:
            raise MapPackageError(f"{origin} contradicts itself: {count} {what}, its quality record says {wanted}")


def _encode_parts(
    visual_map: VisualMap, localizable: LocalizationMap, road_quality: RoadQuality | None
) -> tuple[list[bytes], list[dict[str, Any]]]:
    """Cells in order, the full part, and the quality part where there is one; each with its record."""
    parts: list[bytes] = []
    records: list[dict[str, Any]] = []
    for index, (data, cell) in cell_parts(localizable).items():
        parts.append(data)
        records.append(_record("cell", parts[-1], len(cell.keyframe_ids), len(cell.landmark_ids), index))
    parts.append(encode_full(visual_map))
    records.append(_record("full", parts[-1], len(visual_map.keyframes), len(visual_map.landmarks), None))
    if road_quality is not None:
        parts.append(encode_quality(road_quality, visual_map.anchor))
        records.append(_record("quality", parts[-1], len(road_quality.keyframes), 0, None))
    return parts, records


def _localizable(localizable: LocalizationMap, records: Sequence[dict[str, Any]]) -> Localizable:
    return Localizable(
        keyframes=len(localizable.keyframes),
        landmarks=len(np.unique(localizable.seen_landmark)),
        size_bytes=sum(record["size_bytes"] for record in records if record["kind"] == "cell"),
    )


def _record(
    kind: str, data: bytes, keyframes: int, landmarks: int, cell: tuple[int, int] | None
) -> dict[str, Any]:
    if len(data) > MAX_PART_BYTES:
        raise MapPackageError(f"a '{kind}' part of {len(data)} bytes exceeds {MAX_PART_BYTES}; split the drive")
    return {
        "kind": kind,
        "sha256": hashlib.sha256(data).hexdigest(),
        "size_bytes": len(data),
        "cell": cell,
        "keyframes": keyframes,
        "landmarks": landmarks,
    }


def _sim3_fields(sim3: Sim3) -> dict[str, object]:
    return {
        "scale": float(sim3.scale),
        "quat_xyzw": quat_xyzw_from_rotations(sim3.rotation).tolist(),
        "translation_m": sim3.translation_m.tolist(),
    }
