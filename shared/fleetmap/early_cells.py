"""Cell parts as maps of format 1 have them: read for as long as such maps live, written no more.

Landmark positions are int32 millimetres from the cell's corner, keyframe poses float64, normals rounded to 1/127,
distances float16; ids and pairs of who sees what are plain numbers. How exact landmarks are is not told.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap.cell import MM_PER_M, Cell, Ids
from fleetmap.errors import MapPackageError
from fleetmap.full_part import MAX_EXTENT_M, check_ascending, check_indices
from fleetmap.geometry import rotations_from_quat_xyzw
from fleetmap.manifest import CELL_SIZE_M, MAX_INDEX, PartRecord
from fleetmap.parts import Part
from fleetmap.visual_map import Keyframes, Landmarks

_UNIT_TOLERANCE = 1e-6


def read_early_cell(part: Part, record: PartRecord, offset_m: NDArray[np.float64]) -> Cell:
    """The content of a cell whose corner lies at ``offset_m`` (3,) in map.

    Raises:
        MapPackageError: an array is missing or does not hold.
    """
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
    points_mm = part.array("landmark_points_mm", "<i4", (count, 3)) + np.rint(offset_m * MM_PER_M)
    normals = part.array("landmark_normals", "|i1", (count, 3)).astype(np.float32)
    distances_m = part.array("landmark_distances_m", "<f2", (count,)).astype(np.float32)
    if (distances_m < 0.0).any():
        raise MapPackageError(f"{part.origin}: landmarks were seen from a negative distance")
    return Landmarks(
        points_mm / MM_PER_M,
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
