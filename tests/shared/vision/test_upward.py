"""Which way is up in an image: where poles lean, whatever the camera does."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.geometry import so3_exp
from fleetmap.vision.upward import upward_deg

PLAIN = Camera(640, 400, 500.0, 480.0, 319.5, 199.5)
BENT = Camera(640, 400, 300.0, 300.0, 319.5, 199.5, (-0.3, 0.09, 1e-3, -5e-4, -0.01))
FISHEYE = Camera(640, 400, 200.0, 200.0, 319.5, 199.5, (0.01, 0.002, -0.001, 0.0), "equidistant")
LEVEL_UP = np.array([0.0, -1.0, 0.0])


def poles(camera: Camera, turned: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Undistorted pixels of points in view, how poles on them lean in the image as recorded, and "up"."""
    rng = np.random.default_rng(seed)
    up = turned @ LEVEL_UP
    feet = np.column_stack([rng.uniform(-0.7, 0.7, 200), rng.uniform(-0.4, 0.4, 200), np.ones(200)])
    feet *= rng.uniform(2.0, 60.0, (200, 1))
    shown = camera.project(feet + 1e-4 * up) - camera.project(feet - 1e-4 * up)
    return camera.project_ideal(feet), np.degrees(np.arctan2(shown[:, 1], shown[:, 0])), up


def degrees_apart(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.abs((first - second + 180.0) % 360.0 - 180.0)


def test_a_level_camera_sees_up_upwards() -> None:
    pixels = np.array([[10.0, 10.0], [320.0, 200.0], [630.0, 390.0]])
    assert upward_deg(PLAIN, pixels, LEVEL_UP) == pytest.approx([-90.0] * 3)


def test_a_camera_on_its_right_side_sees_up_to_the_left() -> None:
    up = so3_exp(np.array([0.0, 0.0, -np.pi / 2])) @ LEVEL_UP
    assert degrees_apart(upward_deg(PLAIN, np.array([[320.0, 200.0]]), up), np.array([180.0])) < 1e-9


@pytest.mark.parametrize("camera", [PLAIN, BENT, FISHEYE])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.2, 0.1, -0.3), (-0.4, 0.0, 2.5)])
def test_poles_lean_as_told(camera: Camera, turn: tuple[float, float, float]) -> None:
    pixels, leaning, up = poles(camera, so3_exp(np.array(turn)))
    assert degrees_apart(upward_deg(camera, pixels, up), leaning).max() < 0.1


def test_each_pixel_may_have_an_up_of_its_own() -> None:
    ups = so3_exp(np.random.default_rng(1).normal(0.0, 0.3, (5, 3))) @ LEVEL_UP
    pixels = np.random.default_rng(2).uniform(50.0, 350.0, (5, 2))
    one_by_one = [upward_deg(BENT, pixels[n : n + 1], ups[n])[0] for n in range(5)]
    assert upward_deg(BENT, pixels, ups) == pytest.approx(one_by_one)


def test_looking_straight_up_any_direction_will_do() -> None:
    ahead = np.array([0.0, 0.0, 1.0])
    assert np.isfinite(upward_deg(PLAIN, np.array([[319.5, 199.5]]), ahead)).all()
