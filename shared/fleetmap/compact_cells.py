"""Cell parts as maps of format 2 have them: about 41 bytes per landmark, of which 32 are its descriptor.

    array                  dtype  shape    holds
    keyframe_stamps_ns     <i8    (K,)     stamps, as differences
    keyframe_poses         <u4    (8, K)   id; x, y, z in mm; quaternion x, y, z, w in 1/200,000; as differences
    keyframe_covariances   |u1    (21, K)  see fleetmap.covariance_bytes, as differences modulo 256; may be missing
    landmark_places        <u4    (4, N)   id, as differences; x, y, z in steps of the landmark's own
    landmark_descriptors   |u1    (N, 32)
    landmark_looks         |u1    (4, N)   octave, distance, azimuth and elevation of the normal
    landmark_sigmas        |u1    (2, N)   across and along the normal; may be missing
    landmark_angles        |u1    (N,)     orientation of the descriptor; since format 2.1, may be missing
    landmark_runs          <u4    (N,)     runs of consecutive keyframes of the cell that see the landmark
    runs                   <u4    (2, R)   where a run begins, as differences; its length less 1

"As differences" is: the first as it is, then each less the one before. A landmark's first run begins so and so far
from where that of the landmark before begins, its others from where the run before ended. Numbers that may be
negative are stored as 2 n or -2 n - 1 (zigzag), so that small ones keep their upper bytes 0.

Positions count from the cell's south-west corner at ellipsoidal height 0: keyframes in millimetres, landmarks in
steps of 8 to 1,024 mm, the largest power of two that is at most a quarter of the standard deviation across. 8 mm
are a quarter of a pixel at 30 m; what rounding to them errs, 2.3 mm, is part of the deviations that are stored.
Rounding to more adds less than 1 % to the variance. Since every step divides 128 m, a landmark reads the same from
every cell that holds it. Distances and deviations are logarithmic (see fleetmap.log_bytes): within 2 %, and up to
8 % too large, never too small. Normals are rounded to 360/256 degrees, twice; keyframes' orientations to 1e-5 rad,
descriptors' to 360/64 degrees: ORB itself does not need them closer. Where no deviations are known, positions are
rounded to a millimetre.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap.cell import MM_PER_M, Cell, Ids
from fleetmap.covariance_bytes import covariances_from_bytes, covariances_to_bytes
from fleetmap.errors import MapPackageError
from fleetmap.full_part import MAX_EXTENT_M, check_ascending, check_indices
from fleetmap.geometry import quat_xyzw_from_rotations, rotations_from_quat_xyzw
from fleetmap.log_bytes import LogBytes
from fleetmap.manifest import CELL_SIZE_M, MAX_INDEX, PartRecord
from fleetmap.parts import Part
from fleetmap.visual_map import Keyframes, Landmarks

MAX_PAIRS = 16 * 1024 * 1024  # of keyframe and landmark in a cell
_QUATERNION_UNITS = 200_000.0
_UNIT_TOLERANCE = 1e-3
_DISTANCES_M = LogBytes(0.1, 0.04)  # 0.1 m to 2.7 km
_ROUNDING_M = 8e-3 / 12.0**0.5  # standard deviation
SIGMAS_M = LogBytes(_ROUNDING_M, 0.08)
_STEPS_PER_SIGMA = 4.0
_MIN_SHIFT, _MAX_SHIFT = 3, 10
_UNITS_PER_RAD = 256.0 / (2.0 * np.pi)
_ANGLES = 64  # of a descriptor


def compact_arrays(cell: Cell, offset_m: NDArray[np.float64]) -> dict[str, NDArray[np.generic]]:
    """The arrays of a cell whose corner lies at ``offset_m`` (3,) in map.

    Raises:
        MapPackageError: the cell has more than MAX_PAIRS pairs of keyframe and landmark.
    """
    keyframes, landmarks = cell.keyframes, cell.landmarks
    arrays: dict[str, NDArray[np.generic]] = {
        "keyframe_stamps_ns": np.diff(keyframes.stamps_ns, prepend=0).astype("<i8"),
        "keyframe_poses": _zigzag(np.diff(_pose_numbers(cell, offset_m), prepend=0)).astype("<u4"),
    }
    if keyframes.covariances is not None:
        stored = covariances_to_bytes(keyframes.covariances)
        arrays["keyframe_covariances"] = np.diff(stored, prepend=np.uint8(0)).astype("|u1")
    sigmas = None if landmarks.sigmas_m is None else SIGMAS_M.at_least(np.hypot(landmarks.sigmas_m, _ROUNDING_M)).T
    in_cell_mm = np.rint(landmarks.points_m * MM_PER_M).T - np.rint(offset_m * MM_PER_M)[:, None]
    step_mm = 2.0 ** _shifts(sigmas)
    steps = np.floor(in_cell_mm / step_mm + 0.5).astype(np.int64)  # rint would round halves by the cell's number
    ids = np.diff(cell.landmark_ids, prepend=0)[None, :]
    arrays["landmark_places"] = _zigzag(np.concatenate([ids, steps])).astype("<u4")
    arrays["landmark_descriptors"] = landmarks.descriptors.astype("|u1")
    arrays["landmark_looks"] = np.stack(
        [
            landmarks.octaves,
            _DISTANCES_M.nearest(landmarks.distances_m),
            *_direction_bytes(landmarks.normals),
        ]
    ).astype("|u1")
    if sigmas is not None:
        arrays["landmark_sigmas"] = sigmas.astype("|u1")
    if landmarks.angles_deg is not None:
        arrays["landmark_angles"] = (np.rint(landmarks.angles_deg * (_ANGLES / 360.0)) % _ANGLES).astype("|u1")
    arrays["landmark_runs"], arrays["runs"] = _runs_of(cell)
    return arrays


def read_compact_cell(part: Part, record: PartRecord, offset_m: NDArray[np.float64]) -> Cell:
    """The content of a cell whose corner lies at ``offset_m`` (3,) in map.

    Raises:
        MapPackageError: an array is missing or does not hold.
    """
    keyframe_ids, keyframes = _read_keyframes(part, record.keyframes, offset_m)
    landmark_ids, landmarks = _read_landmarks(part, record.landmarks, offset_m)
    pairs = _read_pairs(part, len(keyframe_ids), len(landmark_ids))
    return Cell(keyframe_ids, keyframes, landmark_ids, landmarks, *pairs)


def _pose_numbers(cell: Cell, offset_m: NDArray[np.float64]) -> Ids:
    """Ids, millimetres and quaternions (8, K); a quaternion keeps the sign of the one before."""
    in_cell_mm = np.rint((cell.keyframes.positions_m - offset_m) * MM_PER_M)
    quat_xyzw = quat_xyzw_from_rotations(cell.keyframes.rotations).reshape(-1, 4)
    turns = np.sum(quat_xyzw[1:] * quat_xyzw[:-1], axis=1) < 0.0
    signs = np.cumprod(np.where(np.concatenate([[False], turns]), -1.0, 1.0))[: len(quat_xyzw)]
    numbers = np.rint(quat_xyzw * signs[:, None] * _QUATERNION_UNITS)
    return np.concatenate([cell.keyframe_ids[:, None], in_cell_mm, numbers], axis=1).astype(np.int64).T


def _direction_bytes(normals: NDArray[np.float32]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Azimuth and elevation of unit vectors (N, 3)."""
    azimuth_rad = np.arctan2(normals[:, 1], normals[:, 0])
    elevation_rad = np.arctan2(normals[:, 2], np.hypot(normals[:, 0], normals[:, 1]))
    azimuth, elevation = np.rint(azimuth_rad * _UNITS_PER_RAD), np.rint(elevation_rad * _UNITS_PER_RAD)
    return azimuth.astype(np.int16).astype(np.uint8), elevation.astype(np.int8).view(np.uint8)


