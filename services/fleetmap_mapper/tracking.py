"""The pose of one frame against landmarks that are already mapped."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Pose
from fleetmap.vision.absolute_pose import (
    AbsolutePose,
    AbsolutePoseSettings,
    estimate_absolute_pose,
    refine_absolute_pose,
)
from fleetmap.vision.features import Features
from fleetmap.vision.matching import match_by_projection, match_descriptors
from fleetmap_mapper.growing_map import SCALE_FACTOR, GrowingMap, Ids, Keyframe
from fleetmap_mapper.settings import TrackingGroup
from fleetmap_mapper.visibility import visible_landmarks

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Tracked:
    """A frame's pose and the landmarks that carry it."""

    vis_from_cam: Pose
    landmarks: Ids  # (n,) inliers
    features: Ids  # (n,) the feature of each


def track(
    growing: GrowingMap, features: Features, predicted: Pose, local: Ids, settings: TrackingGroup
) -> Tracked | None:
    """Project the local landmarks at the predicted pose, match, refine; then once more with a tight window."""
    for widening in (1.0, 3.0):
        coarse = _project_and_refine(
            growing, features, predicted, local, settings.search_radius_px * widening, settings
        )
        if coarse is not None and len(coarse.landmarks) >= settings.min_inliers:
            break
    else:
        return None
    fine = _project_and_refine(growing, features, coarse.vis_from_cam, local, settings.refined_radius_px, settings)
    if fine is None or len(fine.landmarks) < settings.min_inliers:
        return None
    growing.count_sighting(visible_landmarks(growing, local, fine.vis_from_cam)[0], fine.landmarks)
    return fine


def relocalise(
    growing: GrowingMap, features: Features, keyframes: list[Keyframe], settings: TrackingGroup, seed: int
) -> Tracked | None:
    """Match a frame with whole keyframes, without any prediction; the first that holds decides."""
    for keyframe in keyframes:
        seen = np.flatnonzero(keyframe.landmark_of >= 0).astype(np.int32)
        pairs = match_descriptors(
            keyframe.features.descriptors[seen], features.descriptors, settings.max_hamming, 0.8
        )
        if len(pairs) < settings.min_inliers:
            continue
        landmarks, found = keyframe.landmark_of[seen[pairs[:, 0]]], pairs[:, 1]
        pose = estimate_absolute_pose(
            features.pixels[found],
            growing.points[landmarks],
            features.sigmas_px[found],
            growing.camera,
            AbsolutePoseSettings(seed=seed),
        )
        if pose is None or pose.inliers.sum() < settings.min_inliers:
            continue
        neighbours = [k for k, _ in growing.covisible(landmarks)[: settings.local_keyframes]]
        tracked = track(growing, features, pose.map_from_cam, growing.landmarks_of(neighbours), settings)
        if tracked is not None:
            return tracked
    return None


def match_landmarks(
    growing: GrowingMap,
    features: Features,
    vis_from_cam: Pose,
    local: Ids,
    radius_px: float,
    settings: TrackingGroup,
) -> tuple[Ids, Ids]:
    """Landmarks and the features that look like them where they should be; both (n,)."""
    ids, pixels, octaves = visible_landmarks(growing, local, vis_from_cam)
    found = match_by_projection(
        pixels,
        radius_px * SCALE_FACTOR ** octaves.astype(np.float64) * growing.camera.magnification(pixels),
        octaves - 1,
        octaves + 1,
        growing.descriptors[ids],
        features,
        settings.max_hamming,
        settings.match_ratio,
    )
    hit = found >= 0
    return ids[hit], found[hit]


def _project_and_refine(
    growing: GrowingMap,
    features: Features,
    guess: Pose,
    local: Ids,
    radius_px: float,
    settings: TrackingGroup,
) -> Tracked | None:
    landmarks, found = match_landmarks(growing, features, guess, local, radius_px, settings)
    if len(landmarks) < settings.min_inliers:
        return None
    pose: AbsolutePose | None = refine_absolute_pose(
        features.pixels[found], growing.points[landmarks], features.sigmas_px[found], growing.camera, guess
    )
    if pose is None:
        return None
    return Tracked(pose.map_from_cam, landmarks[pose.inliers], found[pose.inliers])
