"""Where one segment lies in the frame of another that lost track of the same place: from landmarks alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fleetmap.geometry import Sim3, so3_exp
from fleetmap.vision.absolute_pose import AbsolutePoseSettings, estimate_absolute_pose
from fleetmap.vision.matching import match_descriptors
from fleetmap.vision.place_recognition import PlaceIndex
from fleetmap_mapper.growing_map import GrowingMap, Keyframe
from fleetmap_mapper.settings import MapperSettings
from fleetmap_mapper.slam import Segment

Array = NDArray[np.float64]

_NEXT_IN_TIME = 6  # keyframes on either side of a gap that are held against each other
_LOOKED_AT, _ALIKE = 40, 3  # keyframes spread over a segment, and places that each may show
_MIN_INLIERS = 15  # in one keyframe
_MIN_KEYFRAMES = 3  # that agree on one Sim(3)
_MAX_ERROR_SIGMAS = 3.0
_FEATURES_WITH_DEPTH = 8
_MAX_HAMMING, _RATIO = 64, 0.9


@dataclass(frozen=True)
class _View:
    """Landmarks of the placed segment in a keyframe of the other."""

    keyframe: Keyframe
    points: Array  # (n, 3) in the placed segment's frame
    pixels: Array  # (n, 2)
    sigmas_px: Array  # (n,)
    guess: Sim3  # placed_from_other as this view alone has it


def place_beside(placed: Segment, other: Segment, settings: MapperSettings) -> Sim3 | None:
    """``placed_from_other`` in Sim(3), or None unless several keyframes agree on it."""
    views = list(_views(placed, other, settings))
    if len(views) < _MIN_KEYFRAMES:
        return None
    counts = [sum(_agrees(v, view.guess, other.growing) for v in views) for view in views]
    S = views[int(np.argmax(counts))].guess
    for _ in range(2):
        agreeing = [v for v in views if _agrees(v, S, other.growing)]
        if len(agreeing) < _MIN_KEYFRAMES:
            return None
        S = _refined(agreeing, S, other.growing)
    return S if sum(_agrees(v, S, other.growing) for v in views) >= _MIN_KEYFRAMES else None


def _views(placed: Segment, other: Segment, settings: MapperSettings) -> Iterator[_View]:
    """Keyframes that may see landmarks of the placed segment: next to it in time, or where it looks alike."""
    is_later = other.posed[0].stamp_ns > placed.posed[0].stamp_ns
    known, new = placed.growing.keyframes, other.growing.keyframes
    last_known = known[:-_NEXT_IN_TIME:-1] if is_later else known[:_NEXT_IN_TIME]
    index = _place_index(placed.growing)
    step = max(1, len(new) // _LOOKED_AT)
    first_new = new[:_NEXT_IN_TIME] if is_later else new[-_NEXT_IN_TIME:]
    for keyframe in sorted({k.index: k for k in [*first_new, *new[::step]]}.values(), key=lambda k: k.index):
        alike = np.argsort(-index.scores(keyframe.features.descriptors), kind="stable")[:_ALIKE]
        candidates = [*(known[k] for k in alike), *(last_known if keyframe in first_new else [])]
        views = (_view(placed.growing, k, other.growing, keyframe, settings) for k in candidates)
        best = max((v for v in views if v is not None), key=lambda v: len(v.points), default=None)
        if best is not None:
            yield best


def _place_index(growing: GrowingMap) -> PlaceIndex:
    seen = [k.landmarks() for k in growing.keyframes]
    ids, rows = np.unique(np.concatenate(seen), return_inverse=True)
    keyframes = np.repeat(np.arange(len(seen), dtype=np.int32), [len(s) for s in seen])
    return PlaceIndex(growing.descriptors[ids], keyframes, rows.astype(np.int32), len(seen))


def _view(
    placed: GrowingMap, known: Keyframe, other: GrowingMap, keyframe: Keyframe, settings: MapperSettings
) -> _View | None:
    seen = np.flatnonzero(known.landmark_of >= 0)
    features = keyframe.features
    pairs = match_descriptors(known.features.descriptors[seen], features.descriptors, _MAX_HAMMING, _RATIO)
    if len(pairs) < _MIN_INLIERS:
        return None
    points, rows = placed.points[known.landmark_of[seen[pairs[:, 0]]]], pairs[:, 1]
    pose = estimate_absolute_pose(
        features.pixels[rows],
        points,
        features.sigmas_px[rows],
        placed.camera,
        AbsolutePoseSettings(min_inliers=_MIN_INLIERS, seed=settings.seed),
    )
    if pose is None:
        return None
    rows, points = rows[pose.inliers], points[pose.inliers]
    mapped = np.flatnonzero(keyframe.landmark_of[rows] >= 0)
    if len(mapped) < _FEATURES_WITH_DEPTH:
        return None
    depths = pose.map_from_cam.inverse().transform(points[mapped])[:, 2]
    own_depths = keyframe.vis_from_cam.inverse().transform(other.points[keyframe.landmark_of[rows[mapped]]])[:, 2]
    scale = float(np.median(depths / own_depths))
    rotation = pose.map_from_cam.rotation @ keyframe.vis_from_cam.rotation.T
    shift = pose.map_from_cam.translation_m - scale * rotation @ keyframe.vis_from_cam.translation_m
    return _View(keyframe, points, features.pixels[rows], features.sigmas_px[rows], Sim3(scale, rotation, shift))


def _errors_sigmas(view: _View, S: Sim3, growing: GrowingMap) -> Array:
    """Reprojection errors (n, 2) over their sigmas when ``S`` is placed_from_other; large behind the camera."""
    in_cam = view.keyframe.vis_from_cam.inverse().transform(S.inverse().transform(view.points))
    errors = (growing.camera.project_ideal(in_cam) - view.pixels) / view.sigmas_px[:, None]
    return np.asarray(np.nan_to_num(errors, nan=100.0))


def _agrees(view: _View, S: Sim3, growing: GrowingMap) -> bool:
    fits = np.linalg.norm(_errors_sigmas(view, S, growing), axis=1) < 2.0 * _MAX_ERROR_SIGMAS
    return bool(fits.sum() >= max(_MIN_INLIERS // 2, 0.5 * len(fits)))


def _refined(views: list[_View], start: Sim3, growing: GrowingMap) -> Sim3:
    """The Sim(3) of least robust reprojection error in all views."""
    centre = np.mean([v.keyframe.vis_from_cam.translation_m for v in views], axis=0)

    def at(delta: Array) -> Sim3:
        rotation = start.rotation @ so3_exp(delta[:3])
        scale = start.scale * float(np.exp(delta[6]))
        moved = start.transform(centre) + start.scale * delta[3:6]
        return Sim3(scale, rotation, moved - scale * rotation @ centre)

    def residuals(delta: Array) -> Array:
        S = at(delta)
        return np.concatenate([_errors_sigmas(v, S, growing).ravel() for v in views])

    return at(least_squares(residuals, np.zeros(7), loss="cauchy", x_scale="jac").x)