def _runs_of(cell: Cell) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """``landmark_runs`` and ``runs``."""
    order = np.lexsort((cell.seen_by_keyframe, cell.seen_landmark))
    keyframe, landmark = cell.seen_by_keyframe[order], cell.seen_landmark[order]
    is_first = np.ones(len(order), np.bool_)
    is_first[1:] = (landmark[1:] != landmark[:-1]) | (keyframe[1:] != keyframe[:-1] + 1)
    starts = np.flatnonzero(is_first)
    lengths = np.diff(np.append(starts, len(order)))
    if len(order) > MAX_PAIRS:
        raise MapPackageError(f"a cell of {len(order)} pairs of keyframe and landmark exceeds {MAX_PAIRS}")
    counts = np.bincount(landmark[starts], minlength=len(cell.landmark_ids))
    begins = keyframe[starts]
    befores = np.concatenate([[0], (begins + lengths)[:-1]])[: len(begins)]
    leads = np.flatnonzero(np.diff(landmark[starts], prepend=-1))  # each landmark's first run
    befores[leads] = np.concatenate([[0], begins[leads[:-1]]])[: len(leads)]
    return counts.astype("<u4"), np.stack([_zigzag(begins - befores), lengths - 1]).astype("<u4")


def _read_keyframes(part: Part, count: int, offset_m: NDArray[np.float64]) -> tuple[Ids, Keyframes]:
    numbers = np.cumsum(_unzigzag(part.array("keyframe_poses", "<u4", (8, count))), axis=1)
    ids, in_cell_mm, quat_xyzw = numbers[0], numbers[1:4].T, numbers[4:].T / _QUATERNION_UNITS
    _check_ids(ids, "keyframe ids", part.origin)
    lowest, highest = (0, 0, -MAX_EXTENT_M), (CELL_SIZE_M, CELL_SIZE_M, MAX_EXTENT_M)
    if ((in_cell_mm < np.multiply(lowest, MM_PER_M)) | (in_cell_mm > np.multiply(highest, MM_PER_M))).any():
        raise MapPackageError(f"{part.origin}: a keyframe lies outside the cell")
    lengths = np.linalg.norm(quat_xyzw, axis=1, keepdims=True)
    if (np.abs(lengths - 1.0) > _UNIT_TOLERANCE).any():
        raise MapPackageError(f"{part.origin}: keyframe orientations are no unit quaternions")
    stamps_ns = np.cumsum(part.array("keyframe_stamps_ns", "<i8", (count,)))
    covariances = None
    if "keyframe_covariances" in part:
        stored = np.cumsum(part.array("keyframe_covariances", "|u1", (21, count)), axis=1, dtype=np.uint8)
        covariances = covariances_from_bytes(stored, part.origin)
    rotations = rotations_from_quat_xyzw(quat_xyzw / lengths) if count else np.empty((0, 3, 3))
    return ids, Keyframes(stamps_ns, rotations, in_cell_mm / MM_PER_M + offset_m, covariances)


