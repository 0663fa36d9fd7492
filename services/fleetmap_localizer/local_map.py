"""The map around a camera: which landmarks it should see, where in the image and on which octave."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
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
        self._intrinsics = np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px])
        # log2 of the size at which one pixel of the descriptor's octave saw the landmark, in query pixels at 1 m.
        focal_ratio = np.sqrt(camera.fx_px * camera.fy_px) / map_focal_px
        self._sizes = (
            np.log(np.maximum(content.landmarks.distances_m.astype(np.float64), 1e-3) * focal_ratio)
            + np.log(scale_factor) * content.landmarks.octaves
        )

    def landmarks_of(self, keyframes: Indices, max_count: int | None = None) -> Indices:
        """Landmarks (L,) that any of the keyframes saw; at most ``max_count``, those that most of them saw."""
        counts = _tally(
            keyframes, self._keyframe_starts, self._content.seen_landmark, len(self._content.landmarks)
        )
        landmarks = np.flatnonzero(counts)
        if max_count is None or len(landmarks) <= max_count:
            return landmarks
        return np.asarray(landmarks[np.argsort(-counts[landmarks], kind="stable")[:max_count]])

    def covisible(self, keyframe: int, min_shared: int, count: int) -> Indices:
        """At most ``count`` keyframes that share landmarks with this one, the most first; itself not included."""
        seen = self._content.seen_landmark[self._keyframe_starts[keyframe] : self._keyframe_starts[keyframe + 1]]
        shared = _tally(seen, self._landmark_starts, self._observers, len(self._axes))
        shared[keyframe] = 0
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
        facing, pixels, octaves = _face_to_face(
            landmarks,
            group.points_m,
            group.normals,
            self._sizes,
            map_from_cam.rotation,
            map_from_cam.translation_m,
            self._intrinsics,
            np.cos(np.radians(self._settings.max_viewing_angle_deg)),
            np.log(self._scale_factor),
            self._octave_count,
        )
        inside = self._camera.is_inside(self._camera.distort(pixels))
        return Predictions(facing[inside], pixels[inside], octaves[inside])


@njit(cache=True, nogil=True)
def _tally(rows, starts, members, member_count):  # type: ignore[no-untyped-def]
    """How often each member (M,) occurs in some rows of a table; row r is members[starts[r]:starts[r + 1]]."""
    counts = np.zeros(member_count, np.int64)
    for row in rows:
        for slot in range(starts[row], starts[row + 1]):
            counts[members[slot]] += 1
    return counts


@njit(cache=True, nogil=True)
def _face_to_face(  # type: ignore[no-untyped-def]
    landmarks, points, normals, sizes, rotation, centre, intrinsics, min_cosine, log_scale, octave_count
):
    """Landmarks (F,) in front of the camera that turn their face to it, at a size that the pyramid has.

    Beside them their undistorted pixels (F, 2), wherever those lie, and octaves (F,). One octave finer or coarser
    than the pyramid goes: the prediction is that uncertain.
    """
    facing, octaves = np.empty(len(landmarks), np.int64), np.empty(len(landmarks), np.int64)
    pixels = np.empty((len(landmarks), 2))
    R = rotation
    fx, fy, cx, cy = intrinsics
    count = 0
    for landmark in landmarks:
        dx, dy = points[landmark, 0] - centre[0], points[landmark, 1] - centre[1]
        dz = points[landmark, 2] - centre[2]
        z = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
        distance = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-3)
        towards = -(dx * normals[landmark, 0] + dy * normals[landmark, 1] + dz * normals[landmark, 2])
        if not (z > 1e-6 and towards >= min_cosine * distance):
            continue
        octave = np.rint((sizes[landmark] - np.log(distance)) / log_scale)
        if not -1.0 <= octave <= octave_count:
            continue
        facing[count], octaves[count] = landmark, min(max(octave, 0.0), octave_count - 1.0)
        pixels[count, 0] = fx * (R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz) / z + cx
        pixels[count, 1] = fy * (R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz) / z + cy
        count += 1
    return facing[:count], pixels[:count], octaves[:count]
