"""Wet ground shows the mirror image of what stands on it, where optics say, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, so3_exp
from fleetmap.simulation.atlas import build_atlas
from fleetmap.simulation.look import Look
from fleetmap.simulation.rendering import cast_rays, render
from fleetmap.simulation.surfaces import SurfaceBuilder
from fleetmap.simulation.wetness import road_plane
from fleetmap.simulation.world import Scene

DRY = Look(noise_sigma=0.0, blur_sigma_px=0.0, vignetting=0.0)
WET = replace(DRY, wetness=1.0)
CAMERA = Camera(320, 240, 220.0, 220.0, 159.5, 119.5)
EYE_M, BOARD_M = 1.5, 20.0
_LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # looks north


@pytest.fixture(scope="module", params=[0.0, 0.08], ids=["level", "uphill"])
def map_from_world(request: pytest.FixtureRequest) -> Pose:
    """The scene stands upright, or the whole of it is tilted as on a hill."""
    return Pose(so3_exp(np.array([request.param, 0.0, 0.0])), np.array([300.0, -200.0, 12.0]))


def _road(map_from_world: Pose, board_grey: int | None) -> Scene:
    """A flat dark road to the north and on it, 20 m ahead, a board from 1 to 3 m above it."""
    builder = SurfaceBuilder(np.array([0.0, 0.0, 1.0]))
    ground = np.array([[-50.0, 90.0, 0.0], [50.0, 90.0, 0.0], [50.0, -10.0, 0.0], [-50.0, -10.0, 0.0]])
    upright = np.array([[-2.0, BOARD_M, 3.0], [2.0, BOARD_M, 3.0], [2.0, BOARD_M, 1.0], [-2.0, BOARD_M, 1.0]])
    for corners, grey in ((ground, 60), (upright, board_grey)):
        if grey is not None:
            texture = builder.add_texture(np.full((64, 64), grey, np.uint8))
            builder.add_quad(map_from_world.transform(corners), texture, lit=False)
    return Scene(builder.surfaces(), build_atlas(builder.textures))


@pytest.fixture(scope="module")
def scene(map_from_world: Pose) -> Scene:
    return _road(map_from_world, 10)


@pytest.fixture(scope="module")
def map_from_cam(map_from_world: Pose) -> Pose:
    return map_from_world @ Pose(_LEVEL, np.array([0.0, 0.0, EYE_M]))


def _row(height_m: float) -> int:
    return round(CAMERA.cy_px + CAMERA.fy_px * (EYE_M - height_m) / BOARD_M)


def test_the_plane_is_that_of_the_road(scene: Scene, map_from_cam: Pose, map_from_world: Pose) -> None:
    from_here = Pose(np.eye(3), map_from_cam.translation_m)
    plane = road_plane(lambda rays: cast_rays(scene, from_here, rays), map_from_cam)
    assert plane is not None
    normal, offset = plane
    np.testing.assert_allclose(normal, map_from_world.rotation[:, 2], atol=1e-9)
    assert offset == pytest.approx(float(normal @ map_from_world.translation_m), abs=1e-9)


def test_the_board_appears_as_far_below_the_road_as_it_stands_above(
    scene: Scene, map_from_world: Pose, map_from_cam: Pose
) -> None:
    without, with_board = (
        render(world, CAMERA, map_from_cam, WET)[:, 152:168].astype(float).mean(axis=1)
        for world in (_road(map_from_world, None), scene)
    )
    rows = np.arange(_row(0.0), CAMERA.height_px)
    cosine = np.sin(np.arctan((rows - CAMERA.cy_px) / CAMERA.fy_px))
    share = (without - with_board)[rows] / (0.02 + 0.98 * (1.0 - cosine) ** 5)  # of the sky, hidden by the board
    mirrored = rows[share > 0.5 * share.max()]
    assert 60.0 < share.max() < 228.0  # damp ground mirrors less than a puddle
    assert 0.5 * (mirrored.min() + mirrored.max()) == pytest.approx(0.5 * (_row(-1.0) + _row(-3.0)), abs=3.0)
    assert np.ptp(mirrored) == pytest.approx(
        _row(-3.0) - _row(-1.0), abs=5.0
    )  # blurred, and a puddle's edge in it
    assert np.abs(share[rows > _row(-3.0) + 15]).max() < 10.0


def test_only_the_ground_changes_and_turns_darker_where_one_looks_down_on_it(
    scene: Scene, map_from_cam: Pose
) -> None:
    dry, wet = (render(scene, CAMERA, map_from_cam, look) for look in (DRY, WET))
    horizon = round(CAMERA.cy_px)
    np.testing.assert_array_equal(dry[: horizon - 12], wet[: horizon - 12])
    down = map_from_cam @ Pose(so3_exp(np.array([-1.2, 0.0, 0.0])), np.zeros(3))
    dry, wet = (render(scene, CAMERA, down, look) for look in (DRY, WET))
    assert dry[120, 160] == 60
    assert 30 <= wet[120, 160] <= 42  # it keeps 45 % of its light to itself and mirrors a fiftieth of the sky's


def test_where_there_is_no_road_nothing_is_wet(scene: Scene, map_from_world: Pose) -> None:
    away = map_from_world @ Pose(_LEVEL, np.array([0.0, -30.0, EYE_M]))
    np.testing.assert_array_equal(render(scene, CAMERA, away, DRY), render(scene, CAMERA, away, WET))
