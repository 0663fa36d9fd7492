"""The "quality" part of a map package: fleetmap.road_quality as arrays. Only people and their reports fetch it."""

from __future__ import annotations

import numpy as np

from fleetmap.errors import MapPackageError
from fleetmap.full_part import MAX_EXTENT_M, check_ascending, full_attributes
from fleetmap.geodesy import UtmAnchor
from fleetmap.parts import Part, decode_part, encode_part
from fleetmap.road_quality import Array, FixQuality, KeyframeQuality, RoadQuality

MAX_QUALITY_BYTES = 256 * 1024 * 1024  # inflated; two million keyframes
_ROWS, _COLUMNS = np.triu_indices(3)


def encode_quality(quality: RoadQuality, anchor: UtmAnchor) -> bytes:
    """The quality part of a map; the same quality gives the same bytes.

    Raises:
        MapPackageError: it exceeds MAX_QUALITY_BYTES.
    """
    keyframes, fixes = quality.keyframes, quality.fixes
    determined = np.asarray(np.isfinite(keyframes.covariances_m2).all(axis=(1, 2)))
    triangles = np.where(determined[:, None], keyframes.covariances_m2[:, _ROWS, _COLUMNS], 0.0)
    arrays = {
        "keyframe_stamps_ns": keyframes.stamps_ns.astype("<i8"),
        "keyframe_along_m": keyframes.along_m.astype("<f8"),
        "keyframe_positions_m": keyframes.positions_m.astype("<f8"),
        "keyframe_is_determined": determined.astype("|u1"),
        "keyframe_covariances_m2": triangles.astype("<f4"),  # upper triangle: ee, en, eu, nn, nu, uu
        "keyframe_reprojection_rms_px": keyframes.reprojection_rms_px.astype("<f4"),
        "keyframe_landmarks": keyframes.landmarks.astype("<i4"),
        "fix_stamps_ns": fixes.stamps_ns.astype("<i8"),
        "fix_along_m": fixes.along_m.astype("<f8"),
        "fix_residuals_m": fixes.residuals_m.astype("<f4"),
        "fix_sigmas": fixes.sigmas.astype("<f4"),
        "fix_claimed_sigmas_m": fixes.claimed_sigmas_m.astype("<f4"),
        "step_edges_m": quality.edges_m.astype("<f8"),
        "step_landmarks_per_m": quality.landmarks_per_m.astype("<f4"),
        "gap_stamps_ns": quality.gap_stamps_ns.astype("<i8"),
        "gap_along_m": quality.gaps_m.astype("<f8"),
    }
    return encode_part("quality", full_attributes(anchor), arrays, MAX_QUALITY_BYTES)


def decode_quality(data: bytes, anchor: UtmAnchor, origin: str) -> RoadQuality:
    """The quality in a part of a map; ``origin`` says in messages where it came from.

    Raises:
        MapPackageError: the part is malformed, or belongs to a map with another anchor.
    """
    part = decode_part(data, origin, MAX_QUALITY_BYTES)
    wanted = full_attributes(anchor)
    if part.kind != "quality" or {key: part.attributes.get(key) for key in wanted} != wanted:
        raise MapPackageError(f"{origin} is not the quality part of a map anchored at {anchor}")
    edges_m = part.array("step_edges_m", "<f8", (None,))
    gap_stamps_ns = part.array("gap_stamps_ns", "<i8", (None, 2))
    quality = RoadQuality(
        _read_keyframes(part),
        _read_fixes(part),
        edges_m,
        part.array("step_landmarks_per_m", "<f4", (max(len(edges_m) - 1, 0),)),
        gap_stamps_ns,
        part.array("gap_along_m", "<f8", (len(gap_stamps_ns), 2)),
    )
    if len(edges_m) < 2 or edges_m[0] != 0.0 or (np.diff(edges_m) <= 0.0).any():
        raise MapPackageError(f"{origin}: the steps of the road do not ascend from 0")
    for along_m in (quality.keyframes.along_m, quality.fixes.along_m, quality.gaps_m.ravel()):
        _check_along(along_m, float(edges_m[-1]), origin)
    check_ascending(quality.keyframes.stamps_ns, "keyframe stamps", origin)
    return quality


def _read_keyframes(part: Part) -> KeyframeQuality:
    stamps_ns = part.array("keyframe_stamps_ns", "<i8", (None,))
    count = len(stamps_ns)
    covariances_m2 = np.empty((count, 3, 3), np.float32)
    triangles = part.array("keyframe_covariances_m2", "<f4", (count, len(_ROWS)))
    covariances_m2[:, _ROWS, _COLUMNS] = covariances_m2[:, _COLUMNS, _ROWS] = triangles
    if (np.diagonal(covariances_m2, axis1=1, axis2=2) < 0.0).any():
        raise MapPackageError(f"{part.origin}: a position's variance is negative")
    covariances_m2[part.array("keyframe_is_determined", "|u1", (count,)) == 0] = np.nan
    positions_m = part.array("keyframe_positions_m", "<f8", (count, 3))
    if (np.abs(positions_m) > MAX_EXTENT_M).any():
        raise MapPackageError(f"{part.origin}: a keyframe lies more than 1,000 km from the map's anchor")
    return KeyframeQuality(
        stamps_ns,
        part.array("keyframe_along_m", "<f8", (count,)),
        positions_m,
        covariances_m2,
        part.array("keyframe_reprojection_rms_px", "<f4", (count,)),
        part.array("keyframe_landmarks", "<i4", (count,)),
    )


def _read_fixes(part: Part) -> FixQuality:
    stamps_ns = part.array("fix_stamps_ns", "<i8", (None,))
    count = len(stamps_ns)
    return FixQuality(
        stamps_ns,
        part.array("fix_along_m", "<f8", (count,)),
        part.array("fix_residuals_m", "<f4", (count, 3)),
        part.array("fix_sigmas", "<f4", (count,)),
        part.array("fix_claimed_sigmas_m", "<f4", (count,)),
    )


def _check_along(along_m: Array, length_m: float, origin: str) -> None:
    if ((along_m < 0.0) | (along_m > length_m)).any():
        raise MapPackageError(f"{origin}: something lies beside the {length_m:.1f} m of road that it is about")
