"""Images, depths and projections of one world must tell the same story, to a fraction of a pixel."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, so3_exp
from fleetmap.simulation.atlas import build_atlas
from fleetmap.simulation.driving import drive_along
from fleetmap.simulation.look import Look
from fleetmap.simulation.rendering import render, render_depth, true_points
from fleetmap.simulation.simulated_drive import simulate_drive
from fleetmap.simulation.street import Street
from fleetmap.simulation.surfaces import SurfaceBuilder

CLEAN = Look(noise_sigma=0.0, blur_sigma_px=0.0, vignetting=0.0)
SQUARES = 8


def _world(street: Street, corners_in_map: NDArray[np.float64], grey: NDArray[np.uint8]) -> Street:
    """A world of a single unlit surface, in the frame of a street."""
    builder = SurfaceBuilder(np.array([0.0, 0.0, 1.0]))
    builder.add_quad(corners_in_map, builder.add_texture(grey), lit=False)
    return Street(street.anchor, 1.0, street.path, builder.surfaces(), build_atlas(builder.textures))


def _chessboard(texels_per_square: int) -> NDArray[np.uint8]:
    board = np.indices((SQUARES, SQUARES)).sum(axis=0) % 2 * 180 + 40
    return np.kron(board, np.ones((texels_per_square, texels_per_square))).astype(np.uint8)


def _facing_wall(distance_m: float, width_m: float, height_m: float) -> NDArray[np.float64]:
    """A wall across the optical axis of the camera at the identity pose, (4, 3)."""
    x, y = width_m / 2.0, height_m / 2.0
    return np.array([[-x, -y, distance_m], [x, -y, distance_m], [x, y, distance_m], [-x, y, distance_m]])


@pytest.mark.parametrize("texels_per_square", [8, 32, 64])
def test_texture_corners_lie_where_they_project(street: Street, camera: Camera, texels_per_square: int) -> None:
    board_from_plane = Pose(so3_exp(np.array([0.15, 0.5, 0.1])), np.array([0.1, 0.0, 3.0]))
    corners = board_from_plane.transform(_facing_wall(0.0, 4.0, 1.3))
    world = _world(street, corners, _chessboard(texels_per_square))
    image = render(world, camera, Pose.identity(), CLEAN)
    inner = np.stack(np.meshgrid(*[np.arange(1, SQUARES) / SQUARES] * 2), axis=-1).reshape(-1, 2)
    right, down = corners[1] - corners[0], corners[3] - corners[0]
    truth = camera.project(corners[0] + inner[:, :1] * right + inner[:, 1:] * down)
    start = np.ascontiguousarray(truth, dtype=np.float32)
    found = cv2.cornerSubPix(image, start.copy(), (3, 3), (-1, -1), (cv2.TERM_CRITERIA_COUNT, 30, 0.0))
    error = found.reshape(-1, 2) - truth
    assert np.linalg.norm(error, axis=1).max() < 0.3
    assert np.linalg.norm(error.mean(axis=0)) < 0.05


@pytest.mark.parametrize("shift_px", [0.0, 0.25, 0.5, 0.75])
def test_outlines_lie_where_they_project(street: Street, camera: Camera, shift_px: float) -> None:
    """The share of dark pixels along rows and columns through the middle measures where a dark wall ends."""
    wall = _facing_wall(2.0, 1.31, 0.53) + np.array([1.0, 1.0, 0.0]) * shift_px * 2.0 / camera.fx_px
    image = render(_world(street, wall, np.full((64, 64), 38, np.uint8)), camera, Pose.identity(), CLEAN)
    dark = (238.0 - image) / 200.0
    column, row = round(camera.cx_px), round(camera.cy_px)
    offsets = np.array([[-0.655, 0.0, 0.0], [0.655, 0.0, 0.0], [0.0, -0.265, 0.0], [0.0, 0.265, 0.0]])
    left, right, top, bottom = camera.project(wall.mean(axis=0) + offsets)
    tolerance_px = 0.26
    assert abs(dark[row].sum() - (right[0] - left[0])) < 2.0 * tolerance_px
    assert abs(_centroid(dark[row]) - (left[0] + right[0]) / 2.0) < tolerance_px
    assert abs(dark[:, column].sum() - (bottom[1] - top[1])) < 2.0 * tolerance_px
    assert abs(_centroid(dark[:, column]) - (top[1] + bottom[1]) / 2.0) < tolerance_px


def _centroid(profile: NDArray[np.float64]) -> float:
    return float(profile @ np.arange(len(profile)) / profile.sum())


def test_depth_of_a_wall_is_its_distance(street: Street, camera: Camera) -> None:
    world = _world(street, _facing_wall(7.5, 6.0, 3.0), np.full((64, 64), 90, np.uint8))
    depth = render_depth(world, camera, Pose.identity())
    assert depth[57, 158] == pytest.approx(7.5, rel=1e-5)
    assert np.isinf(depth[0, 0])
    assert set(np.unique(np.round(depth[np.isfinite(depth)], 3)).tolist()) == {7.5}


def test_a_wall_that_passes_beside_the_camera_is_cut_at_the_lens(street: Street, camera: Camera) -> None:
    wall = np.array([[1.0, -9.0, -5.0], [1.0, -9.0, 40.0], [1.0, 9.0, 40.0], [1.0, 9.0, -5.0]])[[1, 0, 3, 2]]
    depth = render_depth(_world(street, wall, np.full((64, 64), 90, np.uint8)), camera, Pose.identity())
    x = camera.unproject(np.array([[319.0, 57.0], [250.0, 57.0]]))[:, 0]
    assert depth[57, 319] == pytest.approx(1.0 / x[0], rel=1e-4)
    assert depth[57, 250] == pytest.approx(1.0 / x[1], rel=1e-4)
    assert np.isinf(depth[57, 100])


def test_walls_are_seen_from_their_front_only(street: Street, camera: Camera) -> None:
    world = _world(street, _facing_wall(5.0, 3.0, 2.0)[[1, 0, 3, 2]], np.full((64, 64), 90, np.uint8))
    assert np.isinf(render_depth(world, camera, Pose.identity())).all()


def test_true_points_project_back_onto_their_pixels(street: Street, camera: Camera) -> None:
    drive = simulate_drive(street, camera=camera, trajectory=drive_along(street), gnss=None)
    pose = drive.map_from_cam(3)
    pixels = np.random.default_rng(0).uniform((0.0, 0.0), (319.0, 119.0), (300, 2))
    points = true_points(street, camera, pose, pixels)
    seen = np.isfinite(points[:, 0])
    assert seen.mean() > 0.7
    again = camera.project(pose.inverse().transform(points[seen]))
    assert np.abs(again - pixels[seen]).max() < 1e-3
    at_centres = np.rint(pixels)
    depth = render_depth(street, camera, pose)[at_centres[:, 1].astype(int), at_centres[:, 0].astype(int)]
    true_depth = pose.inverse().transform(true_points(street, camera, pose, at_centres))[:, 2]
    np.testing.assert_allclose(depth[np.isfinite(depth)], true_depth[np.isfinite(true_depth)], rtol=1e-4)


def test_pixels_outside_the_image_have_no_point(street: Street) -> None:
    camera = Camera(64, 48, 40.0, 40.0, 31.5, 23.5)
    pose = Pose.identity()
    assert np.isnan(true_points(street, camera, pose, np.array([[-1.0, 5.0], [64.0, 5.0], [5.0, 48.0]]))).all()


def test_a_frame_carried_by_depth_and_poses_is_the_next_frame(street: Street, camera: Camera) -> None:
    """Within grey levels, where the point seen in the second frame is the same one as in the first."""
    drive = simulate_drive(
        street, camera=camera, trajectory=drive_along(street, seed=2), look=Look(noise_sigma=0.0), gnss=None
    )
    first, second = drive.map_from_cam(10), drive.map_from_cam(11)
    here, there = drive.frame(10).image, drive.frame(11).image
    pixels = np.stack(np.meshgrid(np.arange(320.0), np.arange(120.0)), axis=-1).reshape(-1, 2)
    points = true_points(street, camera, second, pixels)
    back = camera.project(first.inverse().transform(points))
    same = camera.is_inside(back, 2.0)
    same[same] &= np.linalg.norm(true_points(street, camera, first, back[same]) - points[same], axis=1) < 0.05
    carried = cv2.remap(here, *back.astype(np.float32).reshape(120, 320, 2).transpose(2, 0, 1), cv2.INTER_LINEAR)
    difference = np.abs(carried.astype(float) - there).ravel()[same]
    unmoved = np.abs(here.astype(float) - there).ravel()[same]
    assert same.mean() > 0.6
    assert np.median(difference) < 3.0
    assert difference.mean() < 5.0
    assert difference.mean() < 0.5 * unmoved.mean()


def test_the_same_look_gives_the_same_bytes(street: Street, camera: Camera) -> None:
    pose = simulate_drive(street, camera=camera, trajectory=drive_along(street), gnss=None).map_from_cam(5)
    first = render(street, camera, pose, Look(seed=1))
    assert np.array_equal(first, render(street, camera, pose, Look(seed=1)))
    assert not np.array_equal(first, render(street, camera, pose, Look(seed=2)))


def test_a_see_through_surface_may_have_its_horizon_in_the_middle_of_a_pixel(street: Street) -> None:
    """Where a ray is parallel to the surface its texture coordinates are infinite; it is only not seen there."""
    across, along = np.array([3.0, -3.0, 0.0]), np.array([0.0, 0.0, 4.0])
    corner = np.array([-2.0, 4.0, 4.0])
    corners = np.stack([corner, corner + along, corner + across + along, corner + across])
    builder = SurfaceBuilder(np.array([0.0, 0.0, 1.0]))
    opacity = np.full((64, 64), 255, dtype=np.uint8)
    builder.add_quad(corners, builder.add_texture(np.full((64, 64), 90, dtype=np.uint8), opacity), two_sided=True)
    world = Street(street.anchor, 1.0, street.path, builder.surfaces(), build_atlas(builder.textures))
    camera = Camera(257, 257, 128.0, 128.0, 128.0, 128.0)
    with np.errstate(all="raise"):
        depth = render_depth(world, camera, Pose.identity())
    row, column = np.indices(depth.shape)
    assert np.isfinite(depth).any()
    assert np.isinf(depth[row + column <= 256]).all()
