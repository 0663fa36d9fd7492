"""Points from two views, against points that are known."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, so3_exp
from fleetmap_mapper.triangulation import is_consistent, parallax_rad, triangulate

CAMERA = Camera(640, 400, 430.0, 435.0, 322.0, 197.0)
FIRST = Pose(so3_exp(np.array([0.02, -0.3, 0.01])), np.array([3.0, -1.0, 0.5]))
SECOND = FIRST @ Pose(so3_exp(np.array([0.01, 0.05, -0.02])), np.array([0.6, 0.1, 0.9]))


def points_before(pose: Pose, count: int = 500, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    in_cam = np.stack([rng.uniform(-3, 3, count), rng.uniform(-2, 2, count), rng.uniform(6, 20, count)], axis=1)
    return pose.transform(in_cam)


def pixels_of(pose: Pose, points: np.ndarray) -> np.ndarray:
    return CAMERA.project_ideal(pose.inverse().transform(points))


def test_points_come_back_from_their_pixels():
    points = points_before(FIRST)
    found = triangulate(CAMERA, FIRST, pixels_of(FIRST, points), SECOND, pixels_of(SECOND, points))
    np.testing.assert_allclose(found, points, atol=1e-7)


def test_with_a_pixel_of_noise_points_scatter_about_the_truth():
    points = points_before(FIRST)
    rng = np.random.default_rng(1)
    noisy = [pixels_of(pose, points) + rng.normal(0.0, 0.3, (len(points), 2)) for pose in (FIRST, SECOND)]
    errors = np.linalg.norm(triangulate(CAMERA, FIRST, noisy[0], SECOND, noisy[1]) - points, axis=1)
    assert 0.01 < np.median(errors) < 0.5


def test_parallel_rays_make_no_point_that_is_believed():
    beside = FIRST @ Pose(np.eye(3), np.array([1.0, 0.0, 0.0]))
    pixels = np.random.default_rng(3).uniform([0.0, 0.0], [639.0, 399.0], (2000, 2))
    found = triangulate(CAMERA, FIRST, pixels, beside, pixels)
    parallax = parallax_rad(found, FIRST.translation_m, beside.translation_m)
    believed = is_consistent(CAMERA, FIRST, found, pixels, np.ones(2000)) & (parallax > 1e-4)
    assert not believed.any()
    same_place = triangulate(CAMERA, FIRST, pixels, FIRST, pixels)
    assert not np.isinf(same_place).any()
    assert not is_consistent(CAMERA, FIRST, same_place, pixels, np.ones(2000)).any()


def test_parallax_is_the_angle_at_the_point():
    a, b = np.array([-1.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 100.0], [5.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(
        parallax_rad(points, a, b), [np.pi / 2, 2 * np.arctan(0.01), 0.0, np.pi], atol=1e-12
    )
    assert np.isnan(parallax_rad(np.full((1, 3), np.nan), a, b)).all()


@pytest.mark.parametrize("sigma_px", [0.5, 1.0, 2.5])
def test_nineteen_of_twenty_good_pixels_are_believed(sigma_px):
    points = points_before(FIRST, 20_000)
    noise = np.random.default_rng(2).normal(0.0, sigma_px, (len(points), 2))
    believed = is_consistent(
        CAMERA, FIRST, points, pixels_of(FIRST, points) + noise, np.full(len(points), sigma_px)
    )
    assert 0.945 < believed.mean() < 0.955


def test_a_point_behind_the_camera_is_not_believed():
    in_cam = np.array([[1.0, 0.5, 10.0]])
    pixels = CAMERA.project_ideal(in_cam)
    assert is_consistent(CAMERA, FIRST, FIRST.transform(in_cam), pixels, np.ones(1)).all()
    assert not is_consistent(CAMERA, FIRST, FIRST.transform(-in_cam), pixels, np.ones(1)).any()
