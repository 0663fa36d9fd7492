"""The finished SLAM result in the map frame: placed, globally adjusted, and every frame posed again in it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, Sim3, umeyama_alignment
from fleetmap.vision.absolute_pose import refine_absolute_pose
from fleetmap_mapper.calibration_check import CalibrationEstimate, estimate_calibration
from fleetmap_mapper.calibration_parameters import calibration_prior
from fleetmap_mapper.calibration_refinement import refine_calibration, seen_anew
from fleetmap_mapper.georeferencing import GnssTrack, path_at_fixes
from fleetmap_mapper.global_adjustment import FixTerm, GlobalProblem, adjust_globally
from fleetmap_mapper.growing_map import GrowingMap
from fleetmap_mapper.pose_covariances import position_covariances_m2
from fleetmap_mapper.settings import CalibrationGroup
from fleetmap_mapper.slam import PosedFrame
from fleetmap_mapper.triangulation import CHI2_2DOF_95

Array = NDArray[np.float64]
_MIN_OBSERVATIONS = 2
_MAX_DISTANCE_M = 5_000.0  # beyond, a landmark is a direction and not a place
_ROUNDS = 2


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
    sigmas_px: Array  # (M,)
    position_covariances_m2: Array | None = None  # (K, 3, 3) of the final graph; NaN where no fix determines it
    calibration: CalibrationEstimate | None = None  # as the final graph has it


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
    pixels = np.concatenate([k.features.pixels[feature[index == k.index]] for k in growing.keyframes])
    sigmas = np.concatenate([k.features.sigmas_px[feature[index == k.index]] for k in growing.keyframes])
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
        sigmas,
    )


def adjust_with_fixes(
    placed: PlacedMap,
    growing: GrowingMap,
    posed: Sequence[PosedFrame],
    track: GnssTrack,
    level_sigma_deg: float,
    calibration: CalibrationGroup,
    progress: Callable[[str, int, int], None],
) -> PlacedMap:
    """UGBA, twice: the second time without the first one's outliers and with the fixes carried anew."""
    for done in range(_ROUNDS):
        progress("global adjustment", done, _ROUNDS)
        frames = pose_frames(placed, growing, posed)
        problem = GlobalProblem(
            placed.camera,
            placed.poses,
            placed.points_m,
            placed.keyframe_index,
            placed.point_index,
            placed.pixels,
            observation_sigmas(placed),
            carry_fixes(placed, posed, frames, track),
            np.radians(level_sigma_deg),
        )
        if calibration.refine:
            problem = refine_calibration(problem, calibration_prior(growing.camera, calibration)).problem
            placed = replace(placed, camera=problem.camera, pixels=problem.pixels)
        optimum = adjust_globally(problem)
        placed = without_outliers(replace(placed, poses=optimum.poses, points_m=optimum.points_m))
    before = np.array([k.vis_from_cam.translation_m for k in growing.keyframes])
    after = np.array([p.translation_m for p in placed.poses])
    final = replace(problem, poses=optimum.poses, points_m=optimum.points_m)
    return replace(
        placed,
        map_from_vis=umeyama_alignment(before, after),
        calibration=estimate_calibration(final, calibration, growing.camera),
        position_covariances_m2=position_covariances_m2(final),
    )


def observation_sigmas(placed: PlacedMap) -> Array:
    """Sigma (M,) of each observation in a graph that also holds fixes.

    Reprojection errors are common to a whole track (descriptor, calibration, local shape), so a track counts
    as one observation, however often it was seen: each of its n observations gets sqrt(n) times its sigma.
    """
    lengths = np.bincount(placed.point_index, minlength=len(placed.points_m))
    return placed.sigmas_px * np.sqrt(lengths[placed.point_index])


def carry_fixes(
    placed: PlacedMap, posed: Sequence[PosedFrame], frames: Sequence[Pose], track: GnssTrack
) -> list[FixTerm]:
    """Each fix between two posed images, tied to a keyframe by the visual motion in between.

    It is the keyframe that the image before hangs on: the nearest in time may belong to another segment.
    """
    terms = []
    stamps_ns = np.array([p.stamp_ns for p in posed], dtype=np.int64)
    for point in path_at_fixes(stamps_ns, frames, track):
        before = int(np.searchsorted(stamps_ns, track.stamps_ns[point.fix], side="right")) - 1
        keyframe = posed[before].keyframe.index
        cam_from_antenna_time = placed.poses[keyframe].inverse() @ point.pose
        terms.append(
            FixTerm(
                keyframe,
                cam_from_antenna_time.transform(track.antenna_in_cam_m),
                track.positions_m[point.fix],
                track.covariances_m2[point.fix],
            )
        )
    return terms


def pose_frames(placed: PlacedMap, growing: GrowingMap, posed: Sequence[PosedFrame]) -> list[Pose]:
    """``map_from_cam`` of every posed frame in the map as it is now: keyframes as adjusted, others refined."""
    row_of = np.full(growing.landmark_count, -1, np.int32)
    row_of[placed.landmark_ids] = np.arange(len(placed.landmark_ids))
    scale = placed.map_from_vis.scale
    poses = []
    for frame in posed:
        motion = Pose(frame.keyframe_from_cam.rotation, frame.keyframe_from_cam.translation_m * scale)
        guess = placed.poses[frame.keyframe.index] @ motion
        if frame.frame_index == frame.keyframe.frame_index:
            poses.append(placed.poses[frame.keyframe.index])
            continue
        resolved = growing.resolve(frame.landmarks)
        rows = np.where(resolved >= 0, row_of[np.maximum(resolved, 0)], -1)
        known = rows >= 0
        pixels = seen_anew(frame.pixels, growing.camera, placed.camera)
        refined = refine_absolute_pose(
            pixels[known], placed.points_m[rows[known]], frame.sigmas_px[known], placed.camera, guess
        )
        poses.append(guess if refined is None else refined.map_from_cam)
    return poses


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
        sigmas_px=placed.sigmas_px[good],
    )
