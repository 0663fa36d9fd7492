"""Covariances mean what they say: over draws of noise, landmarks and maps, the truth lies where they put it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.evaluation.consistency import Nees, normalised_estimation_error_squared
from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Pose, so3_exp, so3_log
from fleetmap.vision.absolute_pose import refine_absolute_pose
from fleetmap.visual_map import Keyframes, Landmarks, LocalizationMap
from fleetmap_localizer.gate import Fit
from fleetmap_localizer.image_uncertainty import relative_covariance
from fleetmap_localizer.map_view import LocalizableMap, MapView
from fleetmap_localizer.pose_uncertainty import map_covariance, pose_covariance
from fleetmap_localizer.relocalization import Located
from fleetmap_localizer.settings import LocalizerSettings

CAMERA = Camera(1242, 375, 720.0, 721.0, 610.0, 172.0)
TRUTH = Pose(so3_exp(np.array([1.4, -0.3, 0.2])), np.array([812.4, -1310.2, 14.5]))
KEYFRAME_FROM_CAM = Pose(so3_exp(np.array([0.02, -0.1, 0.01])), np.array([1.2, -0.1, 2.5]))
DRAWS = 80


@dataclass(frozen=True)
class Noise:
    """How matches and landmarks err."""

    white: float = 0.7  # of each match, in sigmas of its octave
    common_px: float = 0.0  # smooth over the image
    across_m: float = 0.0  # of landmarks: across the ray and along it
    along_m: float = 0.0


def draw(noise: Noise, seed: int, count: int = 120) -> tuple[Fit, Landmarks]:
    """Landmarks of a map, and the fit of one image to them."""
    rng = np.random.default_rng(seed)
    pixels = np.c_[rng.uniform(0, CAMERA.width_px, count), rng.uniform(0, CAMERA.height_px, count)]
    rays = np.c_[(pixels - (CAMERA.cx_px, CAMERA.cy_px)) / (CAMERA.fx_px, CAMERA.fy_px), np.ones(count)]
    true_points_m = TRUTH.transform(rays * rng.uniform(5.0, 50.0, count)[:, None])
    normals = TRUTH.translation_m - true_points_m
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    errors_m = rng.normal(0.0, noise.across_m, (count, 3))
    errors_m += (
        normals * (rng.normal(0.0, noise.along_m, count) - np.einsum("ni,ni->n", errors_m, normals))[:, None]
    )
    sigmas_m = np.tile(np.array([noise.across_m, noise.along_m], np.float32), (count, 1))
    landmarks = Landmarks(
        true_points_m + errors_m,
        np.zeros((count, 32), np.uint8),
        normals.astype(np.float32),
        np.zeros(count, np.uint8),
        np.ones(count, np.float32),
        sigmas_m,
    )
    sigmas_px = 1.2 ** rng.integers(0, 6, count).astype(float)
    seen = pixels + noise.white * sigmas_px[:, None] * rng.normal(size=(count, 2))
    seen += noise.common_px * smooth_field(pixels, rng)
    answer = refine_absolute_pose(seen, landmarks.points_m, sigmas_px, CAMERA, TRUTH)
    assert answer is not None
    return Fit(answer, np.arange(count), seen, sigmas_px, pixels, pixels), landmarks


def smooth_field(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """An exponentially correlated error of unit variance at each pixel (N, 2), without any grid."""
    away = np.linalg.norm(pixels[:, None] - pixels, axis=2) / (0.3 * CAMERA.width_px)
    return np.asarray(
        np.linalg.cholesky(np.exp(-away) + 1e-9 * np.eye(len(pixels))) @ rng.normal(size=pixels.shape)
    )


def tangent_error(pose: Pose, truth: Pose = TRUTH) -> np.ndarray:
    difference = pose.inverse() @ truth
    return np.r_[so3_log(difference.rotation), difference.translation_m]


def nees_of(errors: list[np.ndarray], covariances: list[np.ndarray]) -> Nees:
    return Nees(normalised_estimation_error_squared(np.array(errors), np.array(covariances)), dof=6)


@pytest.mark.parametrize(
    "noise",
    [
        Noise(),
        Noise(white=0.3),
        Noise(common_px=0.5),
        Noise(common_px=1.5),
        Noise(white=0.3, across_m=0.03, along_m=0.6),
        Noise(common_px=0.5, across_m=0.02, along_m=0.3),
    ],
    ids=str,
)
def test_the_covariance_relative_to_the_map_is_neither_too_small_nor_too_large(noise: Noise) -> None:
    errors, covariances = [], []
    for seed in range(DRAWS):
        fit, landmarks = draw(noise, seed)
        errors.append(tangent_error(fit.answer.map_from_cam))
        covariances.append(relative_covariance(fit, landmarks, CAMERA))
    nees = nees_of(errors, covariances)
    assert 3.5 < nees.mean < 9.5
    assert 0.7 < nees.inside_95 <= 1.0


def test_errors_that_landmarks_share_make_a_covariance_of_independent_ones_too_small() -> None:
    """What the two-sided bounds above are worth: the solver's own covariance is far outside of them."""
    fits = [draw(Noise(common_px=1.5), seed)[0] for seed in range(DRAWS)]
    nees = nees_of([tangent_error(f.answer.map_from_cam) for f in fits], [f.answer.covariance for f in fits])
    assert nees.mean > 30.0


