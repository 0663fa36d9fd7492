"""A map between SLAM and its package: keyframes, landmarks and observations in one frame, as flat arrays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, Sim3
from fleetmap_mapper.calibration_check import CalibrationEstimate
from fleetmap_mapper.growing_map import GrowingMap
from fleetmap_mapper.triangulation import CHI2_2DOF_95

Array = NDArray[np.float64]
_MIN_OBSERVATIONS = 2
_MAX_DISTANCE_M = 5_000.0  # beyond, a landmark is a direction and not a place


@dataclass(frozen=True)
class PlacedMap:
    """Keyframes, points and observations in the map frame, as flat arrays."""

    camera: Camera
    map_from_vis: Sim3  # from the frame of the growing map it was placed from
    keyframe_stamps_ns: NDArray[np.int64]  # (K,)
    poses: list[Pose]  # K map_from_cam
    landmark_ids: NDArray[np.int32]  # (P,) ids in the growing map, sorted
    points_m: Array  # (P, 3) in map
    keyframe_index: NDArray[np.int32]  # (M,) sorted
    point_index: NDArray[np.int32]  # (M,)
    feature_index: NDArray[np.int32]  # (M,) feature of the keyframe
    pixels: Array  # (M, 2) undistorted
    corner_sigmas_px: Array  # (M,) one pixel of the octave that the feature was found on, as undistorted
    noise: Array  # (M,) how exact the observation is, against that
    is_aligned: NDArray[np.bool_]  # (M,) whether the pixel comes from aligning patches, or is a corner's
    track_correlation: float = 0.0  # of errors from one observation of a landmark to the next
    # (K, 6, 6) of the final graph, see fleetmap_mapper.pose_covariances; NaN where no fix determines it
    pose_covariances: Array | None = None
    calibration: CalibrationEstimate | None = None  # as the final graph has it

    @property
    def sigmas_px(self) -> Array:
        """Sigma of each observation (M,)."""
        return self.corner_sigmas_px * self.noise

    @property
    def position_covariances_m2(self) -> Array:
        """Covariances (K, 3, 3) of the camera centres, in map; NaN where they are not known."""
        if self.pose_covariances is None:
            return np.full((len(self.poses), 3, 3), np.nan)
        rotations = np.array([pose.rotation for pose in self.poses])
        in_map: Array = rotations @ self.pose_covariances[:, 3:, 3:] @ rotations.transpose(0, 2, 1)
        return (in_map + in_map.transpose(0, 2, 1)) / 2.0

    def observations_of(self, keyframe: int) -> slice:
        """Where the observations of one keyframe stand."""
        return slice(*np.searchsorted(self.keyframe_index, [keyframe, keyframe + 1]).tolist())


def place(growing: GrowingMap, map_from_vis: Sim3) -> PlacedMap:
    """The growing map as it stands, moved by S; landmarks seen once, or all but infinitely far, stay behind."""
    keyframes, landmarks, features = [], [], []
    for keyframe in growing.keyframes:
        rows = np.flatnonzero(keyframe.landmark_of >= 0)
        keyframes.append(np.full(len(rows), keyframe.index, np.int32))
        landmarks.append(keyframe.landmark_of[rows])
        features.append(rows.astype(np.int32))
    seen, index, feature = np.concatenate(landmarks), np.concatenate(keyframes), np.concatenate(features)
    centres = np.array([k.vis_from_cam.translation_m for k in growing.keyframes])
    distances_m = map_from_vis.scale * np.linalg.norm(growing.points[seen] - centres[index], axis=1)
    near = distances_m < _MAX_DISTANCE_M
    seen, index, feature = seen[near], index[near], feature[near]
    often = np.bincount(seen, minlength=growing.landmark_count)[seen] >= _MIN_OBSERVATIONS
    seen, index, feature = seen[often], index[often], feature[often]
    ids, point_index = np.unique(seen, return_inverse=True)
    starts = np.searchsorted(index, np.arange(1, len(growing.keyframes)))
    own = list(zip(growing.keyframes, np.split(feature, starts), strict=True))
    pixels = np.concatenate([k.features.pixels[rows] for k, rows in own])
    return PlacedMap(
        growing.camera,
        map_from_vis,
        np.array([k.stamp_ns for k in growing.keyframes], dtype=np.int64),
        [map_from_vis.transform_pose(k.vis_from_cam) for k in growing.keyframes],
        ids.astype(np.int32),
        map_from_vis.transform(growing.points[ids]),
        index,
        point_index.astype(np.int32),
        feature,
        pixels,
        np.concatenate([k.features.sigmas_px[rows] for k, rows in own]),
        np.concatenate([k.noise[rows] for k, rows in own]),
        np.concatenate([k.is_aligned[rows] for k, rows in own]),
        growing.track_correlation,
    )


def octaves_of(placed: PlacedMap, growing: GrowingMap) -> NDArray[np.uint8]:
    """The pyramid level that each observation (M,) was found on."""
    return np.concatenate(
        [k.features.octaves[placed.feature_index[placed.observations_of(k.index)]] for k in growing.keyframes]
    )


def reprojection_errors_px(placed: PlacedMap) -> Array:
    """Errors (M, 2) of all observations; NaN behind the camera."""
    rotations = np.array([p.rotation.T for p in placed.poses])
    centres = np.array([p.translation_m for p in placed.poses])
    k = placed.keyframe_index
    in_cam = np.einsum("mij,mj->mi", rotations[k], placed.points_m[placed.point_index] - centres[k])
    return placed.camera.project_ideal(in_cam) - placed.pixels


def without_outliers(placed: PlacedMap) -> PlacedMap:
    """Drop observations beyond 95 %, and points that keep fewer than two."""
    chi2 = (reprojection_errors_px(placed) ** 2).sum(axis=1) / placed.sigmas_px**2
    with np.errstate(invalid="ignore"):
        good = chi2 < CHI2_2DOF_95
    counts = np.bincount(placed.point_index[good], minlength=len(placed.points_m))
    good &= counts[placed.point_index] >= _MIN_OBSERVATIONS
    kept, point_index = np.unique(placed.point_index[good], return_inverse=True)
    return replace(
        placed,
        landmark_ids=placed.landmark_ids[kept],
        points_m=placed.points_m[kept],
        keyframe_index=placed.keyframe_index[good],
        point_index=point_index.astype(np.int32),
        feature_index=placed.feature_index[good],
        pixels=placed.pixels[good],
        corner_sigmas_px=placed.corner_sigmas_px[good],
        noise=placed.noise[good],
        is_aligned=placed.is_aligned[good],
    )
