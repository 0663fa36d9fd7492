from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleetmap.camera import Camera
from fleetmap.distortion import coefficient_jacobian, distort, jacobian
from fleetmap.errors import CalibrationError

KITTI = Camera(
    1392, 512, 984.2439, 980.8141, 690.0, 233.1966, (-0.3728755, 0.2037299, 0.002219, 0.0013837, -0.0723)
)
IDEAL = Camera(640, 480, 500.0, 510.0, 319.5, 239.5)

pixels_of_kitti = st.tuples(st.floats(0.0, 1391.0), st.floats(0.0, 511.0))


@given(st.lists(pixels_of_kitti, min_size=1, max_size=20), st.floats(0.5, 100.0))
def test_unproject_and_project_are_inverses_all_over_a_real_wide_image(pixels, depth_m):
    pixels = np.array(pixels)
    rays = KITTI.unproject(pixels)
    assert rays[:, 2] == pytest.approx(np.ones(len(pixels)))
    assert np.abs(KITTI.project(depth_m * rays) - pixels).max() < 1e-3


@given(st.lists(pixels_of_kitti, min_size=1, max_size=20))
def test_undistorted_pixels_are_what_the_ideal_camera_sees(pixels):
    rays = KITTI.unproject(np.array(pixels))
    assert np.allclose(KITTI.project_ideal(rays), KITTI.undistort(np.array(pixels)), atol=1e-9)


def test_projection_agrees_with_opencv():
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(-3, 3, 200), rng.uniform(-1, 1, 200), rng.uniform(5, 20, 200)], axis=1)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), KITTI.matrix, np.array(KITTI.distortion))
    assert np.abs(KITTI.project(points) - expected.reshape(-1, 2)).max() < 1e-9
    assert np.abs(KITTI.project(points) - KITTI.project_ideal(points)).max() > 5.0  # distortion is not small here


def test_a_point_on_the_axis_is_the_principal_point():
    assert IDEAL.project(np.array([[0.0, 0.0, 7.0]])) == pytest.approx(np.array([[319.5, 239.5]]))


def test_right_is_x_and_down_is_y():
    (pixel,) = IDEAL.project(np.array([[1.0, 1.0, 10.0]]))
    assert pixel == pytest.approx([369.5, 290.5])


@pytest.mark.parametrize("depth_m", [0.0, -5.0, float("nan")])
def test_points_not_in_front_have_no_pixel(depth_m):
    for camera in (IDEAL, KITTI):
        assert np.isnan(camera.project(np.array([[1.0, 1.0, depth_m]]))).all()
        assert np.isnan(camera.project_ideal(np.array([[1.0, 1.0, depth_m]]))).all()


def test_without_distortion_undistorting_changes_nothing():
    pixels = np.array([[0.0, 0.0], [639.0, 479.0]])
    assert np.array_equal(IDEAL.undistort(pixels), pixels)


def test_the_image_ends_at_the_centres_of_its_outer_pixels():
    pixels = np.array([[0.0, 0.0], [639.0, 479.0], [-0.1, 5.0], [639.1, 5.0], [5.0, 479.1], [np.nan, 5.0]])
    assert IDEAL.is_inside(pixels).tolist() == [True, True, False, False, False, False]
    assert IDEAL.is_inside(np.array([[9.9, 50.0], [10.0, 50.0]]), border_px=10.0).tolist() == [False, True]


@pytest.mark.parametrize(
    "numbers",
    [
        (0, 480, 500.0, 500.0, 320.0, 240.0),
        (640, -1, 500.0, 500.0, 320.0, 240.0),
        (640, 480, 0.0, 500.0, 320.0, 240.0),
        (640, 480, 500.0, -1.0, 320.0, 240.0),
        (640, 480, float("nan"), 500.0, 320.0, 240.0),
        (640, 480, 500.0, 500.0, float("inf"), 240.0),
    ],
)
def test_a_camera_that_cannot_be_is_refused(numbers):
    with pytest.raises(CalibrationError, match="not usable"):
        Camera(*numbers)


