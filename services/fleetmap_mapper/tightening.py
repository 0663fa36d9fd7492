"""What SLAM leaves is made as exact as its images allow, before any fix is looked at.

SLAM works forward with corners, a window at a time, through the recorded calibration. Once a drive is known whole,
every observation is aligned to a fraction of a pixel, and all poses and landmarks of a segment are adjusted at
once, together with the camera's calibration where the drive contradicts the recorded one: an error of the lens of
a few pixels at the image border is what most of the drift of monocular scale comes from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.geometry import Pose, Sim3
from fleetmap_mapper.calibration_check import CalibrationEstimate, estimate_calibration, is_contradicted
from fleetmap_mapper.calibration_parameters import CalibrationPrior, calibration_prior
from fleetmap_mapper.calibration_refinement import refine_calibration, seen_anew
from fleetmap_mapper.georeferenced_map import pose_frames, problem_of
from fleetmap_mapper.growing_map import GrowingMap, Keyframe
from fleetmap_mapper.observation_noise import with_estimated_noise
from fleetmap_mapper.placed_map import PlacedMap, octaves_of, place, without_outliers
from fleetmap_mapper.settings import CalibrationGroup
from fleetmap_mapper.slam import PosedFrame, Segment
from fleetmap_mapper.stage_times import StageTimes
from fleetmap_mapper.subpixel import align_observations

_TOLERANCES = 1e-3, 1e-5  # of each round; the first only has to tell noise and outliers


@dataclass(frozen=True)
class Tightened:
    """Segments at their visual optimum, all seen through one camera."""

    segments: list[Segment]
    calibration: CalibrationEstimate | None  # the drive's own, where it was asked


def tighten(
    segments: Sequence[Segment],
    frames: Callable[[], Iterator[Frame]],
    settings: CalibrationGroup,
    times: StageTimes,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> Tightened:
    """Bring segments to their visual optimum, all through one camera, the refined one if there is need.

    The longest segment judges the calibration. Growing maps are changed in place.
    """
    recorded = segments[0].growing.camera
    longest_first = sorted(range(len(segments)), key=lambda s: -len(segments[s].posed))
    camera, estimate = recorded, None
    tight: dict[int, Segment] = {}
    for done, number in enumerate(longest_first):
        progress("refining", done, len(segments))
        segment = segments[number]
        with times.stage("aligning patches"):
            placed = place(segment.growing, Sim3.identity())
            aligned = align_observations(placed, octaves_of(placed, segment.growing), frames)
        with times.stage("adjusting images"):
            if done == 0:
                placed = _adjusted_with_calibration(aligned, recorded, settings)
                camera, estimate = placed.camera, placed.calibration
            else:
                placed = _adjusted(_through(aligned, camera), _held(camera, settings))
        tight[number] = _written_back(placed, segment)
    return Tightened([tight[number] for number in range(len(segments))], estimate)


def _adjusted_with_calibration(placed: PlacedMap, recorded: Camera, settings: CalibrationGroup) -> PlacedMap:
    """At the optimum with the calibration free, if it is to be refined; without cause, with the recorded one."""
    if settings.mode == "recorded":
        return _adjusted(placed, _held(recorded, settings))
    refined = _adjusted(placed, calibration_prior(recorded, settings))
    estimate = estimate_calibration(problem_of(refined), settings, recorded)
    if settings.mode == "refined" or is_contradicted(estimate, settings):
        return replace(refined, calibration=estimate)
    held = _adjusted(_through(refined, recorded), _held(recorded, settings))
    return replace(held, calibration=estimate)


def _held(camera: Camera, settings: CalibrationGroup) -> CalibrationPrior:
    return replace(calibration_prior(camera, settings), is_held=True)


def _adjusted(placed: PlacedMap, prior: CalibrationPrior) -> PlacedMap:
    """Rounds of adjustment; after each, noise is estimated and outliers go."""
    for tolerance in _TOLERANCES:
        optimum = refine_calibration(problem_of(placed), prior, tolerance).problem
        placed = replace(
            placed,
            camera=optimum.camera,
            poses=list(optimum.poses),
            points_m=optimum.points_m,
            pixels=optimum.pixels,
        )
        placed = without_outliers(with_estimated_noise(placed))
    return placed


def _through(placed: PlacedMap, camera: Camera) -> PlacedMap:
    return replace(placed, camera=camera, pixels=seen_anew(placed.pixels, placed.camera, camera))


def _written_back(placed: PlacedMap, segment: Segment) -> Segment:
    """The segment with poses, landmarks, pixels, noise and camera of its adjusted map; outliers are forgotten."""
    growing = segment.growing
    before = growing.camera
    frames = pose_frames(placed, growing, segment.posed)
    growing.camera, growing.track_correlation = placed.camera, placed.track_correlation
    growing.points[placed.landmark_ids] = placed.points_m
    for keyframe, pose in zip(growing.keyframes, placed.poses, strict=True):
        keyframe.vis_from_cam = pose
        _renew_observations(growing, keyframe, placed, before)
    dead = np.setdiff1d(growing.landmarks_of(growing.keyframes), placed.landmark_ids).astype(np.int32)
    growing.kill(dead)
    growing.refresh(placed.landmark_ids, growing.keyframes)
    posed = [
        _renewed_frame(frame, pose, before, placed.camera)
        for frame, pose in zip(segment.posed, frames, strict=True)
    ]
    return Segment(growing, posed)


def _renew_observations(growing: GrowingMap, keyframe: Keyframe, placed: PlacedMap, before: Camera) -> None:
    rows = placed.observations_of(keyframe.index)
    features = placed.feature_index[rows]
    pixels = seen_anew(keyframe.features.pixels, before, placed.camera)
    pixels[features] = placed.pixels[rows]
    keyframe.features = replace(keyframe.features, pixels=pixels, camera=placed.camera)
    keyframe.noise[features] = placed.noise[rows]
    keyframe.is_aligned[features] = placed.is_aligned[rows]
    held = np.flatnonzero(keyframe.landmark_of >= 0)
    growing.forget(keyframe, np.setdiff1d(held, features))


def _renewed_frame(frame: PosedFrame, vis_from_cam: Pose, before: Camera, camera: Camera) -> PosedFrame:
    return replace(
        frame,
        keyframe_from_cam=frame.keyframe.vis_from_cam.inverse() @ vis_from_cam,
        pixels=seen_anew(frame.pixels, before, camera),
    )
