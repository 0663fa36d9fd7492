"""Whether an image looks like the map where a pose says that the map's landmarks are.

Matches tell what agrees with a pose. Why the rest of the view is silent they do not tell: in the light of another
day no corner may be found there, or there is another street, of which one wall is the same. So the image is
described once more at the very places where the landmarks should be, corner or not, and compared with them. What
that means depends on the image's light, noise and sharpness, so each distance is ranked among those of other
landmarks from the same places: where the image shows something else, the ranks are uniform in [0, 1]; where it
shows the map, they are low.

Source, of looking at the whole view once a pose is known: H. Taira et al., "InLoc: indoor visual localization with
dense matching and view synthesis", CVPR 2018, section 3.3; of ranks among distances that mean nothing: permutation
tests, R. A. Fisher, "The design of experiments", 1935.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap.vision.absolute_pose import AbsolutePose
from fleetmap_localizer.local_map import Predictions
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.query_image import QueryImage

Array = NDArray[np.float64]

_COLUMNS, _ROWS = 24, 12
_MIN_IN_NEIGHBOURHOOD = 5  # landmarks in three by three cells, for their mean rank to mean something
_ALIKE, _MUCH_ALIKE = 0.42, 0.2  # mean ranks
_LANDMARK_ALIKE, _LANDMARK_UNMISTAKABLE = 0.05, 0.01  # ranks
_SAME_VIEW_DEG, _SAME_SIZE_OCTAVES = 8.0, 2


@dataclass(frozen=True)
class Likeness:
    """How much of an image looks like the map."""

    alike: float  # share of the view, where there are landmarks, that looks at all like them
    much_alike: float  # share that looks very much like them
    landmarks_alike: float  # share of the landmarks seen nearly as they were mapped that look like themselves
    landmarks_unmistakable: float  # share of all landmarks that look more like themselves than 99 % of others do


def likeness_at(view: MapView, camera: Camera, image: QueryImage, map_from_cam: Pose) -> Likeness:
    """Compare an image with what a camera at this pose should see."""
    predictions = view.local_map.predict(view.local_map.landmarks_around(map_from_cam), map_from_cam)
    recorded_px = camera.distort(predictions.pixels)
    known, seen = image.describe_at(recorded_px, predictions.octaves)
    if not known.any():
        return Likeness(0.0, 0.0, 0.0, 0.0)
    landmarks = predictions.landmarks[known]
    ranks = _ranks(seen[known], view.content.landmarks.descriptors[landmarks])
    local_means = _local_means(recorded_px[known], ranks, camera)
    as_mapped = _is_seen_as_mapped(view, predictions, map_from_cam)[known]
    return Likeness(
        _share(local_means < _ALIKE),
        _share(local_means < _MUCH_ALIKE),
        _share(ranks[as_mapped] <= _LANDMARK_ALIKE),
        _share(ranks <= _LANDMARK_UNMISTAKABLE),
    )


def place_score(likeness: Likeness, answer: AbsolutePose) -> float:
    """Log-odds that the image is of this place, and not of one that resembles it, both being as likely before.

    A logistic regression; learned by ``python -m fleetmap_cli.benchmarks.place_score_training`` from simulated
    streets and from others of the same shape, in which a quarter of the surfaces is the same. Beside likeness
    counts how firmly the landmarks hold the pose: what is alike by chance lies in one part of the view, and leaves
    it loose.
    """
    return float(PLACE_WEIGHTS @ place_evidence(likeness, answer))


def place_evidence(likeness: Likeness, answer: AbsolutePose) -> Array:
    """What is weighed (6,): the four shares, the logarithm of the position's largest sigma in metres, and one."""
    shares = (likeness.alike, likeness.much_alike, likeness.landmarks_alike, likeness.landmarks_unmistakable)
    sigma_m = np.sqrt(np.linalg.eigvalsh(answer.covariance[3:, 3:])[-1])
    return np.array([*shares, np.log(sigma_m), 1.0])


PLACE_WEIGHTS = np.array([12.76, -6.37, 11.29, 9.28, -0.91, -16.75])


def _ranks(seen: NDArray[np.uint8], mapped: NDArray[np.uint8]) -> Array:
    """Of each place's distance (L,) to its landmark, among distances of places to other landmarks; in (0, 1]."""
    order = np.random.default_rng(0).permutation(len(mapped))
    stranger = np.empty_like(order)
    stranger[order] = np.roll(order, 1)
    meaningless = np.sort(_bits_apart(seen, mapped[stranger]))
    return (np.searchsorted(meaningless, _bits_apart(seen, mapped), side="right") + 1) / (len(mapped) + 1)


def _bits_apart(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.int64]:
    return np.asarray(np.bitwise_count(first ^ second).sum(axis=1, dtype=np.int64))


def _local_means(pixels: Array, ranks: Array, camera: Camera) -> Array:
    """Mean rank of the landmarks in and around each cell of a grid over the image, where there are enough."""
    column = np.clip(pixels[:, 0] * _COLUMNS / camera.width_px, 0, _COLUMNS - 1).astype(np.int64)
    row = np.clip(pixels[:, 1] * _ROWS / camera.height_px, 0, _ROWS - 1).astype(np.int64)
    count, total = (_around(row * _COLUMNS + column, weights) for weights in (np.ones(len(ranks)), ranks))
    enough = count > _MIN_IN_NEIGHBOURHOOD - 0.5
    return np.asarray(total[enough] / count[enough])


def _around(cells: NDArray[np.int64], weights: Array) -> Array:
    """Sums of weights per cell and its eight neighbours (rows, columns)."""
    per_cell = np.bincount(cells, weights, minlength=_ROWS * _COLUMNS).reshape(_ROWS, _COLUMNS)
    summed = cv2.boxFilter(per_cell, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(summed, dtype=np.float64)


def _is_seen_as_mapped(view: MapView, predictions: Predictions, map_from_cam: Pose) -> NDArray[np.bool_]:
    """Which landmarks (L,) are seen from nearly the direction that they were mapped from, at nearly the size."""
    group, landmarks = view.content.landmarks, predictions.landmarks
    to_camera = map_from_cam.translation_m - group.points_m[landmarks]
    cosines = np.einsum("li,li->l", to_camera, group.normals[landmarks]) / np.linalg.norm(to_camera, axis=1)
    octaves = np.abs(predictions.octaves - group.octaves[landmarks].astype(np.int64))
    return np.asarray((cosines > np.cos(np.radians(_SAME_VIEW_DEG))) & (octaves <= _SAME_SIZE_OCTAVES))


def _share(flags: NDArray[np.bool_]) -> float:
    return float(flags.mean()) if len(flags) else 0.0
