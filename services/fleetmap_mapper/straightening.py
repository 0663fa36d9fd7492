"""Carrying a map along when its path is bent to the fixes: every keyframe by a small similarity of its own.

Position, heading and scale all move, so a gap without fixes is crossed smoothly and no keyframe is torn from what
it sees. Each landmark follows the keyframe that carries it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Pose, Sim3, nearest_rotations
from fleetmap_mapper.drift_path import Timed, bent
from fleetmap_mapper.gnss_consensus import Consensus
from fleetmap_mapper.growing_map import GrowingMap, Keyframe
from fleetmap_mapper.slam import PosedFrame, Segment


def straighten(segment: Segment, consensus: Consensus) -> None:
    """Bend a whole segment, in its free-scale frame, as its path has been bent."""
    keyframes, S = segment.growing.keyframes, consensus.map_from_vis
    moves = [S.inverse() @ move @ S for move in local_moves(keyframes, consensus)]
    move_keyframes(segment.growing, keyframes, moves, segment.posed)


def local_moves(keyframes: Sequence[Keyframe], consensus: Consensus) -> list[Sim3]:
    """For every keyframe the similarity, map to map, that carries its surroundings onto the bent path."""
    stamps_ns = np.array([k.stamp_ns for k in keyframes], dtype=np.int64)
    placed = Timed.of(stamps_ns, [k.vis_from_cam for k in keyframes]).placed(consensus.map_from_vis)
    moved, scales = bent(placed, consensus.chain, consensus.bend)
    turns = nearest_rotations(moved.rotations @ np.swapaxes(placed.rotations, 1, 2))
    return [
        Sim3(float(s), turn, after - s * turn @ before)
        for s, turn, before, after in zip(scales, turns, placed.positions, moved.positions, strict=True)
    ]


def move_keyframes(
    growing: GrowingMap, keyframes: Sequence[Keyframe], moves: Sequence[Sim3], posed: Iterable[PosedFrame]
) -> None:
    """Move successive keyframes, each by its own similarity of ``vis``; landmarks and frames go along."""
    first = keyframes[0].index
    for frame in posed:  # their motions from the keyframe are lengths too, and change in place
        if frame.keyframe.index >= first:
            frame.keyframe_from_cam.translation_m[:] *= moves[frame.keyframe.index - first].scale
    for keyframe, move in zip(keyframes, moves, strict=True):
        pose = move.transform_pose(keyframe.vis_from_cam)
        keyframe.vis_from_cam = Pose(nearest_rotations(pose.rotation), pose.translation_m)
    landmarks = growing.landmarks_of(keyframes)
    rows: NDArray[np.int64] = growing.reference[landmarks] - first
    landmarks, rows = landmarks[rows >= 0], rows[rows >= 0]
    turned_and_scaled = np.array([m.scale * m.rotation for m in moves])
    shifts = np.array([m.translation_m for m in moves])
    growing.points[landmarks] = (
        np.einsum("nij,nj->ni", turned_and_scaled[rows], growing.points[landmarks]) + shifts[rows]
    )
