"""The placed map adjusted with its fixes, and every frame posed again in it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, umeyama_alignment
from fleetmap.vision.absolute_pose import refine_absolute_pose
from fleetmap_mapper.calibration_check import estimate_calibration
from fleetmap_mapper.calibration_parameters import calibration_prior
from fleetmap_mapper.calibration_refinement import refine_calibration, seen_anew
from fleetmap_mapper.fix_terms import FixTerm
from fleetmap_mapper.georeferencing import GnssTrack, path_at_fixes
from fleetmap_mapper.global_adjustment import GlobalProblem, adjust_globally
from fleetmap_mapper.growing_map import GrowingMap
from fleetmap_mapper.observation_noise import observation_sigmas
from fleetmap_mapper.placed_map import PlacedMap, without_outliers
from fleetmap_mapper.pose_covariances import pose_covariances
from fleetmap_mapper.settings import CalibrationGroup
from fleetmap_mapper.slam import PosedFrame
from fleetmap_mapper.stage_times import StageTimes

Array = NDArray[np.float64]
_ROUNDS = 2
_TOLERANCE = 1e-5


def adjust_with_fixes(
    placed: PlacedMap,
    growing: GrowingMap,
    posed: Sequence[PosedFrame],
    track: GnssTrack,
    level_sigma_deg: float,
    recorded: Camera,
    calibration: CalibrationGroup,
    times: StageTimes,
    progress: Callable[[str, int, int], None],
) -> PlacedMap:
    """UGBA, twice: the second time without the first one's outliers and with the fixes carried anew.

    The bordered solver takes the map to its optimum; where it is not made with the ``recorded`` calibration, along
    with its own. The whole graph in GTSAM has the last word.
    """
    prior = calibration_prior(recorded, calibration)
    prior = replace(prior, is_held=placed.camera == recorded)
    for done in range(_ROUNDS):
        progress("global adjustment", done, _ROUNDS)
        fixes = carry_fixes(placed, posed, pose_frames(placed, growing, posed), track)
        problem = problem_of(placed, fixes, np.radians(level_sigma_deg))
        with times.stage("adjusting with fixes"):
            problem = refine_calibration(problem, prior, _TOLERANCE).problem
        if done == _ROUNDS - 1:
            with times.stage("adjusting in GTSAM"):
                optimum = adjust_globally(problem)
            problem = replace(problem, poses=optimum.poses, points_m=optimum.points_m)
        placed = without_outliers(
            replace(
                placed,
                camera=problem.camera,
                pixels=problem.pixels,
                poses=list(problem.poses),
                points_m=problem.points_m,
            )
        )
    before = np.array([k.vis_from_cam.translation_m for k in growing.keyframes])
    after = np.array([p.translation_m for p in placed.poses])
    return replace(
        placed,
        map_from_vis=umeyama_alignment(before, after),
        calibration=estimate_calibration(problem, calibration, recorded),
        pose_covariances=pose_covariances(problem),
    )


def problem_of(placed: PlacedMap, fixes: Sequence[FixTerm] = (), level_sigma_rad: float = np.inf) -> GlobalProblem:
    """All that is to be adjusted; without fixes and with no idea of "down", a matter of images alone."""
    return GlobalProblem(
        placed.camera,
        placed.poses,
        placed.points_m,
        placed.keyframe_index,
        placed.point_index,
        placed.pixels,
        observation_sigmas(placed),
        fixes,
        level_sigma_rad,
    )


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