def _read_landmarks(part: Part, count: int, offset_m: NDArray[np.float64]) -> tuple[Ids, Landmarks]:
    numbers = _unzigzag(part.array("landmark_places", "<u4", (4, count)))
    ids = np.cumsum(numbers[0])
    _check_ids(ids, "landmark ids", part.origin)
    octaves, distances, azimuth, elevation = part.array("landmark_looks", "|u1", (4, count))
    sigmas = part.array("landmark_sigmas", "|u1", (2, count)) if "landmark_sigmas" in part else None
    angles = part.array("landmark_angles", "|u1", (count,)) if "landmark_angles" in part else None
    in_map_mm = (numbers[1:] << _shifts(sigmas)) + np.rint(offset_m * MM_PER_M)[:, None]
    azimuth_rad = azimuth / _UNITS_PER_RAD
    elevation_rad = elevation.view(np.int8) / _UNITS_PER_RAD
    flat = np.cos(elevation_rad)
    normals = np.stack([np.cos(azimuth_rad) * flat, np.sin(azimuth_rad) * flat, np.sin(elevation_rad)], axis=1)
    return ids, Landmarks(
        in_map_mm.T / MM_PER_M,
        part.array("landmark_descriptors", "|u1", (count, 32)),
        normals.astype(np.float32),
        octaves,
        _DISTANCES_M.values(distances).astype(np.float32),
        None if sigmas is None else SIGMAS_M.values(sigmas.T).astype(np.float32),
        None if angles is None else angles.astype(np.float32) * np.float32(360.0 / _ANGLES),
    )


