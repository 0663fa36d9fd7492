"""What a new keyframe does to the map: new landmarks, fused duplicates, a local adjustment, and a sweep."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Pose
from fleetmap.vision.epipolar_matching import match_epipolar
from fleetmap_mapper.adjustment import AdjustmentProblem, adjust
from fleetmap_mapper.bookkeeping import sorted_by_landmark
from fleetmap_mapper.growing_map import SCALE_FACTOR, GrowingMap, Ids, Keyframe
from fleetmap_mapper.settings import MapperSettings
from fleetmap_mapper.stage_times import StageTimes
from fleetmap_mapper.tracking import match_landmarks
from fleetmap_mapper.triangulation import CHI2_2DOF_95, is_consistent, parallax_rad, triangulate

Array = NDArray[np.float64]
_MIN_BASELINE_TO_DEPTH = 0.01
_RECENT_KEYFRAMES = 3  # for how long a young landmark is on probation
_MIN_FOUND_RATIO = 0.25


def extend_map(growing: GrowingMap, keyframe: Keyframe, settings: MapperSettings, times: StageTimes) -> None:
    """Everything that happens once a keyframe has been added."""
    sweep_young_landmarks(growing, settings.mapping.min_observations)
    neighbours = _neighbours(growing, keyframe, settings.mapping.neighbours)
    with times.stage("triangulating"):
        for neighbour in neighbours:
            triangulate_between(growing, neighbour, keyframe, settings)
    with times.stage("fusing"):
        fuse_with(growing, keyframe, neighbours, settings)
    with times.stage("adjusting"):
        adjust_locally(growing, keyframe, settings.mapping.window)


def triangulate_between(growing: GrowingMap, older: Keyframe, newer: Keyframe, settings: MapperSettings) -> None:
    """New landmarks from features of two keyframes that hold none yet."""
    camera, a, b = growing.camera, older.features, newer.features
    baseline = float(np.linalg.norm(newer.vis_from_cam.translation_m - older.vis_from_cam.translation_m))
    if baseline < _MIN_BASELINE_TO_DEPTH * median_depth(growing, older):
        return
    newer_from_older = newer.vis_from_cam.inverse() @ older.vis_from_cam
    pairs = match_epipolar(
        a,
        b,
        older.landmark_of < 0,
        newer.landmark_of < 0,
        _fundamental(camera.matrix, newer_from_older),
        camera.project_ideal(newer_from_older.translation_m[None])[0],
        settings.mapping.max_hamming,
    )
    if len(pairs) == 0:
        return
    i, j = pairs[:, 0], pairs[:, 1]
    points = triangulate(camera, older.vis_from_cam, a.pixels[i], newer.vis_from_cam, b.pixels[j])
    centres = older.vis_from_cam.translation_m, newer.vis_from_cam.translation_m
    good = (
        (parallax_rad(points, *centres) > settings.mapping.min_parallax_px / camera.fx_px)
        & is_consistent(camera, older.vis_from_cam, points, a.pixels[i], a.sigmas_px[i])
        & is_consistent(camera, newer.vis_from_cam, points, b.pixels[j], b.sigmas_px[j])
    )
    distance_a, distance_b = (np.linalg.norm(points - c, axis=1) for c in centres)
    size_ratio = distance_a / distance_b * SCALE_FACTOR ** (a.octaves[i].astype(float) - b.octaves[j])
    good &= np.abs(np.log(size_ratio)) < np.log(1.5 * SCALE_FACTOR)
    growing.add_landmarks(points[good], older, i[good], newer, j[good])


def fuse_with(growing: GrowingMap, keyframe: Keyframe, others: list[Keyframe], settings: MapperSettings) -> None:
    """Landmarks seen by neighbours are looked for here and the other way round; one place keeps one landmark."""
    radius_px = settings.tracking.refined_radius_px
    for other in others:
        _fuse_into(growing, other, growing.landmarks_of([keyframe]), radius_px, settings)
    _fuse_into(growing, keyframe, growing.landmarks_of(others), radius_px, settings)
    growing.refresh(growing.landmarks_of([keyframe]), [*others, keyframe])


def _fuse_into(
    growing: GrowingMap, keyframe: Keyframe, candidates: Ids, radius_px: float, settings: MapperSettings
) -> None:
    new = growing.not_seen_by(keyframe, candidates)
    landmarks, features = match_landmarks(
        growing, keyframe.features, keyframe.vis_from_cam, new, radius_px, settings.tracking
    )
    fits = is_consistent(
        growing.camera,
        keyframe.vis_from_cam,
        growing.points[landmarks],
        keyframe.features.pixels[features],
        keyframe.features.sigmas_px[features],
    )
    landmarks, features = landmarks[fits], features[fits]
    held = keyframe.landmark_of[features]
    empty = held < 0
    growing.observe(keyframe, features[empty], landmarks[empty])
    if np.any(~empty):
        pair = np.stack([landmarks[~empty], held[~empty]])
        first_is_better = growing.found[pair[0]] > growing.found[pair[1]]
        growing.merge(np.where(first_is_better, pair[1], pair[0]), np.where(first_is_better, pair[0], pair[1]))


def adjust_locally(growing: GrowingMap, keyframe: Keyframe, window: int) -> None:
    """Bundle adjustment of the keyframes that share most with this one; all that they see may move."""
    near = [k for k, _ in growing.covisible(keyframe.landmarks())[:window]]
    free = near if keyframe in near else [keyframe, *near]
    adjust_keyframes(growing, free)


def adjust_keyframes(growing: GrowingMap, free: list[Keyframe], iterations: int = 5) -> None:
    """Robust rounds over some keyframes; others that see the same landmarks stay fixed and hold the gauge."""
    landmarks = growing.landmarks_of(free)
    others = [k for k, n in growing.covisible(landmarks) if k not in free and n >= 5][: 2 * len(free)]
    if len(others) < 2:  # gauge: position, rotation and scale must come from somewhere
        oldest = sorted(free, key=lambda k: k.index)[: 2 - len(others)]
        others, free = others + oldest, [k for k in free if k not in oldest]
    ordered = sorted(free + others, key=lambda k: k.index)
    is_fixed = np.array([k in others for k in ordered])
    for _ in range(2):
        problem, features, ids = _problem(growing, ordered, is_fixed, landmarks)
        result = adjust(problem, iterations)
        for slot, keyframe in enumerate(ordered):
            if not is_fixed[slot]:
                keyframe.vis_from_cam = Pose(result.rotations[slot], result.translations[slot]).inverse()
        growing.points[ids] = result.points
        _drop_outliers(growing, ordered, problem, features, ids, result.chi2)
    growing.refresh(growing.landmarks_of(free), ordered)


def _problem(
    growing: GrowingMap, keyframes: list[Keyframe], is_fixed: NDArray[np.bool_], landmarks: Ids
) -> tuple[AdjustmentProblem, NDArray[np.intp], Ids]:
    """The adjustment's arrays, the feature behind each observation, and the landmark behind each point."""
    seen = growing.observations_of(landmarks, keyframes)
    rows, places = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    order, point_index, kept = sorted_by_landmark(places, len(landmarks))
    slots = np.repeat(np.arange(len(keyframes), dtype=np.int32), [len(r) for r, _ in seen])
    pixels = np.concatenate([k.features.pixels[r] for k, (r, _) in zip(keyframes, seen, strict=True)])
    sigmas = np.concatenate([k.features.sigmas_px[r] for k, (r, _) in zip(keyframes, seen, strict=True)])
    ids = landmarks[kept]
    inverse = [k.vis_from_cam.inverse() for k in keyframes]
    problem = AdjustmentProblem(
        growing.camera,
        np.array([p.rotation for p in inverse]),
        np.array([p.translation_m for p in inverse]),
        is_fixed,
        growing.points[ids],
        slots[order],
        point_index,
        pixels[order],
        sigmas[order],
    )
    return problem, rows[order], ids


