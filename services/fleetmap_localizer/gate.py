"""Whether a pose is worth considering: no pose rather than a wrong one.

Houses, cars and windows repeat. A copy of one of them at the wrong place can gather a hundred consistent matches;
but it gathers them in one part of the image, while elsewhere the map's landmarks are not where the pose says.
So it counts how much of the view agrees, beside how many landmarks do. A pose that nothing before vouches for must
show more, see fleetmap_localizer.likeness.

How many must agree depends on how many could: where a map promises 2,500 landmarks, 30 of them find something
alike near a wrong pose; where it promises 100, not 15 of them do. So the count is held against what chance would
bring, and the same settings hold for dense maps and for sparse ones. Source, of judging a contrario: L. Moisan,
B. Stival, "A probabilistic criterion to detect rigid point matches between two images and estimate the fundamental
matrix", IJCV 57(3), 2004.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, rotation_angle_rad
from fleetmap.vision.absolute_pose import AbsolutePose
from fleetmap_localizer.settings import GateSettings

Array = NDArray[np.float64]

_COLUMNS, _ROWS = 8, 4
_POPULATED = 5  # landmarks and features that a cell must have for its silence to mean something
_MIN_POPULATED_CELLS = 4
_SAME_PLACE_M, _SAME_VIEW_RAD = 0.7, np.radians(3.0)


@dataclass(frozen=True)
class Fit:
    """A pose with all that speaks for and against it; pixels are undistorted."""

    answer: AbsolutePose
    landmarks: NDArray[np.int64]  # (P,) that the pose was fitted to, indices into the map's
    matched_px: Array  # (P, 2) the features that show them
    matched_sigmas_px: Array  # (P,) of these features
    predicted_px: Array  # (L, 2) where the landmarks in view should be
    feature_px: Array  # (F, 2) all features of the image


def is_trustworthy(fit: Fit, camera: Camera, settings: GateSettings) -> bool:
    """Judge by how many landmarks agree, how much of the view they fill, and how firmly they hold the pose."""
    answer = fit.answer
    agreeing = _per_cell(fit.matched_px[answer.inliers], camera)
    position_sigma_m = np.sqrt(np.linalg.eigvalsh(answer.covariance[3:, 3:])[-1])
    rotation_sigma_deg = np.degrees(np.sqrt(np.linalg.eigvalsh(answer.covariance[:3, :3])[-1]))
    return bool(
        answer.inlier_count >= settings.min_inliers
        and answer.inlier_count >= settings.min_inlier_ratio * len(fit.matched_px)
        and chance_of(answer.inlier_count, len(fit.predicted_px), settings.chance_ratio) <= settings.max_chance
        and np.count_nonzero(agreeing) >= settings.min_occupied_cells
        and _coverage(fit, agreeing, camera) >= settings.min_coverage
        and position_sigma_m <= settings.max_position_sigma_m
        and rotation_sigma_deg <= settings.max_rotation_sigma_deg
    )


def chance_of(agreeing: int, predicted: int, ratio: float) -> float:
    """At most how probable it is that so many of the predicted landmarks agree by chance, each with ``ratio``.

    Source: W. Hoeffding, "Probability inequalities for sums of bounded random variables", 1963, eq. 2.1.
    """
    share = min(agreeing / max(predicted, 1), 1.0)
    if share <= ratio:
        return 1.0
    surprise = share * np.log(share / ratio)
    if share < 1.0:
        surprise += (1.0 - share) * np.log((1.0 - share) / (1.0 - ratio))
    return float(np.exp(-predicted * surprise))


def _coverage(fit: Fit, agreeing: NDArray[np.int64], camera: Camera) -> float:
    """Of the cells where landmarks should be found, the share in which some are; 1 in a map too sparse to tell."""
    promised = np.minimum(_per_cell(fit.predicted_px, camera), _per_cell(fit.feature_px, camera))
    populated = promised >= _POPULATED
    if np.count_nonzero(populated) < _MIN_POPULATED_CELLS:
        return 1.0
    return float(np.mean(agreeing[populated] > 0))


def _per_cell(pixels: Array, camera: Camera) -> NDArray[np.int64]:
    """How many of the pixels (N, 2) fall into each cell of a coarse grid over the image."""
    column = np.clip(pixels[:, 0] * _COLUMNS / camera.width_px, 0, _COLUMNS - 1).astype(np.int64)
    row = np.clip(pixels[:, 1] * _ROWS / camera.height_px, 0, _ROWS - 1).astype(np.int64)
    return np.bincount(row * _COLUMNS + column, minlength=_COLUMNS * _ROWS)


def is_same_place(first: Pose, second: Pose) -> bool:
    """Whether two poses are so close that they are taken for one answer."""
    away_m = np.linalg.norm(first.translation_m - second.translation_m)
    turned_rad = rotation_angle_rad(first.rotation.T @ second.rotation)
    return bool(away_m <= _SAME_PLACE_M and turned_rad <= _SAME_VIEW_RAD)
