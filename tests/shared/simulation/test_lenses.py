"""Any lens is drawn as it projects: rational and equidistant ones, and those that see more than half the sky."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, so3_exp
from fleetmap.simulation.atlas import build_atlas
from fleetmap.simulation.look import Look
from fleetmap.simulation.rendering import cast_rays, render, render_depth, surface_ids, true_points
from fleetmap.simulation.street import Street
from fleetmap.simulation.surfaces import SurfaceBuilder
from fleetmap.simulation.world import Scene

Array = NDArray[np.float64]

CLEAN = Look(noise_sigma=0.0, blur_sigma_px=0.0, vignetting=0.0)
RATIONAL = Camera(
    321,
    121,
    185.0,
    186.0,
    158.3,
    57.9,
    (0.32, 0.05, 0.0012, -0.0008, 0.01, 0.62, 0.12, 0.02),
    "rational_polynomial",
)
EQUIDISTANT = Camera(320, 120, 185.0, 186.0, 158.3, 57.9, (-0.02, 0.004, 0.0, 0.0), "equidistant")
FISHEYE = Camera(
    400, 300, 140.0, 140.0, 199.5, 149.5, (-0.01, 0.001, 0.0, 0.0), "equidistant"
)  # 163 by 122 degrees
LENSES = pytest.mark.parametrize(
    "camera", [RATIONAL, EQUIDISTANT, FISHEYE], ids=["rational", "equidistant", "fisheye"]
)

SQUARES = 8


def _scene(corners_in_map: Array, grey: NDArray[np.uint8]) -> Scene:
    builder = SurfaceBuilder(np.array([0.0, 0.0, 1.0]))
    builder.add_quad(corners_in_map, builder.add_texture(grey), lit=False)
    return Scene(builder.surfaces(), build_atlas(builder.textures))


def _facing_wall(distance_m: float, width_m: float, height_m: float) -> Array:
    x, y = width_m / 2.0, height_m / 2.0
    return np.array([[-x, -y, distance_m], [x, -y, distance_m], [x, y, distance_m], [-x, y, distance_m]])


def _chessboard_corners_px(camera: Camera, map_from_cam: Pose) -> tuple[Array, Array]:
    """Where inner corners of a tilted board, ahead at the identity pose, are and where the image shows them."""
    board_from_plane = Pose(so3_exp(np.array([0.15, 0.5, 0.1])), np.array([0.1, 0.0, 3.0]))
    corners = board_from_plane.transform(_facing_wall(0.0, 4.0, 1.3))
    squares = np.indices((SQUARES, SQUARES)).sum(axis=0) % 2 * 180 + 40
    scene = _scene(corners, np.kron(squares, np.ones((32, 32))).astype(np.uint8))
    inner = np.stack(np.meshgrid(*[np.arange(1, SQUARES) / SQUARES] * 2), axis=-1).reshape(-1, 2)
    points = corners[0] + inner[:, :1] * (corners[1] - corners[0]) + inner[:, 1:] * (corners[3] - corners[0])
    truth = camera.project(map_from_cam.inverse().transform(points))
    truth = truth[camera.is_inside(truth, 6.0)]
    image = render(scene, camera, map_from_cam, CLEAN)
    start = np.ascontiguousarray(truth, dtype=np.float32)
    found = cv2.cornerSubPix(image, start.copy(), (3, 3), (-1, -1), (cv2.TERM_CRITERIA_COUNT, 30, 0.0))
    return truth, found.reshape(-1, 2)


@pytest.mark.parametrize("camera", [RATIONAL, EQUIDISTANT], ids=["rational", "equidistant"])
def test_texture_corners_lie_where_they_project(camera: Camera) -> None:
    truth, found = _chessboard_corners_px(camera, Pose.identity())
    assert len(truth) == (SQUARES - 1) ** 2
    assert np.linalg.norm(found - truth, axis=1).max() < 0.3
    assert np.linalg.norm((found - truth).mean(axis=0)) < 0.05


@pytest.mark.parametrize("yaw_deg", [-65.0, 0.0, 65.0])
def test_a_fisheye_shows_a_board_where_it_projects_also_far_off_its_axis(yaw_deg: float) -> None:
    truth, found = _chessboard_corners_px(
        FISHEYE, Pose(so3_exp(np.array([0.0, np.radians(yaw_deg), 0.0])), np.zeros(3))
    )
    assert len(truth) > 15
    assert np.linalg.norm(found - truth, axis=1).max() < 0.35
    assert np.linalg.norm((found - truth).mean(axis=0)) < 0.08


@LENSES
def test_the_truth_of_each_pixel_projects_back_onto_it(street: Street, camera: Camera) -> None:
    pose = Pose(
        np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]) @ so3_exp(np.array([0.05, 0.4, 0.1])),
        street.path.at(5.0, 0.0, 1.6),
    )
    size = (camera.width_px - 1.0, camera.height_px - 1.0)
    pixels = np.random.default_rng(0).uniform((0.0, 0.0), size, (400, 2))
    points = true_points(street, camera, pose, pixels)
    seen = np.isfinite(points[:, 0])
    assert seen.mean() > 0.5
    assert np.abs(camera.project(pose.inverse().transform(points[seen])) - pixels[seen]).max() < 1e-3

    centres = np.rint(pixels)
    depth = render_depth(street, camera, pose)[centres[:, 1].astype(int), centres[:, 0].astype(int)]
    true_depth = pose.inverse().transform(true_points(street, camera, pose, centres))[:, 2]
    np.testing.assert_array_equal(np.isfinite(depth), np.isfinite(true_depth))
    np.testing.assert_allclose(depth[np.isfinite(depth)], true_depth[np.isfinite(depth)], rtol=1e-4)

    rays = camera.unproject(centres)
    imaged = np.isfinite(rays[:, 0])
    cast = cast_rays(street, pose, rays[imaged]) / np.linalg.norm(rays[imaged], axis=1)
    assert np.mean(np.isclose(cast, depth[imaged], rtol=1e-3)) > 0.97  # leaves may be read from a coarser texture


def test_outlines_of_a_wide_lens_are_nowhere_more_than_half_a_pixel_off() -> None:
    """A pixel sees a surface exactly when its own ray meets it: checked against double precision, ray by ray."""
    wall = so3_exp(np.array([0.0, 1.1, 0.3])) @ _facing_wall(2.0, 1.5, 2.2).T
    scene = _scene(np.ascontiguousarray(wall.T), np.full((64, 64), 90, np.uint8))
    pixels = np.stack(np.meshgrid(np.arange(400.0), np.arange(300.0)), axis=-1).reshape(-1, 2)
    hit = np.isfinite(cast_rays(scene, Pose.identity(), FISHEYE.unproject(pixels))).reshape(300, 400)
    seen = surface_ids(scene, FISHEYE, Pose.identity()) == 0
    assert 3000 < seen.sum() < 30_000
    assert np.count_nonzero(seen != hit) <= 3  # rays within rounding of the outline


def test_where_the_lens_images_nothing_it_is_dark() -> None:
    camera = Camera(300, 300, 90.0, 90.0, 149.5, 149.5, (0.0, 0.0, 0.0, 0.0), "equidistant")  # 191 degrees across
    scene = _scene(_facing_wall(2.0, 1.0, 1.0), np.full((64, 64), 90, np.uint8))
    image = render(scene, camera, Pose.identity(), CLEAN)
    assert image[0, 0] == image[150, 0] == 0
    assert image[150, 150] == 90
    assert image[150, 40] == 238
