"""The map around a camera: which landmarks it should see, where in the image and on which octave."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap.visual_map import LocalizationMap
from fleetmap_localizer.settings import LocalMapSettings

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Predictions:
    """Landmarks that should be in view."""

    landmarks: Indices  # (L,) indices into the map's landmarks
    pixels: Array  # (L, 2) undistorted pixels
    octaves: NDArray[np.int64]  # (L,) pyramid level they should be found on


class LocalMap:
    """Looks into a map from where a camera stands; ``map_focal_px`` is that of the survey's camera."""

    def __init__(
        self,
        content: LocalizationMap,
        map_focal_px: float,
        camera: Camera,
        octave_count: int,
        scale_factor: float,
        settings: LocalMapSettings,
    ) -> None:
        self._content, self._camera, self._settings = content, camera, settings
        self._octave_count, self._scale_factor = octave_count, scale_factor
        keyframe_ids, landmark_ids = np.arange(len(content.keyframes) + 1), np.arange(len(content.landmarks) + 1)
        self._keyframe_starts = np.searchsorted(content.seen_by_keyframe, keyframe_ids)
        by_landmark = np.argsort(content.seen_landmark, kind="stable")
        self._observers = content.seen_by_keyframe[by_landmark]
        self._landmark_starts = np.searchsorted(content.seen_landmark[by_landmark], landmark_ids)
        self._axes = content.keyframes.rotations[:, :, 2]
        # log2 of the size at which one pixel of the descriptor's octave saw the landmark, in query pixels at 1 m.
        focal_ratio = np.sqrt(camera.fx_px * camera.fy_px) / map_focal_px
        self._sizes = (
            np.log(np.maximum(content.landmarks.distances_m.astype(np.float64), 1e-3) * focal_ratio)
            + np.log(scale_factor) * content.landmarks.octaves
        )

    def landmarks_of(self, keyframes: Indices, max_count: int | None = None) -> Indices:
        """Landmarks (L,) that any of the keyframes saw; at most ``max_count``, those that most of them saw."""
        seen = [
            self._content.seen_landmark[self._keyframe_starts[k] : self._keyframe_starts[k + 1]]
            for k in keyframes.tolist()
        ]
        counts = np.bincount(np.concatenate(seen), minlength=len(self._content.landmarks))
        landmarks = np.flatnonzero(counts)
        if max_count is None or len(landmarks) <= max_count:
            return landmarks
        return np.asarray(landmarks[np.argsort(-counts[landmarks], kind="stable")[:max_count]])

    def covisible(self, keyframe: int, min_shared: int, count: int) -> Indices:
        """At most ``count`` keyframes that share landmarks with this one, the most first; itself not included."""
        seen = self.landmarks_of(np.array([keyframe]))
        observers = [
            self._observers[self._landmark_starts[i] : self._landmark_starts[i + 1]] for i in seen.tolist()
        ]
        shared = np.bincount(np.concatenate(observers), minlength=len(self._axes)) if observers else np.zeros(0)
        shared[keyframe : keyframe + 1] = 0
        order = np.argsort(-shared, kind="stable")[:count]
        return np.asarray(order[shared[order] >= min_shared])

    def landmarks_around(self, map_from_cam: Pose) -> Indices:
        """Landmarks (L,) of the keyframes that stand closest to a pose and look its way."""
        away_m = np.linalg.norm(self._content.keyframes.positions_m - map_from_cam.translation_m, axis=1)
        turn_rad = np.arccos(np.clip(self._axes @ map_from_cam.rotation[:, 2], -1.0, 1.0))
        order = np.argsort(away_m + self._settings.turn_weight_m * turn_rad, kind="stable")
        return self.landmarks_of(order[: self._settings.keyframes])

    def predict(self, landmarks: Indices, map_from_cam: Pose) -> Predictions:
        """Those of the landmarks (L,) that a camera at this pose should see.

        A landmark keeps its size on the road: the octave follows from the ratio of the distances and of the focal
        lengths. Source: Mur-Artal & Tardos, "ORB-SLAM", T-RO 2015, section V-D.
        """
        group = self._content.landmarks
        points_m = group.points_m[landmarks]
        points_in_cam = map_from_cam.inverse().transform(points_m)
        towards_cam = map_from_cam.translation_m - points_m
        distances_m = np.maximum(np.linalg.norm(towards_cam, axis=1), 1e-3)
        cosines = np.einsum("ni,ni->n", towards_cam, group.normals[landmarks]) / distances_m
        octaves = np.rint((self._sizes[landmarks] - np.log(distances_m)) / np.log(self._scale_factor))
        visible = (
            self._camera.is_inside(self._camera.project(points_in_cam))
            & (cosines >= np.cos(np.radians(self._settings.max_viewing_angle_deg)))
            & (octaves >= -1)
            & (octaves <= self._octave_count)
        )
        pixels = self._camera.project_ideal(points_in_cam[visible])
        clipped = np.clip(octaves[visible], 0, self._octave_count - 1).astype(np.int64)
        return Predictions(landmarks[visible], pixels, clipped)
