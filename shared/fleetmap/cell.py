"""One 128 m UTM cell of a map: all that a localizer needs there, in map-wide ids."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleetmap.geodesy import UtmAnchor
from fleetmap.manifest import CELL_SIZE_M
from fleetmap.visual_map import Keyframes, Landmarks

Ids = NDArray[np.int64]
CellIndex = tuple[int, int]  # floor(easting / 128), floor(northing / 128)
MM_PER_M = 1000


@dataclass(frozen=True)
class Cell:
    """The keyframes whose camera centre lies in the cell, every landmark they see, and who sees what."""

    keyframe_ids: Ids  # (K,) int64 ascending
    keyframes: Keyframes
    landmark_ids: Ids  # (N,) int64 ascending
    landmarks: Landmarks
    seen_by_keyframe: Ids  # (M,) int64 index into keyframe_ids; sorted by keyframe, then landmark
    seen_landmark: Ids  # (M,) int64 index into landmark_ids


def cell_attributes(index: CellIndex, anchor: UtmAnchor) -> dict[str, Any]:
    """What the header of a cell's part says about where it lies."""
    return {"epsg": anchor.epsg, "cell": list(index)}


def corner_offset_m(index: CellIndex, anchor: UtmAnchor) -> NDArray[np.float64]:
    """The cell's south-west corner at ellipsoidal height 0, in map (3,)."""
    return np.array([index[0] * CELL_SIZE_M, index[1] * CELL_SIZE_M, 0.0]) - anchor.offset_m
