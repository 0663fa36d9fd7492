"""Absolute pose: truth known, outliers mixed in, and a covariance that means what it says."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, rotation_angle_rad, so3_exp, so3_log
from fleetmap.vision.absolute_pose import (
    AbsolutePose,
    AbsolutePoseSettings,
    estimate_absolute_pose,
    refine_absolute_pose,
)

CAMERA = Camera(1242, 375, 720.0, 721.0, 610.0, 172.0)
TRUTH = Pose(so3_exp(np.array([1.4, -0.3, 0.2])), np.array([812.4, -1310.2, 14.5]))


class Scene:
    """Points in front of the true camera, seen with noise; the last ones are outliers."""

    def __init__(self, count: int, outlier_share: float, seed: int, noise: float = 1.0) -> None:
        rng = np.random.default_rng(seed)
        depth = rng.uniform(4.0, 60.0, count)
        ideal = np.c_[rng.uniform(0, CAMERA.width_px, count), rng.uniform(0, CAMERA.height_px, count)]
        rays = np.c_[(ideal - (CAMERA.cx_px, CAMERA.cy_px)) / (CAMERA.fx_px, CAMERA.fy_px), np.ones(count)]
        self.points_m = TRUTH.transform(rays * depth[:, None])
        self.sigmas_px = 1.2 ** rng.integers(0, 6, count).astype(float)
        self.pixels = ideal + noise * self.sigmas_px[:, None] * rng.normal(size=(count, 2))
        self.is_true = np.arange(count) < round(count * (1.0 - outlier_share))
        wrong = ~self.is_true
        self.pixels[wrong] = np.c_[
            rng.uniform(0, CAMERA.width_px, wrong.sum()), rng.uniform(0, CAMERA.height_px, wrong.sum())
        ]

    def estimate(self, settings: AbsolutePoseSettings | None = None) -> AbsolutePose | None:
        return estimate_absolute_pose(self.pixels, self.points_m, self.sigmas_px, CAMERA, settings)

    def refine(self, initial: Pose) -> AbsolutePose | None:
        return refine_absolute_pose(self.pixels, self.points_m, self.sigmas_px, CAMERA, initial)


def tangent_error(pose: Pose) -> np.ndarray:
    """xi with TRUTH = pose @ exp(xi), to first order in the translation."""
    difference = pose.inverse() @ TRUTH
    return np.r_[so3_log(difference.rotation), difference.translation_m]


def test_a_pose_from_nothing_among_forty_percent_outliers() -> None:
    scene = Scene(300, outlier_share=0.4, seed=1)
    answer = scene.estimate()
    assert answer is not None
    error = tangent_error(answer.map_from_cam)
    assert 0.0 < np.linalg.norm(error[3:]) < 0.05
    assert 0.0 < np.degrees(np.linalg.norm(error[:3])) < 0.1
    assert answer.inliers[scene.is_true].mean() > 0.88  # 95 % by construction of the gate
    assert answer.inliers[~scene.is_true].mean() < 0.1
    assert answer.inlier_count == answer.inliers.sum()


def test_without_noise_the_pose_is_exact() -> None:
    answer = Scene(100, outlier_share=0.0, seed=2, noise=0.0).estimate()
    assert answer is not None
    assert answer.inlier_count == 100
    assert np.linalg.norm(tangent_error(answer.map_from_cam)) < 1e-7


def test_refinement_finds_the_pose_from_a_poor_guess() -> None:
    scene = Scene(300, outlier_share=0.4, seed=3)
    offset = Pose(so3_exp(np.radians([1.0, -1.5, 1.0])), np.array([0.3, -0.2, 0.6]))
    answer = scene.refine(TRUTH @ offset)
    assert answer is not None
    assert np.linalg.norm(answer.map_from_cam.translation_m - TRUTH.translation_m) < 0.05
    assert rotation_angle_rad(answer.map_from_cam.rotation.T @ TRUTH.rotation) < 2e-3
    assert answer.inliers[scene.is_true].mean() > 0.88


def test_refinement_and_ransac_agree() -> None:
    scene = Scene(200, outlier_share=0.3, seed=4)
    from_nothing, from_truth = scene.estimate(), scene.refine(TRUTH)
    assert from_nothing is not None
    assert from_truth is not None
    shift = from_nothing.map_from_cam.translation_m - from_truth.map_from_cam.translation_m
    assert np.linalg.norm(shift) < 2e-3


@pytest.mark.parametrize("noise", [1.0, 2.0])
def test_the_covariance_is_consistent_over_many_draws(noise: float) -> None:
    """Mean NEES of six degrees of freedom is 6; the inlier gate cuts the noise's tails, so a little more."""
    errors, covariances = [], []
    for seed in range(200):
        answer = Scene(60, outlier_share=0.0, seed=seed, noise=noise).refine(TRUTH)
        assert answer is not None
        errors.append(tangent_error(answer.map_from_cam))
        covariances.append(answer.covariance)
    nees = [e @ np.linalg.solve(P, e) for e, P in zip(errors, covariances, strict=True)]
    assert 4.5 < np.mean(nees) < 9.0
    spread, predicted = np.std(errors, axis=0), np.sqrt(np.mean([np.diag(P) for P in covariances], axis=0))
    assert np.all(spread / predicted < 1.5)
    assert np.all(spread / predicted > 0.8)


def test_points_behind_the_camera_are_outliers() -> None:
    scene = Scene(100, outlier_share=0.0, seed=5)
    behind = TRUTH.transform(-TRUTH.inverse().transform(scene.points_m[:30]))
    scene.points_m[:30] = behind  # the same pixels by the pinhole equation
    answer = scene.refine(TRUTH)
    assert answer is not None
    assert not np.any(answer.inliers[:30])
    assert answer.inliers[30:].mean() > 0.88
    assert np.linalg.norm(answer.map_from_cam.translation_m - TRUTH.translation_m) < 0.1


def test_the_same_input_gives_the_same_pose_bit_by_bit() -> None:
    first, second = Scene(200, 0.5, seed=6).estimate(), Scene(200, 0.5, seed=6).estimate()
    assert first is not None
    assert second is not None
    assert np.array_equal(first.map_from_cam.rotation, second.map_from_cam.rotation)
    assert np.array_equal(first.map_from_cam.translation_m, second.map_from_cam.translation_m)
    assert np.array_equal(first.covariance, second.covariance)


def test_pixels_that_mean_nothing_give_no_pose() -> None:
    for seed in range(5):
        assert Scene(200, outlier_share=1.0, seed=seed).estimate(AbsolutePoseSettings(min_inliers=20)) is None


def test_too_few_points_give_no_pose() -> None:
    assert Scene(6, outlier_share=0.0, seed=8).estimate() is None
    assert Scene(0, outlier_share=0.0, seed=8).refine(TRUTH) is None


def test_points_that_do_not_fix_the_pose_give_none() -> None:
    scene = Scene(40, outlier_share=0.0, seed=9)
    scene.points_m[:] = scene.points_m[0]
    scene.pixels[:] = CAMERA.project_ideal(TRUTH.inverse().transform(scene.points_m))
    assert scene.refine(TRUTH) is None
