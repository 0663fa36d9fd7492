"""A rolling shutter leans what passes sideways, by as much as it moves while the rows are read."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, so3_exp
from fleetmap.simulation.atlas import build_atlas
from fleetmap.simulation.look import Look
from fleetmap.simulation.rendering import render, render_rolling_shutter
from fleetmap.simulation.surfaces import SurfaceBuilder
from fleetmap.simulation.world import Scene

CLEAN = Look(noise_sigma=0.0, blur_sigma_px=0.0, vignetting=0.0)
CAMERA = Camera(320, 240, 200.0, 200.0, 159.5, 119.5)


def _pole(distance_m: float = 4.0) -> Scene:
    """A dark vertical pole, 0.2 m wide and taller than the image, straight ahead."""
    builder = SurfaceBuilder(np.array([0.0, 0.0, 1.0]))
    corners = np.array([[-0.1, -9.0, 0.0], [0.1, -9.0, 0.0], [0.1, 9.0, 0.0], [-0.1, 9.0, 0.0]])
    texture = builder.add_texture(np.full((64, 64), 38, np.uint8))
    builder.add_quad(corners + np.array([0.0, 0.0, distance_m]), texture, lit=False)
    return Scene(builder.surfaces(), build_atlas(builder.textures))


def _middle_px(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Column of the pole's middle in each row."""
    dark = (238.0 - image) / 200.0
    return np.asarray(dark @ np.arange(image.shape[1]) / dark.sum(axis=1))


def test_a_pole_leans_when_the_camera_moves_sideways() -> None:
    first, last = Pose.identity(), Pose(np.eye(3), np.array([0.4, 0.0, 0.0]))
    middle = _middle_px(render_rolling_shutter(_pole(), CAMERA, first, last, CLEAN))
    expected = 159.5 - 200.0 * 0.4 / 4.0 * np.arange(240) / 239.0
    assert np.abs(middle - expected).max() < 0.3
    lean_deg = np.degrees(np.arctan(np.polyfit(np.arange(240), middle, 1)[0]))
    assert abs(lean_deg - np.degrees(np.arctan(-20.0 / 239.0))) < 0.05


def test_a_pole_leans_when_the_camera_turns() -> None:
    first, last = (Pose(so3_exp(np.array([0.0, yaw, 0.0])), np.zeros(3)) for yaw in (-0.02, 0.04))
    middle = _middle_px(render_rolling_shutter(_pole(), CAMERA, first, last, CLEAN))
    yaw = -0.02 + 0.06 * np.arange(240) / 239.0
    assert np.abs(middle - (159.5 - 200.0 * np.tan(yaw))).max() < 0.3


def test_without_motion_it_is_the_image_of_a_global_shutter() -> None:
    pose = Pose(so3_exp(np.array([0.1, 0.2, 0.3])), np.array([0.1, 0.0, 0.0]))
    look = Look(seed=3)
    rolling = render_rolling_shutter(_pole(), CAMERA, pose, pose, look)
    difference = np.abs(rolling.astype(int) - render(_pole(), CAMERA, pose, look))
    assert np.mean(difference > 1) < 1e-4  # interpolated poses differ in the last bits
