"""The "full" part of a map package: all of a VisualMap, without loss, for mapping on. Localizers never fetch it.

Poses and points stay float64 in the map frame; anchor, S and camera stand in the manifest.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import MapPackageError
from fleetmap.geodesy import UtmAnchor
from fleetmap.manifest import Manifest
from fleetmap.parts import Part, decode_part, encode_part
from fleetmap.visual_map import Keyframes, Landmarks, Observations, VisualMap

# name -> (dtype on disk, group of VisualMap and its length, field, shape of one row)
_COLUMNS: dict[str, tuple[str, str, str, tuple[int, ...]]] = {
    "keyframe_stamps_ns": ("<i8", "keyframes", "stamps_ns", ()),
    "keyframe_rotations": ("<f8", "keyframes", "rotations", (3, 3)),
    "keyframe_positions_m": ("<f8", "keyframes", "positions_m", (3,)),
    "landmark_points_m": ("<f8", "landmarks", "points_m", (3,)),
    "landmark_descriptors": ("|u1", "landmarks", "descriptors", (32,)),
    "landmark_normals": ("<f4", "landmarks", "normals", (3,)),
    "landmark_octaves": ("|u1", "landmarks", "octaves", ()),
    "landmark_distances_m": ("<f4", "landmarks", "distances_m", ()),
    "observation_keyframe_index": ("<i4", "observations", "keyframe_index", ()),
    "observation_landmark_index": ("<i4", "observations", "landmark_index", ()),
    "observation_pixels": ("<f4", "observations", "pixels", (2,)),
    "observation_octaves": ("|u1", "observations", "octaves", ()),
}
_COVARIANCES, _IS_DETERMINED = "keyframe_covariances", "keyframe_is_determined"  # since format 2
_ANGLES = "landmark_angles_deg"  # since format 2.1
_ROWS, _ROW_ENDS = np.triu_indices(6)
_ORTHONORMAL_TOLERANCE = 1e-6
_LEAST_VARIANCE = 1e-30
MAX_EXTENT_M = 1e6  # from the anchor, along each axis; millimetres from any cell of the map fit an int32


def encode_full(visual_map: VisualMap) -> bytes:
    """The full part of a map."""
    arrays = {
        name: np.asarray(getattr(getattr(visual_map, group), field)).astype(dtype, casting="same_kind")
        for name, (dtype, group, field, _) in _COLUMNS.items()
    }
    covariances = visual_map.keyframes.covariances
    if covariances is not None:
        determined = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
        arrays[_IS_DETERMINED] = determined.astype("|u1")
        arrays[_COVARIANCES] = np.where(determined[:, None], covariances[:, _ROWS, _ROW_ENDS], 0.0).astype("<f4")
    if visual_map.landmarks.angles_deg is not None:
        arrays[_ANGLES] = visual_map.landmarks.angles_deg.astype("<f4")
    return encode_part("full", full_attributes(visual_map.anchor), arrays)


def decode_full(data: bytes, manifest: Manifest, origin: str) -> VisualMap:
    """The map of a full part; ``origin`` says in messages where it came from.

    Raises:
        MapPackageError: the part is malformed, or belongs to another map than the manifest.
    """
    part = decode_part(data, origin)
    anchor = manifest.anchor.to_anchor()
    wanted = full_attributes(anchor)
    if part.kind != "full" or {key: part.attributes.get(key) for key in wanted} != wanted:
        raise MapPackageError(f"{origin} is not the full part of a map anchored at {anchor}")
    groups: dict[str, dict[str, NDArray[Any]]] = {"keyframes": {}, "landmarks": {}, "observations": {}}
    for name, (dtype, group, field, row) in _COLUMNS.items():
        groups[group][field] = part.array(name, dtype, (None, *row))
    angles_deg = part.array(_ANGLES, "<f4", (None,)) if _ANGLES in part else None
    visual_map = VisualMap(
        anchor,
        manifest.map_from_vis.to_sim3(),
        manifest.camera.to_camera(),
        Keyframes(**groups["keyframes"], covariances=_read_covariances(part)),
        Landmarks(**groups["landmarks"], angles_deg=angles_deg),
        Observations(**groups["observations"]),
    )
    check_visual_map(visual_map, origin)
    return visual_map


def _read_covariances(part: Part) -> NDArray[np.float32] | None:
    """``Keyframes.covariances``; a map whose writer does not know them has none."""
    if _COVARIANCES not in part:
        return None
    triangles = part.array(_COVARIANCES, "<f4", (None, len(_ROWS)))
    covariances = np.empty((len(triangles), 6, 6), np.float32)
    covariances[:, _ROWS, _ROW_ENDS] = covariances[:, _ROW_ENDS, _ROWS] = triangles
    covariances[part.array(_IS_DETERMINED, "|u1", (len(triangles),)) == 0] = np.nan
    return covariances


def full_attributes(anchor: UtmAnchor) -> dict[str, Any]:
    """What the header of a full part says about its frame."""
    return {"epsg": anchor.epsg, "anchor_m": [anchor.easting_m, anchor.northing_m, anchor.height_m]}


def check_visual_map(visual_map: VisualMap, origin: str) -> None:
    """Hold a map against what visual_map.py promises: parallel, finite arrays, indices in range and sorted.

    Raises:
        MapPackageError: what does not hold.
    """
    for name, (dtype, group, field, row) in _COLUMNS.items():
        rows, values = len(getattr(visual_map, group)), getattr(getattr(visual_map, group), field)
        if values.shape != (rows, *row):
            raise MapPackageError(f"{origin}: '{name}' has shape {values.shape} instead of {(rows, *row)}")
        if dtype[1] == "f" and not np.isfinite(values).all():
            raise MapPackageError(f"{origin}: '{name}' holds numbers that are not finite")
    for points_m, what in (
        (visual_map.keyframes.positions_m, "keyframe"),
        (visual_map.landmarks.points_m, "landmark"),
    ):
        if (np.abs(points_m) > MAX_EXTENT_M).any():
            raise MapPackageError(f"{origin}: a {what} lies more than 1,000 km from the map's anchor")
    angles_deg, shape = visual_map.landmarks.angles_deg, (len(visual_map.landmarks),)
    if angles_deg is not None and not (angles_deg.shape == shape and np.isfinite(angles_deg).all()):
        raise MapPackageError(f"{origin}: '{_ANGLES}' is not one finite number for each landmark")
    check_rotations(visual_map.keyframes.rotations, origin)
    check_covariances(visual_map.keyframes.covariances, len(visual_map.keyframes), origin)
    observations = visual_map.observations
    check_indices(observations.keyframe_index, len(visual_map.keyframes), "observed keyframes", origin)
    check_indices(observations.landmark_index, len(visual_map.landmarks), "observed landmarks", origin)
    if (np.diff(observations.keyframe_index) < 0).any():
        raise MapPackageError(f"{origin}: observations are not sorted by keyframe")
    check_ascending(visual_map.keyframes.stamps_ns, "keyframe stamps", origin)
    if (visual_map.landmarks.distances_m < 0.0).any():
        raise MapPackageError(f"{origin}: landmarks were seen from a negative distance")


def check_rotations(rotations: NDArray[np.float64], origin: str) -> None:
    """Refuse matrices (K, 3, 3) that are no rotations."""
    if (np.abs(rotations) > 2.0).any():
        raise MapPackageError(f"{origin}: keyframe orientations are no rotations")
    gram = rotations @ rotations.transpose(0, 2, 1)
    if not (np.abs(gram - np.eye(3)) < _ORTHONORMAL_TOLERANCE).all() or (np.linalg.det(rotations) < 0.0).any():
        raise MapPackageError(f"{origin}: keyframe orientations are no rotations")


def check_covariances(covariances: NDArray[np.float32] | None, count: int, origin: str) -> None:
    """Refuse what are no covariances (K, 6, 6) of ``count`` keyframes; those that are NaN are not known."""
    if covariances is None:
        return
    if covariances.shape != (count, 6, 6):
        raise MapPackageError(f"{origin}: covariances have shape {covariances.shape} instead of {(count, 6, 6)}")
    known = covariances[~np.isnan(covariances).all(axis=(1, 2))].astype(np.float64)
    sigmas = np.sqrt(np.diagonal(known, axis1=1, axis2=2).clip(_LEAST_VARIANCE))
    correlations = known / sigmas[:, :, None] / sigmas[:, None, :]
    if not np.isfinite(correlations).all() or (len(known) and np.linalg.eigvalsh(correlations).min() < -1e-3):
        raise MapPackageError(f"{origin}: the covariance of a keyframe is none")


def check_indices(indices: NDArray[Any], count: int, what: str, origin: str) -> None:
    """Refuse indices outside [0, count)."""
    if len(indices) and (int(indices.min()) < 0 or int(indices.max()) >= count):
        raise MapPackageError(f"{origin}: {what} lie outside the {count} there are")


def check_ascending(numbers: NDArray[np.int64], what: str, origin: str) -> None:
    """Refuse numbers of which one is not greater than the one before; differences could overflow."""
    if (numbers[1:] <= numbers[:-1]).any():
        raise MapPackageError(f"{origin}: {what} are not ascending")