def _drop_outliers(
    growing: GrowingMap,
    keyframes: list[Keyframe],
    problem: AdjustmentProblem,
    features: NDArray[np.intp],
    ids: Ids,
    chi2: Array,
) -> None:
    """Take observations beyond 95 % out, and landmarks that are left with fewer than two."""
    bad = chi2 > CHI2_2DOF_95
    for slot in np.unique(problem.keyframe_index[bad]):
        growing.forget(keyframes[slot], features[bad & (problem.keyframe_index == slot)])
    kept = np.bincount(problem.point_index[~bad], minlength=len(problem.points))
    touched = np.unique(problem.point_index[bad])
    growing.kill(ids[touched[kept[touched] < 2]])


def sweep_young_landmarks(growing: GrowingMap, min_observations: int) -> None:
    """Drop landmarks that are rarely found where they should be, or never became more than a pair."""
    ids = growing.take_touched()
    age = len(growing.keyframes) - 1 - growing.reference[ids]
    is_young = age < _RECENT_KEYFRAMES - 1
    rarely = growing.found[ids] < _MIN_FOUND_RATIO * growing.visible[ids]
    lonely = ~is_young & (growing.observations[ids] < min_observations)
    growing.kill(ids[rarely | lonely])
    growing.touch(ids[is_young & ~rarely])


def median_depth(growing: GrowingMap, keyframe: Keyframe) -> float:
    """Median depth of the landmarks a keyframe sees, in vis units."""
    rays = growing.points[keyframe.landmarks()] - keyframe.vis_from_cam.translation_m
    return float(np.median(rays @ keyframe.vis_from_cam.rotation[:, 2])) if len(rays) else 0.0


def _neighbours(growing: GrowingMap, keyframe: Keyframe, count: int) -> list[Keyframe]:
    return [k for k, _ in growing.covisible(keyframe.landmarks()) if k is not keyframe][:count]


def _fundamental(K: Array, b_from_a: Pose) -> Array:
    """F with x_b^T F x_a = 0 (Hartley & Zisserman, 2nd ed., eq. 9.12)."""
    tx, ty, tz = b_from_a.translation_m
    skew = np.array([[0.0, -tz, ty], [tz, 0.0, -tx], [-ty, tx, 0.0]])
    K_inv = np.linalg.inv(K)
    return np.asarray(K_inv.T @ skew @ b_from_a.rotation @ K_inv)
