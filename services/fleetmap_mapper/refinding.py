"""Landmarks found again: from another segment, or on a road that is driven twice.

Each keyframe looks for the landmarks of keyframes that stand near it and look the same way, but share nothing with
it. What it finds must agree on one pose, near the one it has, and the shift between the two must be that of its
neighbours in time: houses repeat, and one keyframe alone can be fooled. Only then do landmarks become one.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Pose, rotation_angle_rad
from fleetmap.vision.absolute_pose import AbsolutePoseSettings, estimate_absolute_pose
from fleetmap_mapper.growing_map import GrowingMap, Ids, Keyframe
from fleetmap_mapper.local_mapping import median_depth
from fleetmap_mapper.settings import MapperSettings
from fleetmap_mapper.tracking import match_landmarks

Array = NDArray[np.float64]

_APART = 20  # keyframes of one segment less far apart than this have had their chance while mapping
_REACH_TO_DEPTH = 1.0  # how near another keyframe must stand, against the depth of what is seen
_MAX_HEADING_RAD = np.radians(45.0)
_CANDIDATES = 3
_SEARCH_RADII_PX = (15.0, 45.0)  # fixes place a map to a metre or better
_MIN_INLIERS = 30
_MIN_INLIER_SHARE = 0.4
_MAX_SHIFT_M, _MAX_TURN_RAD = 5.0, np.radians(10.0)  # from where the fixes have a keyframe
_NEIGHBOURS, _MIN_AGREEING = 3, 2  # of so many keyframes before and after, so many must say the same
_AGREEMENT_M, _AGREEMENT_RAD = 0.5, np.radians(2.0)


@dataclass(frozen=True)
class Refound:
    """What one keyframe sees again."""

    keyframe: Keyframe
    shift: Pose  # cam_from_cam: from the pose it has to the one that the landmarks say
    landmarks: Ids  # (n,)
    features: NDArray[np.integer]  # (n,)


def tie_what_is_refound(
    growing: GrowingMap, segment_of: NDArray[np.intp], settings: MapperSettings
) -> list[Refound]:
    """Fuse what keyframes of a placed map, in metres, see again; returns what was believed.

    ``segment_of`` (K,) tells the segment of each keyframe. Poses and points stay; the joint adjustment moves them.
    """
    found = list(_refound(growing, segment_of, settings))
    believed = [r for r in found if _is_confirmed(r, found)]
    for refound in believed:
        _fuse(growing, refound)
    return believed


def _refound(growing: GrowingMap, segment_of: NDArray[np.intp], settings: MapperSettings) -> Iterator[Refound]:
    centres = np.array([k.vis_from_cam.translation_m for k in growing.keyframes])
    headings = np.array([k.vis_from_cam.rotation[:, 2] for k in growing.keyframes])
    order = np.arange(len(centres))
    for keyframe in growing.keyframes:
        k = keyframe.index
        distances_m = np.linalg.norm(centres - centres[k], axis=1)
        is_near = (distances_m < _REACH_TO_DEPTH * median_depth(growing, keyframe)) & (
            headings @ headings[k] > np.cos(_MAX_HEADING_RAD)
        )
        is_foreign = (segment_of != segment_of[k]) | (np.abs(order - k) >= _APART)
        candidates = np.flatnonzero(is_near & is_foreign)
        if len(candidates) == 0:
            continue
        nearest = candidates[np.argsort(distances_m[candidates], kind="stable")[:_CANDIDATES]]
        others = [growing.keyframes[c] for c in nearest]
        refound = find_again(
            growing, keyframe, growing.not_seen_by(keyframe, growing.landmarks_of(others)), settings
        )
        if refound is not None:
            yield refound


def find_again(
    growing: GrowingMap, keyframe: Keyframe, landmarks: Ids, settings: MapperSettings
) -> Refound | None:
    """Landmarks that a keyframe sees from a pose near its own, if enough of them agree on it."""
    features, tracking = keyframe.features, settings.tracking
    for radius_px in _SEARCH_RADII_PX:
        ids, rows = match_landmarks(growing, features, keyframe.vis_from_cam, landmarks, radius_px, tracking)
        if len(ids) < _MIN_INLIERS:
            continue
        pose = estimate_absolute_pose(
            features.pixels[rows],
            growing.points[ids],
            features.sigmas_px[rows],
            growing.camera,
            AbsolutePoseSettings(min_inliers=_MIN_INLIERS // 2, seed=settings.seed),
        )
        if pose is None:
            continue
        shift = keyframe.vis_from_cam.inverse() @ pose.map_from_cam
        if not _is_small(shift, _MAX_SHIFT_M, _MAX_TURN_RAD):
            continue
        ids, rows = match_landmarks(
            growing, features, pose.map_from_cam, landmarks, tracking.refined_radius_px, tracking
        )
        errors_px = np.linalg.norm(
            growing.camera.project_ideal(pose.map_from_cam.inverse().transform(growing.points[ids]))
            - features.pixels[rows],
            axis=1,
        )
        fits = errors_px < 2.4477 * features.sigmas_px[rows]
        if fits.sum() >= max(_MIN_INLIERS, _MIN_INLIER_SHARE * len(ids)):
            return Refound(keyframe, shift, ids[fits], rows[fits])
    return None


def _is_confirmed(refound: Refound, found: Sequence[Refound]) -> bool:
    """Whether neighbours in time were shifted in the same way."""
    near = (r for r in found if 0 < abs(r.keyframe.index - refound.keyframe.index) <= _NEIGHBOURS)
    agreeing = (r for r in near if _is_small(refound.shift.inverse() @ r.shift, _AGREEMENT_M, _AGREEMENT_RAD))
    return len(list(itertools.islice(agreeing, _MIN_AGREEING))) == _MIN_AGREEING


def _is_small(shift: Pose, max_m: float, max_rad: float) -> bool:
    return bool(
        np.linalg.norm(shift.translation_m) <= max_m and float(rotation_angle_rad(shift.rotation)) <= max_rad
    )


def _fuse(growing: GrowingMap, refound: Refound) -> None:
    landmarks = growing.resolve(refound.landmarks)
    keyframe = refound.keyframe
    held = keyframe.landmark_of[refound.features]
    is_new = (landmarks >= 0) & ~np.isin(landmarks, keyframe.landmarks())
    _, first = np.unique(landmarks, return_index=True)
    is_first = np.isin(np.arange(len(landmarks)), first)
    free = is_new & is_first & (held < 0)
    growing.observe(keyframe, refound.features[free], landmarks[free])
    double = (landmarks >= 0) & (held >= 0) & (held != landmarks)
    if np.any(double):
        growing.merge(held[double], landmarks[double])