def _read_pairs(part: Part, keyframes: int, landmarks: int) -> tuple[Ids, Ids]:
    """``seen_by_keyframe`` and ``seen_landmark`` of Cell."""
    counts = part.array("landmark_runs", "<u4", (landmarks,)).astype(np.int64)
    leaps, lengths = part.array("runs", "<u4", (2, None)).astype(np.int64)
    leaps, lengths = _unzigzag(leaps), lengths + 1
    if counts.sum() != len(leaps):
        raise MapPackageError(f"{part.origin}: landmarks have {counts.sum()} runs, there are {len(leaps)}")
    if lengths.sum() > MAX_PAIRS:
        raise MapPackageError(f"{part.origin} holds more than {MAX_PAIRS} pairs of keyframe and landmark")
    landmark = np.repeat(np.arange(landmarks), counts)
    begins = _run_begins(landmark, leaps, lengths)
    check_indices(begins, keyframes, "observing keyframes", part.origin)
    check_indices(begins + lengths - 1, keyframes, "observing keyframes", part.origin)
    check_ascending(landmark << 32 | begins, "runs", part.origin)
    first_pairs = np.cumsum(lengths) - lengths
    keyframe = np.arange(lengths.sum()) + np.repeat(begins - first_pairs, lengths)
    pairs = np.sort(keyframe << 32 | np.repeat(landmark, lengths))
    check_ascending(pairs, "pairs of keyframe and landmark", part.origin)
    return pairs >> 32, pairs & 0xFFFFFFFF


def _run_begins(landmark: Ids, leaps: Ids, lengths: Ids) -> Ids:
    """Where the runs (R,) of landmarks (R,) begin."""
    is_lead = np.diff(landmark, prepend=-1) != 0
    lead_begins = np.cumsum(leaps[is_lead])
    lengths_before = np.concatenate([[0], lengths[:-1]])[: len(lengths)]
    along = np.cumsum(np.where(is_lead, 0, lengths_before + leaps))  # since the first run of the first landmark
    of_landmark = np.cumsum(is_lead) - 1
    return np.asarray((lead_begins - along[is_lead])[of_landmark] + along)


def _shifts(sigmas: NDArray[np.uint8] | None) -> NDArray[np.int64]:
    """Binary logarithm of the step in millimetres, for each landmark's sigma bytes (2, N)."""
    if sigmas is None:
        return np.zeros(1, np.int64)
    across_mm = SIGMAS_M.values(np.arange(256, dtype=np.uint8)) * MM_PER_M
    table = np.floor(np.log2(across_mm / _STEPS_PER_SIGMA) + 1e-9).clip(_MIN_SHIFT, _MAX_SHIFT).astype(np.int64)
    return np.asarray(table[sigmas[0]])


def _check_ids(ids: Ids, what: str, origin: str) -> None:
    check_indices(ids, MAX_INDEX, what, origin)
    check_ascending(ids, what, origin)


def _zigzag(numbers: Ids) -> NDArray[np.uint64]:
    return ((numbers << 1) ^ (numbers >> 63)).astype(np.uint64)


def _unzigzag(stored: NDArray[np.unsignedinteger]) -> Ids:
    wide = stored.astype(np.uint64)
    return np.asarray((wide >> 1).astype(np.int64) ^ -(wide & 1).astype(np.int64))
