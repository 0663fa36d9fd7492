"""PlacedMap -> VisualMap: descriptors, viewing directions and everything a localizer will ask for."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fleetmap.geodesy import UtmAnchor
from fleetmap.vision.features import Features
from fleetmap.vision.matching import medoid_descriptor
from fleetmap.vision.upward import upward_deg
from fleetmap.visual_map import Keyframes, Landmarks, Observations, VisualMap
from fleetmap_mapper.growing_map import GrowingMap
from fleetmap_mapper.placed_map import PlacedMap, octaves_of

Array = NDArray[np.float64]


def build_visual_map(placed: PlacedMap, growing: GrowingMap, anchor: UtmAnchor) -> VisualMap:
    """The finished map."""
    octaves = octaves_of(placed, growing)
    return VisualMap(
        anchor,
        placed.map_from_vis,
        placed.camera,
        Keyframes(
            placed.keyframe_stamps_ns,
            np.array([p.rotation for p in placed.poses]),
            np.array([p.translation_m for p in placed.poses]),
            None if placed.pose_covariances is None else placed.pose_covariances.astype(np.float32),
        ),
        _landmarks(placed, growing, octaves),
        Observations(placed.keyframe_index, placed.point_index, placed.pixels.astype(np.float32), octaves),
    )


def _landmarks(placed: PlacedMap, growing: GrowingMap, octaves: NDArray[np.uint8]) -> Landmarks:
    centres = np.array([p.translation_m for p in placed.poses])
    rays = centres[placed.keyframe_index] - placed.points_m[placed.point_index]
    distances = np.linalg.norm(rays, axis=1)
    sums = np.zeros_like(placed.points_m)
    np.add.at(sums, placed.point_index, rays / distances[:, None])
    chosen = _medoid_observations(placed, growing)
    return Landmarks(
        placed.points_m,
        _descriptors(placed, growing, chosen),
        (sums / np.linalg.norm(sums, axis=1)[:, None]).astype(np.float32),
        octaves[chosen],
        distances[chosen].astype(np.float32),
        angles_deg=_angles_deg(placed, growing, chosen),
    )


def _medoid_observations(placed: PlacedMap, growing: GrowingMap) -> NDArray[np.int64]:
    """For each point the observation (P,) whose descriptor has the least median distance to the track's others."""
    order = np.argsort(placed.point_index, kind="stable")
    starts = np.searchsorted(placed.point_index[order], np.arange(len(placed.points_m) + 1))
    descriptors = _descriptors(placed, growing, order)
    return np.array(
        [order[a + medoid_descriptor(descriptors[a:b])] for a, b in itertools.pairwise(starts)],
        dtype=np.int64,
    )


def _descriptors(placed: PlacedMap, growing: GrowingMap, observations: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Descriptors (n, 32) behind some observations (n,)."""
    descriptors = np.empty((len(observations), 32), np.uint8)
    for features, found, rows in _features_behind(placed, growing, observations):
        descriptors[rows] = features.descriptors[found]
    return descriptors


def _angles_deg(placed: PlacedMap, growing: GrowingMap, observations: NDArray[np.int64]) -> NDArray[np.float32]:
    """Orientations (n,) of the descriptors behind some observations (n,), from "up" in their images."""
    in_image = np.empty(len(observations))
    for features, found, rows in _features_behind(placed, growing, observations):
        in_image[rows] = features.angles_deg[found]
    up_in_cam = np.array([pose.rotation[2] for pose in placed.poses])[placed.keyframe_index[observations]]
    upward = upward_deg(placed.camera, placed.pixels[observations], up_in_cam)
    return np.asarray((in_image - upward) % 360.0, dtype=np.float32)


def _features_behind(
    placed: PlacedMap, growing: GrowingMap, observations: NDArray[np.int64]
) -> Iterator[tuple[Features, NDArray[np.int32], NDArray[np.bool_]]]:
    """By keyframe: its features, which of them are behind the observations (n,), and which of these it made."""
    keyframes, features = placed.keyframe_index[observations], placed.feature_index[observations]
    for keyframe in np.unique(keyframes):
        rows = keyframes == keyframe
        yield growing.keyframes[keyframe].features, features[rows], rows