RATIONAL = Camera(
    1280, 720, 640.5, 641.5, 639.5, 359.5, (0.6, 0.25, 1e-3, -5e-4, 0.02, 0.8, 0.3, 0.05), "rational_polynomial"
)
FISHEYE = Camera(752, 480, 320.97, 320.95, 367.2, 248.4, (-0.0036, 0.0008, -0.0203, 0.0129), "equidistant")
WIDE = Camera(1000, 1000, 300.0, 300.0, 499.5, 499.5, distortion_model="equidistant")  # 190 deg corner to corner


@pytest.mark.parametrize("camera", [RATIONAL, FISHEYE], ids=["rational_polynomial", "equidistant"])
def test_unproject_and_project_are_inverses_for_every_model(camera):
    x, y = np.meshgrid(np.linspace(0, camera.width_px - 1, 40), np.linspace(0, camera.height_px - 1, 30))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    rays = camera.unproject(pixels)
    imaged = np.isfinite(rays).all(axis=1)
    assert imaged.mean() > 0.9
    assert np.abs(camera.project(3.0 * rays[imaged]) - pixels[imaged]).max() < 1e-6
    assert np.allclose(camera.project_ideal(rays[imaged]), camera.undistort(pixels[imaged]), atol=1e-6)


def test_the_rational_model_agrees_with_opencv():
    rng = np.random.default_rng(1)
    points = np.stack([rng.uniform(-4, 4, 200), rng.uniform(-2, 2, 200), rng.uniform(4, 20, 200)], axis=1)
    zero = np.zeros(3)
    expected, _ = cv2.projectPoints(points, zero, zero, RATIONAL.matrix, np.array(RATIONAL.distortion))
    assert np.abs(RATIONAL.project(points) - expected.reshape(-1, 2)).max() < 1e-9


def test_the_equidistant_model_agrees_with_opencv():
    rng = np.random.default_rng(2)
    points = np.stack([rng.uniform(-4, 4, 200), rng.uniform(-2, 2, 200), rng.uniform(1, 20, 200)], axis=1)
    zero = np.zeros(3)
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], zero, zero, FISHEYE.matrix, np.array(FISHEYE.distortion)
    )
    assert np.abs(FISHEYE.project(points) - expected.reshape(-1, 2)).max() < 1e-9


def test_an_equidistant_lens_bends_the_image_also_without_coefficients():
    assert WIDE.has_distortion
    (pixel,) = WIDE.project(np.array([[1.0, 0.0, 1.0]]))  # 45 degrees off axis
    assert pixel == pytest.approx([499.5 + 300.0 * np.pi / 4.0, 499.5])


def test_what_lies_beside_and_behind_an_equidistant_lens_has_no_ray_in_front():
    assert np.isnan(WIDE.unproject(np.array([[0.0, 0.0]]))[0, :2]).all()
    assert np.isfinite(WIDE.unproject(np.array([[499.5, 80.0], [100.0, 499.5]]))).all()


@pytest.mark.parametrize("k1", [-0.37, -0.2])
def test_points_beyond_where_the_polynomial_turns_back_have_no_pixel(k1):
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, (k1, 0.0, 0.0, 0.0, 0.0))
    turning = 1.0 / np.sqrt(-3.0 * k1)
    inside, outside = camera.project(np.array([[0.99 * turning, 0.0, 1.0], [1.01 * turning, 0.0, 1.0]]))
    assert np.isfinite(inside).all()
    assert np.isnan(outside).all()


@pytest.mark.parametrize(
    ("distortion", "model"), [((0.1,) * 4, "plumb_bob"), ((0.1,) * 5, "rational_polynomial"), ((), "omni")]
)
def test_a_model_that_is_unknown_or_short_of_coefficients_is_refused(distortion, model):
    with pytest.raises(CalibrationError, match=model):
        Camera(640, 480, 500.0, 500.0, 319.5, 239.5, distortion, model)


