"""Fewer keyframes for the cells: a localizer needs them to recognise places, not to triangulate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import rotation_angle_rad
from fleetmap.visual_map import Keyframes, VisualMap, taken

_SPACING_M = 1.5
_TURN_RAD = np.radians(10.0)


def thinned_keyframes(visual_map: VisualMap) -> VisualMap:
    """The map with keyframes about 1.5 m apart, or 10 deg; what a dropped one saw, its neighbour saw."""
    kept = _kept(visual_map.keyframes)
    heir = _heirs(visual_map.keyframes, kept)
    observations = visual_map.observations
    pairs = heir[observations.keyframe_index] << 32 | observations.landmark_index
    _, rows = np.unique(pairs, return_index=True)
    few = taken(observations, rows)
    return replace(
        visual_map,
        keyframes=taken(visual_map.keyframes, kept),
        observations=replace(few, keyframe_index=heir[few.keyframe_index].astype(np.int32)),
    )


def _kept(keyframes: Keyframes) -> NDArray[np.int64]:
    """Keyframes (k,), each far enough from the one kept before."""
    kept = [0]
    for k in range(1, len(keyframes)):
        last = kept[-1]
        away_m = np.linalg.norm(keyframes.positions_m[k] - keyframes.positions_m[last])
        turned_rad = rotation_angle_rad(keyframes.rotations[last].T @ keyframes.rotations[k])
        if away_m >= _SPACING_M or turned_rad >= _TURN_RAD:
            kept.append(k)
    return np.array(kept, np.int64)


def _heirs(keyframes: Keyframes, kept: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each keyframe (K,) the number of the kept one before or after it, whichever is closer."""
    after = np.searchsorted(kept, np.arange(len(keyframes))).clip(0, len(kept) - 1)
    before = np.maximum(after - 1, 0)
    to_after = np.linalg.norm(keyframes.positions_m - keyframes.positions_m[kept[after]], axis=1)
    to_before = np.linalg.norm(keyframes.positions_m - keyframes.positions_m[kept[before]], axis=1)
    return np.where(to_before < to_after, before, after).astype(np.int64)
