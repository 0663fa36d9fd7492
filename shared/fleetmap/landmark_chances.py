"""The chance that another vehicle finds a landmark again and can use it.

What was seen often will be again: simulated and real vehicles found landmarks of n observations in proportion to
n / (n + 10), from 2 observations to 40. What is inexact is not where it should be, and what resembles something
else in the same view may be taken for it.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.landmark_precision import SCALE_FACTOR
from fleetmap.vision.matching import as_words, hamming
from fleetmap.visual_map import VisualMap

Array = NDArray[np.float64]

_BESIDE_M = 3.5  # how far aside of the survey another vehicle may look from: the next lane
_HALF_OFTEN = 10.0  # observations
_CLEARLY_OTHER = 30  # bits; descriptors further apart are not taken for each other
_LIKE = 60  # bits; descriptors of one thing mapped twice are closer
_DOUBLE = 0.2  # what is left of a landmark that another, seen more often, stands for as well
_DOUBLE_SIGMAS, _DOUBLE_M = 3.0, 0.05  # two landmarks so close are the same thing mapped twice


def landmark_chances(visual_map: VisualMap) -> Array:
    """For landmarks whose ``sigmas_m`` are known, (N,) from 0 to 1; only their ratios mean something."""
    sigmas_m = visual_map.landmarks.sigmas_m
    assert sigmas_m is not None
    observations = visual_map.observations
    counts = np.bincount(observations.landmark_index, minlength=len(visual_map.landmarks))
    starts = np.searchsorted(observations.keyframe_index, np.arange(len(visual_map.keyframes) + 1))
    near_m = np.maximum(_DOUBLE_SIGMAS * sigmas_m[:, 0].astype(np.float64), _DOUBLE_M)
    nearest, is_double = _look_for_likeness(
        as_words(visual_map.landmarks.descriptors),
        np.ascontiguousarray(visual_map.landmarks.points_m),
        near_m,
        counts,
        starts,
        observations.landmark_index.astype(np.int64),
    )
    found_again = counts / (counts + _HALF_OFTEN)
    distinctive = np.clip(nearest / _CLEARLY_OTHER, 0.0, 1.0) * np.where(is_double, _DOUBLE, 1.0)
    return np.asarray(found_again * distinctive * _exactness(visual_map))


def _exactness(visual_map: VisualMap) -> Array:
    """The share (N,) of a feature's information that is left when the landmark's own error is added to it.

    Seen from the next lane, what is uncertain along the survey's ray shows across the image as well.
    """
    landmarks, camera = visual_map.landmarks, visual_map.camera
    assert landmarks.sigmas_m is not None
    across_m, along_m = landmarks.sigmas_m.astype(np.float64).T
    distances_m = np.maximum(landmarks.distances_m.astype(np.float64), 0.1)
    shown_m = np.hypot(across_m, along_m * np.minimum(_BESIDE_M / distances_m, 1.0))
    focal_px = np.sqrt(camera.fx_px * camera.fy_px)
    feature_px = SCALE_FACTOR ** landmarks.octaves.astype(np.float64)
    return np.asarray(1.0 / (1.0 + (focal_px * shown_m / distances_m / feature_px) ** 2))


@njit(cache=True, nogil=True)
def _look_for_likeness(descriptors, points_m, near_m, counts, starts, landmark_index):  # type: ignore[no-untyped-def]
    """Bits (N,) to the most similar other landmark in one view, and whether that is the same one mapped twice."""
    nearest = np.full(len(points_m), 256)
    is_double = np.zeros(len(points_m), np.bool_)
    for k in range(len(starts) - 1):
        for m in range(starts[k], starts[k + 1]):
            a = landmark_index[m]
            for n in range(m + 1, starts[k + 1]):
                b = landmark_index[n]
                bits = hamming(descriptors, a, descriptors, b)
                if bits >= nearest[a] and bits >= nearest[b] and bits >= _LIKE:
                    continue
                away_m = 0.0
                for c in range(3):
                    away_m += (points_m[a, c] - points_m[b, c]) ** 2
                if away_m <= max(near_m[a], near_m[b]) ** 2:
                    if bits < _LIKE:
                        is_double[b if counts[a] >= counts[b] else a] = True
                    continue
                nearest[a], nearest[b] = min(nearest[a], bits), min(nearest[b], bits)
    return nearest, is_double