def test_more_landmarks_do_not_average_shared_errors_away() -> None:
    few, many = (position_sigma_m(Noise(white=0.1, common_px=1.0), count) for count in (100, 800))
    assert 0.7 < many / few < 1.1
    few, many = (position_sigma_m(Noise(), count) for count in (100, 800))
    assert 0.25 < many / few < 0.6


def position_sigma_m(noise: Noise, count: int) -> float:
    drawn = [draw(noise, seed, count) for seed in range(12)]
    return float(np.median([np.sqrt(np.trace(relative_covariance(f, each, CAMERA)[3:, 3:])) for f, each in drawn]))


def located(fit: Fit, landmarks: Landmarks, covariances: np.ndarray | None, map_from_keyframe: Pose) -> Located:
    """A fit in a map of two keyframes; the second saw the landmarks, too, and stands far away."""
    far = Pose(map_from_keyframe.rotation, map_from_keyframe.translation_m + np.array([40.0, 0.0, 0.0]))
    poses, count = (map_from_keyframe, far), len(landmarks)
    keyframes = Keyframes(
        np.array([1, 2]),
        np.array([p.rotation for p in poses]),
        np.array([p.translation_m for p in poses]),
        covariances,
    )
    content = LocalizationMap(
        UtmAnchor(32632, 600_000, 5_400_000, 400),
        keyframes,
        landmarks,
        np.repeat([0, 1], count).astype(np.int32),
        np.tile(np.arange(count), 2).astype(np.int32),
    )
    return Located(MapView(LocalizableMap("m", "v", CAMERA, content), CAMERA, LocalizerSettings()), fit)


def keyframe_covariances() -> np.ndarray:
    """Of the near keyframe, with all correlations; the far one is far worse."""
    root = np.diag([0.01, 0.02, 0.03, 0.2, 0.1, 0.15]) @ (np.eye(6) + 0.4 * np.tri(6, k=-1))
    near = root @ root.T
    return np.array([near, 25.0 * near], np.float32)


def test_the_covariance_in_the_world_holds_when_the_map_errs_as_its_keyframes_say() -> None:
    covariances = keyframe_covariances()
    root = np.linalg.cholesky(covariances[0].astype(float))
    errors, estimates, alone = [], [], []
    for seed in range(DRAWS):
        fit, landmarks = draw(Noise(common_px=0.5), seed)
        keyframe = TRUTH @ KEYFRAME_FROM_CAM.inverse()
        xi = root @ np.random.default_rng(seed + 10_000).normal(size=6)
        moved = keyframe @ Pose(so3_exp(xi[:3]), xi[3:]) @ keyframe.inverse()  # the map is rigid around it
        answer = located(fit, landmarks, covariances, keyframe)
        errors.append(tangent_error(fit.answer.map_from_cam, moved @ TRUTH))
        covariance = relative_covariance(fit, landmarks, CAMERA)
        answer = replace(answer, fit=replace(fit, answer=replace(fit.answer, covariance=covariance)))
        estimates.append(pose_covariance(answer))
        alone.append(covariance)
    nees = nees_of(errors, estimates)
    assert 4.5 < nees.mean < 7.5
    assert 0.88 < nees.inside_95 <= 0.99
    assert nees_of(errors, alone).mean > 100.0


def test_a_map_that_does_not_know_its_own_exactness_counts_as_true() -> None:
    fit, landmarks = draw(Noise(), 0)
    assert np.array_equal(map_covariance(located(fit, landmarks, None, TRUTH)), np.zeros((6, 6)))


def test_where_no_fix_holds_the_nearest_keyframe_another_stands_for_it_and_without_any_all_is_open() -> None:
    fit, landmarks = draw(Noise(), 0)
    covariances = keyframe_covariances()
    covariances[0] = np.nan
    known = map_covariance(located(fit, landmarks, covariances, TRUTH))
    assert np.linalg.eigvalsh(known)[0] > 0.0
    assert np.sqrt(np.trace(known[3:, 3:])) > 0.5
    covariances[1] = np.nan
    assert np.sqrt(map_covariance(located(fit, landmarks, covariances, TRUTH))[3, 3]) > 100.0
