"""A map of a million landmarks, made of numbers instead of images: a straight road of 10 km."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fleetmap.camera import Camera
from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Sim3
from fleetmap.manifest import Provenance, Quality
from fleetmap.map_package import write_package
from fleetmap.visual_map import Keyframes, Landmarks, Observations, VisualMap

_KEYFRAMES, _LANDMARKS_PER_KEYFRAME = 10_000, 100
_SEEN_BY = 4  # keyframes, one behind the other
_STEP_M, _STEP_NS = 1.0, 100_000_000


def write_large_map(folder: Path, map_id: str, keyframes: int = _KEYFRAMES) -> int:
    """Write the map package of a road with a keyframe each metre; returns how many landmarks it has."""
    visual_map = _visual_map(keyframes)
    landmarks = len(visual_map.landmarks)
    quality = Quality(
        keyframes=keyframes,
        landmarks=landmarks,
        observations=len(visual_map.observations),
        length_m=keyframes * _STEP_M,
        frames_total=keyframes,
        frames_posed=keyframes,
        reprojection_rms_px=0.7,
        gnss_fixes=0,
        gnss_residual_rms_m=None,
        gnss_mode="none",
        publishable=True,
    )
    provenance = Provenance(
        drive="made", fleetmap_version="0", settings={}, start_ns=0, end_ns=keyframes * _STEP_NS, created_ns=0
    )
    write_package(folder, visual_map, map_id=map_id, quality=quality, provenance=provenance)
    return landmarks


def _visual_map(keyframes: int) -> VisualMap:
    along_m = np.arange(keyframes) * _STEP_M
    positions_m = np.column_stack([along_m, np.zeros(keyframes), np.zeros(keyframes)])
    return VisualMap(
        UtmAnchor(32632, 456_000, 5_428_000, 110),
        Sim3.identity(),
        Camera(640, 480, 500.0, 500.0, 320.0, 240.0),
        Keyframes(np.arange(keyframes) * _STEP_NS, np.tile(np.eye(3), (keyframes, 1, 1)), positions_m),
        _landmarks(positions_m),
        _observations(keyframes),
    )


def _landmarks(positions_m: np.typing.NDArray[np.float64]) -> Landmarks:
    """Around each keyframe a hundred."""
    random = np.random.default_rng(0)
    count = len(positions_m) * _LANDMARKS_PER_KEYFRAME
    points_m = np.repeat(positions_m, _LANDMARKS_PER_KEYFRAME, axis=0) + random.uniform(-30.0, 30.0, (count, 3))
    normals = random.normal(size=(count, 3)).astype(np.float32)
    return Landmarks(
        points_m,
        random.integers(0, 256, (count, 32), dtype=np.uint8),
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        random.integers(0, 8, count, dtype=np.uint8),
        random.uniform(5.0, 50.0, count).astype(np.float32),
    )


def _observations(keyframes: int) -> Observations:
    """Each keyframe sees its own landmarks and those of the three before it."""
    first_of_keyframe = np.maximum(np.arange(keyframes) - _SEEN_BY + 1, 0)
    seen = (np.arange(keyframes) - first_of_keyframe + 1) * _LANDMARKS_PER_KEYFRAME
    keyframe_index = np.repeat(np.arange(keyframes), seen)
    place = np.arange(len(keyframe_index)) - np.repeat(np.cumsum(seen) - seen, seen)
    landmark_index = first_of_keyframe[keyframe_index] * _LANDMARKS_PER_KEYFRAME + place
    random = np.random.default_rng(1)
    return Observations(
        keyframe_index.astype(np.int32),
        landmark_index.astype(np.int32),
        random.uniform(0.0, 480.0, (len(keyframe_index), 2)).astype(np.float32),
        random.integers(0, 8, len(keyframe_index), dtype=np.uint8),
    )
