"""Segments of one drive, each in a free-scale frame of its own, joined in the map frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fleetmap.geometry import Pose, Sim3
from fleetmap_mapper.growing_map import GrowingMap, Ids, Keyframe
from fleetmap_mapper.slam import PosedFrame, Segment


def join_segments(segments: Sequence[Segment], map_from_vis: Sequence[Sim3]) -> Segment:
    """One segment in the map frame that holds all keyframes, landmarks and frames.

    A frame that two segments could pose stays with the one that saw more landmarks in it.
    """
    joined = GrowingMap(segments[0].growing.camera)
    joined.track_correlation = max(s.growing.track_correlation for s in segments)
    posed: dict[int, PosedFrame] = {}
    for segment, S in zip(segments, map_from_vis, strict=True):
        keyframe_offset, landmark_offset = len(joined.keyframes), joined.landmark_count
        _append_landmarks(joined, segment.growing, S, keyframe_offset)
        joined.keyframes += [
            _moved_keyframe(k, S, keyframe_offset, landmark_offset) for k in segment.growing.keyframes
        ]
        for frame in segment.posed:
            moved = _moved_frame(frame, segment.growing, S, joined.keyframes[keyframe_offset:], landmark_offset)
            rival = posed.get(frame.frame_index)
            if rival is None or len(moved.landmarks) > len(rival.landmarks):
                posed[frame.frame_index] = moved
    return Segment(joined, [posed[index] for index in sorted(posed)])


def _append_landmarks(joined: GrowingMap, growing: GrowingMap, S: Sim3, keyframe_offset: int) -> None:
    first, count = joined.landmark_count, growing.landmark_count
    rows = slice(first, first + count)
    joined.reserve(first + count)
    joined.landmark_count += count
    joined.points[rows] = S.transform(growing.points[:count])
    joined.normals[rows] = growing.normals[:count] @ S.rotation.T
    joined.distances[rows] = growing.distances[:count] * S.scale
    for name in ("reference", "oldest", "newest"):
        getattr(joined, name)[rows] = getattr(growing, name)[:count] + keyframe_offset
    joined.merged_into[rows] = growing.merged_into[:count] + first
    for name in ("descriptors", "octaves", "visible", "found", "alive", "observations"):
        getattr(joined, name)[rows] = getattr(growing, name)[:count]


def _moved_keyframe(keyframe: Keyframe, S: Sim3, keyframe_offset: int, landmark_offset: int) -> Keyframe:
    return replace(
        keyframe,
        index=keyframe.index + keyframe_offset,
        vis_from_cam=S.transform_pose(keyframe.vis_from_cam),
        landmark_of=_shifted(keyframe.landmark_of, landmark_offset),
    )


def _moved_frame(
    frame: PosedFrame, growing: GrowingMap, S: Sim3, keyframes: Sequence[Keyframe], landmark_offset: int
) -> PosedFrame:
    ids = growing.resolve(frame.landmarks)
    alive = ids >= 0
    motion = frame.keyframe_from_cam
    return replace(
        frame,
        keyframe=keyframes[frame.keyframe.index],
        keyframe_from_cam=Pose(motion.rotation, motion.translation_m * S.scale),
        landmarks=_shifted(ids[alive], landmark_offset),
        pixels=frame.pixels[alive],
        sigmas_px=frame.sigmas_px[alive],
    )


def _shifted(ids: Ids, offset: int) -> Ids:
    return np.where(ids >= 0, ids + offset, -1).astype(np.int32)
