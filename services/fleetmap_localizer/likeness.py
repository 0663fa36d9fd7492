"""Whether an image looks like the map where a pose says that the map's landmarks are.

Matches tell what agrees with a pose. Why the rest of the view is silent they do not tell: in the light of
another day no corner may be found there, or there is another street, of which one wall is the same. So the image
is described once more at the very places where the landmarks should be, corner or not, along the orientations
that they were mapped with, and each place is held against others than its own landmark, in two ways.

Against any other of the view: what a distance means depends on the image's light, noise and sharpness, so it is
ranked among those of places to landmarks that are not theirs. And against the one that resembles the own
landmark most: a street of the same shape has windows' corners at the same places, and one window's corner is
much like another's. Where the image shows the map, the own one is closer, and by as much as the two differ;
where it shows something of the same kind, either may be.

Sources, of looking at the whole view once a pose is known: H. Taira et al., "InLoc: indoor visual localization
with dense matching and view synthesis", CVPR 2018, section 3.3; of ranks among distances that mean nothing:
permutation tests, R. A. Fisher, "The design of experiments", 1935; of the runner-up as a yardstick: D. Lowe,
"Distinctive image features from scale-invariant keypoints", IJCV 2004, section 7.1.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap.vision.matching import as_words, bits_apart, hamming_to_all
from fleetmap.vision.upward import upward_deg
from fleetmap_localizer.local_map import Predictions
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.query_image import QueryImage

Array = NDArray[np.float64]

_COLUMNS, _ROWS = 24, 12
_MIN_IN_NEIGHBOURHOOD = 5  # landmarks in three by three cells, for their mean margin to mean something
_ALIKE = 0.1  # mean margin
_LANDMARK_ALIKE = 0.05  # rank
_SAME_VIEW_DEG, _SAME_SIZE_OCTAVES = 8.0, 2
_ITSELF = 1 << 20  # in place of the distance to itself


@dataclass(frozen=True)
class Likeness:
    """How much of an image looks like the map."""

    alike: float  # share of the view, where there are landmarks, that looks more like them than like their likes
    landmarks_alike: float  # share of the landmarks seen nearly as they were mapped that look like themselves
    is_oriented: bool  # whether the map tells its descriptors' orientations; without, less is alike


def likeness_at(view: MapView, camera: Camera, image: QueryImage, map_from_cam: Pose) -> Likeness:
    """Compare an image with what a camera at this pose should see."""
    group = view.content.landmarks
    predictions = view.local_map.predict(view.local_map.landmarks_around(map_from_cam), map_from_cam)
    landmarks, recorded_px = predictions.landmarks, camera.distort(predictions.pixels)
    upward = upward_deg(camera, predictions.pixels, map_from_cam.rotation[2])

    def bits_from(others: NDArray[np.int64]) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
        """At which places the image can be described, and how many bits it differs there from landmarks (L,)."""
        angles = None if group.angles_deg is None else upward + group.angles_deg[others]
        known, seen = image.describe_at(recorded_px, predictions.octaves, angles)
        return known, bits_apart(seen, group.descriptors[others])

    known, own = bits_from(landmarks)
    if not known.any():
        return Likeness(0.0, 0.0, group.angles_deg is not None)
    resembling, apart = _most_like(as_words(group.descriptors[landmarks]))
    margins = margins_of(own, bits_from(landmarks[resembling])[1], apart)
    local_means = _local_means(recorded_px[known], margins[known], camera)
    ranks = _ranks(own[known], bits_from(landmarks[_strangers(len(landmarks))])[1][known])
    as_mapped = _is_seen_as_mapped(view, predictions, map_from_cam)[known]
    return Likeness(
        _share(local_means > _ALIKE), _share(ranks[as_mapped] <= _LANDMARK_ALIKE), group.angles_deg is not None
    )


def margins_of(own: NDArray[np.int64], other: NDArray[np.int64], apart: NDArray[np.int64]) -> Array:
    """How clearly places (L,) show their own landmarks, from distances in bits to these, to others, and of both.

    1 where a place shows its own to the last bit, 0 where it is as much like the other, -1 where it shows that.
    """
    return np.asarray(np.clip((other - own) / np.maximum(apart, 1), -1.0, 1.0))


def place_score(likeness: Likeness) -> float:
    """Log-odds that the image is of this place, and not of one that resembles it, both being as likely before.

    A logistic regression; learned by ``python -m fleetmap_cli.benchmarks.place_score_training`` from simulated
    streets and from others of the same shape, in which a quarter of the surfaces is the same.
    """
    weights = PLACE_WEIGHTS if likeness.is_oriented else PLACE_WEIGHTS_UNORIENTED
    return float(weights @ place_evidence(likeness))


def place_evidence(likeness: Likeness) -> Array:
    """What is weighed (3,): the share of the view, that of the landmarks, and one."""
    return np.array([likeness.alike, likeness.landmarks_alike, 1.0])


PLACE_WEIGHTS = np.array([23.49, 17.43, -30.13])
PLACE_WEIGHTS_UNORIENTED = np.array([16.42, 8.37, -8.57])


@njit(cache=True, nogil=True)
def _most_like(words):  # type: ignore[no-untyped-def]
    """For each descriptor (L, 4) the most similar other one (L,), and how many bits it differs (L,)."""
    columns, distances = words.T.copy(), np.empty(len(words), np.int32)
    resembling, apart = np.zeros(len(words), np.int64), np.zeros(len(words), np.int64)
    for i in range(len(words)):
        hamming_to_all(words[i], columns, distances)
        distances[i] = _ITSELF
        resembling[i] = np.argmin(distances)
        apart[i] = distances[resembling[i]]
    return resembling, apart


def _strangers(count: int) -> NDArray[np.int64]:
    """For each of several things (N,) another one, none of them twice; always the same."""
    order = np.random.default_rng(0).permutation(count)
    other = np.empty_like(order)
    other[order] = np.roll(order, 1)
    return other


def _ranks(distances: NDArray[np.int64], meaningless: NDArray[np.int64]) -> Array:
    """Of each of the distances (L,) among those that mean nothing (L,); in (0, 1]."""
    at_most = np.searchsorted(np.sort(meaningless), distances, side="right")
    return np.asarray((at_most + 1) / (len(meaningless) + 1))


def _is_seen_as_mapped(view: MapView, predictions: Predictions, map_from_cam: Pose) -> NDArray[np.bool_]:
    """Which landmarks (L,) are seen from nearly the direction that they were mapped from, at nearly the size."""
    group, landmarks = view.content.landmarks, predictions.landmarks
    to_camera = map_from_cam.translation_m - group.points_m[landmarks]
    cosines = np.einsum("li,li->l", to_camera, group.normals[landmarks]) / np.linalg.norm(to_camera, axis=1)
    octaves = np.abs(predictions.octaves - group.octaves[landmarks].astype(np.int64))
    return np.asarray((cosines > np.cos(np.radians(_SAME_VIEW_DEG))) & (octaves <= _SAME_SIZE_OCTAVES))


def _local_means(pixels: Array, margins: Array, camera: Camera) -> Array:
    """Mean margin of the landmarks in and around each cell of a grid over the image, where there are enough."""
    column = np.clip(pixels[:, 0] * _COLUMNS / camera.width_px, 0, _COLUMNS - 1).astype(np.int64)
    row = np.clip(pixels[:, 1] * _ROWS / camera.height_px, 0, _ROWS - 1).astype(np.int64)
    cells = row * _COLUMNS + column
    count, total = _around(cells, np.ones(len(cells))), _around(cells, margins)
    enough = count > _MIN_IN_NEIGHBOURHOOD - 0.5
    return np.asarray(total[enough] / count[enough])


def _around(cells: NDArray[np.int64], weights: Array) -> Array:
    """Sums of weights per cell and its eight neighbours (rows, columns)."""
    per_cell = np.bincount(cells, weights, minlength=_ROWS * _COLUMNS).reshape(_ROWS, _COLUMNS)
    summed = cv2.boxFilter(per_cell, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(summed, dtype=np.float64)


def _share(flags: NDArray[np.bool_]) -> float:
    return float(flags.mean()) if len(flags) else 0.0
