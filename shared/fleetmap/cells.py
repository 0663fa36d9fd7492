"""The "cell" parts of a map package: all that a localizer needs, one part per 128 m UTM cell.

A cell holds the keyframes whose camera centre lies in it, every landmark they see, and who sees what. It stands on
its own, so a landmark seen from two cells lies in both; map-wide ids tell when cells are merged.

Landmark positions are int32 millimetres from the cell's south-west corner at ellipsoidal height 0: the rounding
(0.5 mm per axis) is the same near and far, which float32 would not give, and a landmark reads the same from every
cell that holds it. Keyframe poses stay float64. Normals are rounded to 1/127, distances to float16.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import MapPackageError
from fleetmap.full_part import MAX_EXTENT_M, check_ascending, check_indices
from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import quat_xyzw_from_rotations, rotations_from_quat_xyzw
from fleetmap.manifest import CELL_SIZE_M, MAX_INDEX, PartRecord
from fleetmap.parts import Part, decode_part, encode_part
from fleetmap.visual_map import Keyframes, Landmarks, LocalizationMap, VisualMap

Ids = NDArray[np.int64]
CellIndex = tuple[int, int]  # floor(easting / 128), floor(northing / 128)
MAX_CELL_BYTES = 128 * 1024 * 1024  # inflated; two million landmarks
_MM_PER_M = 1000
_MAX_FLOAT16 = 65504.0
_UNIT_TOLERANCE = 1e-6

Group = TypeVar("Group", Keyframes, Landmarks)


@dataclass(frozen=True)
class Cell:
    """The content of one cell, in map-wide ids: the indices of keyframes and landmarks in the VisualMap."""

    keyframe_ids: Ids  # (K,) int64 ascending
    keyframes: Keyframes
    landmark_ids: Ids  # (N,) int64 ascending
    landmarks: Landmarks
    seen_by_keyframe: Ids  # (M,) int64 index into keyframe_ids; sorted by keyframe, then landmark
    seen_landmark: Ids  # (M,) int64 index into landmark_ids


def split_into_cells(visual_map: VisualMap) -> dict[CellIndex, Cell]:
    """The cells of a map that hold keyframes, in order of their index."""
    in_utm = visual_map.anchor.utm_from_map(visual_map.keyframes.positions_m)
    cells, cell_of_keyframe = np.unique(
        np.floor(in_utm[:, :2] / CELL_SIZE_M).astype(np.int64), axis=0, return_inverse=True
    )
    cell_of_keyframe = cell_of_keyframe.reshape(-1)
    cell_of_observation = cell_of_keyframe[visual_map.observations.keyframe_index]
    by_cell = np.argsort(cell_of_observation, kind="stable")
    borders = np.searchsorted(cell_of_observation[by_cell], np.arange(1, len(cells)))
    return {
        (int(east), int(north)): _cut_out(visual_map, np.flatnonzero(cell_of_keyframe == number), observed)
        for number, ((east, north), observed) in enumerate(zip(cells, np.split(by_cell, borders), strict=True))
    }


def encode_cell(index: CellIndex, cell: Cell, anchor: UtmAnchor) -> bytes:
    """The part of one cell of a map that passed check_visual_map.

    Raises:
        MapPackageError: the cell exceeds MAX_CELL_BYTES.
    """
    offset_m = _corner_m(index) - anchor.offset_m
    points_mm = np.rint(cell.landmarks.points_m * _MM_PER_M) - offset_m * _MM_PER_M
    arrays = {
        "keyframe_ids": cell.keyframe_ids.astype("<u4"),
        "keyframe_stamps_ns": cell.keyframes.stamps_ns.astype("<i8"),
        "keyframe_positions_m": (cell.keyframes.positions_m - offset_m).astype("<f8"),
        "keyframe_quat_xyzw": quat_xyzw_from_rotations(cell.keyframes.rotations).reshape(-1, 4).astype("<f8"),
        "landmark_ids": cell.landmark_ids.astype("<u4"),
        "landmark_points_mm": points_mm.astype("<i4"),
        "landmark_descriptors": cell.landmarks.descriptors.astype("|u1"),
        "landmark_normals": np.rint(cell.landmarks.normals * 127.0).clip(-127, 127).astype("|i1"),
        "landmark_octaves": cell.landmarks.octaves.astype("|u1"),
        "landmark_distances_m": cell.landmarks.distances_m.clip(0.0, _MAX_FLOAT16).astype("<f2"),
        "seen_by_keyframe": cell.seen_by_keyframe.astype("<u4"),
        "seen_landmark": cell.seen_landmark.astype("<u4"),
    }
    return encode_part("cell", _attributes(index, anchor), arrays, MAX_CELL_BYTES)


def decode_cell(data: bytes, record: PartRecord, anchor: UtmAnchor, origin: str) -> Cell:
    """The content of a cell part in the map frame of ``anchor``; ``origin`` says where the bytes came from.

    Raises:
        MapPackageError: the part is malformed, or is not the cell that the manifest's record describes.
    """
    part = decode_part(data, origin, MAX_CELL_BYTES)
    wanted = _attributes(record.cell, anchor) if record.cell else {}
    if part.kind != "cell" or {key: part.attributes.get(key) for key in wanted} != wanted or not record.cell:
        raise MapPackageError(
            f"{origin} is not the cell {record.cell} of EPSG:{anchor.epsg} that the manifest names"
        )
    offset_m = _corner_m(record.cell) - anchor.offset_m
    keyframe_ids = _read_ids(part, "keyframe_ids", record.keyframes)
    landmark_ids = _read_ids(part, "landmark_ids", record.landmarks)
    seen_by_keyframe, seen_landmark = _read_pairs(part, len(keyframe_ids), len(landmark_ids))
    return Cell(
        keyframe_ids,
        _read_keyframes(part, len(keyframe_ids), offset_m),
        landmark_ids,
        _read_landmarks(part, len(landmark_ids), offset_m),
        seen_by_keyframe,
        seen_landmark,
    )


def merge_cells(anchor: UtmAnchor, cells: Sequence[Cell]) -> LocalizationMap:
    """One map of any cells of a package; each landmark appears once, keyframes are in time order.

    Raises:
        MapPackageError: two cells claim the same keyframe, or their clocks disagree with their keyframes' order.
    """
    cells = cells or [_EMPTY_CELL]
    all_keyframe_ids = np.concatenate([cell.keyframe_ids for cell in cells])
    keyframe_ids, keyframe_rows = np.unique(all_keyframe_ids, return_index=True)
    if len(keyframe_ids) != len(all_keyframe_ids):
        raise MapPackageError("two cells of the map claim the same keyframe; build or download the map again")
    landmark_ids, landmark_rows = np.unique(
        np.concatenate([cell.landmark_ids for cell in cells]), return_index=True
    )
    seen_by_keyframe = np.concatenate([cell.keyframe_ids[cell.seen_by_keyframe] for cell in cells])
    seen_landmark = np.concatenate([cell.landmark_ids[cell.seen_landmark] for cell in cells])
    order = np.lexsort((seen_landmark, seen_by_keyframe))
    keyframes = _take(_joined([cell.keyframes for cell in cells]), keyframe_rows)
    check_ascending(keyframes.stamps_ns, "keyframe stamps", "the map merged of its cells")
    return LocalizationMap(
        anchor,
        keyframes,
        _take(_joined([cell.landmarks for cell in cells]), landmark_rows),
        np.searchsorted(keyframe_ids, seen_by_keyframe[order]).astype(np.int32),
        np.searchsorted(landmark_ids, seen_landmark[order]).astype(np.int32),
    )


def _cut_out(visual_map: VisualMap, keyframe_ids: Ids, observed: Ids) -> Cell:
    """The cell of these keyframes and of their observations ``observed``."""
    landmark_index = visual_map.observations.landmark_index[observed].astype(np.int64)
    keyframe_index = visual_map.observations.keyframe_index[observed].astype(np.int64)
    pairs = np.unique(keyframe_index << 32 | landmark_index)  # sorted by keyframe, then landmark
    landmark_ids, seen_landmark = np.unique(pairs & 0xFFFFFFFF, return_inverse=True)
    return Cell(
        keyframe_ids,
        _take(visual_map.keyframes, keyframe_ids),
        landmark_ids,
        _take(visual_map.landmarks, landmark_ids),
        np.searchsorted(keyframe_ids, pairs >> 32),
        seen_landmark,
    )


def _read_keyframes(part: Part, count: int, offset_m: NDArray[np.float64]) -> Keyframes:
    positions_in_cell = part.array("keyframe_positions_m", "<f8", (count, 3))
    lowest, highest = (0.0, 0.0, -MAX_EXTENT_M), (CELL_SIZE_M, CELL_SIZE_M, MAX_EXTENT_M)
    if ((positions_in_cell < lowest) | (positions_in_cell > highest)).any():
        raise MapPackageError(f"{part.origin}: a keyframe lies outside the cell")
    quat_xyzw = part.array("keyframe_quat_xyzw", "<f8", (count, 4))
    if (np.abs(np.linalg.norm(quat_xyzw.clip(-2.0, 2.0), axis=1) - 1.0) > _UNIT_TOLERANCE).any():
        raise MapPackageError(f"{part.origin}: keyframe orientations are no unit quaternions")
    rotations = rotations_from_quat_xyzw(quat_xyzw) if count else np.empty((0, 3, 3))
    return Keyframes(part.array("keyframe_stamps_ns", "<i8", (count,)), rotations, positions_in_cell + offset_m)


def _read_landmarks(part: Part, count: int, offset_m: NDArray[np.float64]) -> Landmarks:
    points_mm = part.array("landmark_points_mm", "<i4", (count, 3)) + np.rint(offset_m * _MM_PER_M)
    normals = part.array("landmark_normals", "|i1", (count, 3)).astype(np.float32)
    distances_m = part.array("landmark_distances_m", "<f2", (count,)).astype(np.float32)
    if (distances_m < 0.0).any():
        raise MapPackageError(f"{part.origin}: landmarks were seen from a negative distance")
    return Landmarks(
        points_mm / _MM_PER_M,
        part.array("landmark_descriptors", "|u1", (count, 32)),
        normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1.0),
        part.array("landmark_octaves", "|u1", (count,)),
        distances_m,
    )


def _read_ids(part: Part, name: str, count: int) -> Ids:
    ids = part.array(name, "<u4", (count,)).astype(np.int64)
    check_indices(ids, MAX_INDEX, name, part.origin)
    check_ascending(ids, name, part.origin)
    return ids


def _read_pairs(part: Part, keyframes: int, landmarks: int) -> tuple[Ids, Ids]:
    """``seen_by_keyframe`` and ``seen_landmark`` of Cell."""
    seen_by_keyframe = part.array("seen_by_keyframe", "<u4", (None,)).astype(np.int64)
    seen_landmark = part.array("seen_landmark", "<u4", (len(seen_by_keyframe),)).astype(np.int64)
    check_indices(seen_by_keyframe, keyframes, "observing keyframes", part.origin)
    check_indices(seen_landmark, landmarks, "observed landmarks", part.origin)
    check_ascending(seen_by_keyframe << 32 | seen_landmark, "pairs of keyframe and landmark", part.origin)
    return seen_by_keyframe, seen_landmark


def _attributes(index: CellIndex, anchor: UtmAnchor) -> dict[str, Any]:
    return {"epsg": anchor.epsg, "cell": list(index)}


def _corner_m(index: CellIndex) -> NDArray[np.float64]:
    return np.array([index[0] * CELL_SIZE_M, index[1] * CELL_SIZE_M, 0.0])


def _take(group: Group, rows: NDArray[Any]) -> Group:
    columns: dict[str, Any] = {field.name: getattr(group, field.name) for field in fields(group)}
    return type(group)(**{name: None if column is None else column[rows] for name, column in columns.items()})


def _joined(groups: Sequence[Group]) -> Group:
    """All rows; a column that one of the groups lacks is left out."""
    columns: dict[str, Any] = {}
    for name in (field.name for field in fields(groups[0])):
        parts = [getattr(group, name) for group in groups]
        columns[name] = None if any(part is None for part in parts) else np.concatenate(parts)
    return type(groups[0])(**columns)


_NO_IDS = np.empty(0, np.int64)
_EMPTY_CELL = Cell(
    _NO_IDS,
    Keyframes(_NO_IDS, np.empty((0, 3, 3)), np.empty((0, 3))),
    _NO_IDS,
    Landmarks(
        np.empty((0, 3)),
        np.empty((0, 32), np.uint8),
        np.empty((0, 3), np.float32),
        np.empty(0, np.uint8),
        np.empty(0, np.float32),
    ),
    _NO_IDS,
    _NO_IDS,
)