FISHEYE = Camera(960, 600, 420.0, 425.0, 483.0, 296.0, (0.02, -0.005, 0.001, 0.0), "equidistant")
RATIONAL = Camera(
    960, 600, 480.0, 470.0, 479.5, 299.5, (0.6, 0.05, 3e-4, -2e-4, 0.002, 0.95, 0.2, 0.01), "rational_polynomial"
)
LENSES = pytest.mark.parametrize("camera", [KITTI, RATIONAL, FISHEYE], ids=lambda c: c.distortion_model)


def pixels_all_over(camera: Camera, count: int = 60) -> np.ndarray:
    size = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
    pixels = np.random.default_rng(7).uniform(0.0, 1.0, (count, 2)) * size
    return pixels[camera.is_within_reach(camera.undistort(pixels))]


@LENSES
def test_distorting_and_undistorting_pixels_are_inverses(camera):
    pixels = pixels_all_over(camera)
    ideal = camera.undistort(pixels)
    assert np.abs(ideal - pixels).max() > 5.0
    assert np.abs(camera.distort(ideal) - pixels).max() < 1e-6


@LENSES
def test_the_magnification_is_the_spread_of_undistorted_noise(camera):
    rng = np.random.default_rng(1)
    for pixel in pixels_all_over(camera)[:12]:
        noisy = camera.undistort(pixel + rng.normal(0.0, 0.02, (4000, 2)))
        spread = float(np.linalg.det(np.cov(noisy.T)) ** 0.25) / 0.02  # of the two axes, the geometric mean
        assert camera.magnification(camera.undistort(pixel[None]))[0] == pytest.approx(spread, rel=0.04)


def test_without_distortion_nothing_is_magnified():
    assert camera_magnification_is_one(IDEAL)
    assert camera_magnification_is_one(Camera(640, 480, 500.0, 250.0, 319.5, 239.5))


def camera_magnification_is_one(camera: Camera) -> bool:
    return bool((camera.magnification(pixels_all_over(camera)) == 1.0).all())


@LENSES
def test_derivatives_of_the_lens_agree_with_differences(camera):
    model, coefficients = camera.distortion_model, camera.distortion
    points = np.random.default_rng(2).uniform(-0.5, 0.5, (40, 2))
    step = 1e-6
    by_point = [
        (distort(model, coefficients, points + step * e) - distort(model, coefficients, points - step * e))
        for e in np.eye(2)
    ]
    assert np.abs(jacobian(model, coefficients, points) - np.stack(by_point, axis=2) / (2 * step)).max() < 1e-8

    def bent(change: np.ndarray) -> np.ndarray:
        return distort(model, tuple((np.array(coefficients) + change).tolist()), points)

    by_coefficient = [bent(step * e) - bent(-step * e) for e in np.eye(len(coefficients))]
    expected = np.stack(by_coefficient, axis=2) / (2 * step)
    assert np.abs(coefficient_jacobian(model, coefficients, points) - expected).max() < 1e-8


def test_what_a_fisheye_lens_sees_far_off_its_axis_is_out_of_reach():
    camera = Camera(960, 600, 323.5, 323.5, 479.5, 299.5, (), "equidistant")  # 170 degrees across
    pixels = np.array([[479.5 + 323.5 * np.radians(angle), 299.5] for angle in (0.0, 74.0, 76.0, 84.0)])
    assert camera.is_within_reach(camera.undistort(pixels)).tolist() == [True, True, False, False]
    left, top, right, bottom = camera.ideal_bounds_px
    ideal = camera.undistort(pixels[:2])
    assert np.all((left < ideal[:, 0]) & (ideal[:, 0] < right) & (top < ideal[:, 1]) & (ideal[:, 1] < bottom))
    assert right < 479.5 + 323.5 * np.tan(np.radians(77.0))
