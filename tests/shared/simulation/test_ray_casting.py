"""Rays for range sensors meet surfaces where geometry says, quickly."""

from __future__ import annotations

import time

import numpy as np
import pytest

from fleetmap.geometry import Pose, so3_exp
from fleetmap.simulation.atlas import build_atlas
from fleetmap.simulation.rendering import cast_rays
from fleetmap.simulation.street import Street
from fleetmap.simulation.surfaces import SurfaceBuilder
from fleetmap.simulation.world import Scene

GREY = np.full((64, 64), 90, np.uint8)
WALL = np.array([[-2.0, -1.0, 5.0], [2.0, -1.0, 5.0], [2.0, 1.0, 5.0], [-2.0, 1.0, 5.0]])


def _rays(count: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    angles = np.linspace(-np.pi, np.pi, count, endpoint=False)
    return np.stack([np.sin(angles), np.zeros(count), np.cos(angles)], axis=1)


def test_distances_to_a_trapezium_are_those_of_its_plane_inside_its_outline() -> None:
    trapezium = np.array([[-1.0, -1.0, 5.0], [1.0, -1.0, 5.0], [2.0, 1.0, 5.0], [-2.0, 1.0, 5.0]])
    pose = Pose(so3_exp(np.array([0.2, -0.7, 0.4])), np.array([410.0, -250.0, 31.0]))
    builder = SurfaceBuilder(np.array([0.0, 0.0, 1.0]))
    builder.add_quad(pose.transform(trapezium), builder.add_texture(GREY))
    scene = Scene(builder.surfaces(), build_atlas(builder.textures))
    xy = np.random.default_rng(0).uniform(-2.5, 2.5, (2000, 2))
    rays = np.column_stack([xy, np.full(2000, 5.0)])
    inside = (np.abs(xy[:, 1]) < 1.0) & (np.abs(xy[:, 0]) < 1.5 + 0.5 * xy[:, 1])
    distances = cast_rays(scene, pose, rays)
    np.testing.assert_array_equal(np.isfinite(distances), inside)
    np.testing.assert_allclose(distances[inside], np.linalg.norm(rays[inside], axis=1), rtol=1e-12)


def test_the_nearest_surface_hides_the_others_and_the_range_ends() -> None:
    builder = SurfaceBuilder(np.array([0.0, 0.0, 1.0]))
    texture = builder.add_texture(GREY)
    for distance_m in (3.0, -1.0, 7.0):
        builder.add_quad(WALL + np.array([0.0, 0.0, distance_m]), texture)
    scene = Scene(builder.surfaces(), build_atlas(builder.textures))
    ahead = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    assert cast_rays(scene, Pose.identity(), ahead).tolist() == pytest.approx([4.0, np.inf])
    assert cast_rays(scene, Pose.identity(), ahead, 3.99).tolist() == [np.inf, np.inf]
    assert cast_rays(scene, Pose.identity(), ahead, 4.01).tolist() == pytest.approx([4.0, np.inf])


def test_leaves_let_rays_through_where_they_are_not_solid() -> None:
    builder = SurfaceBuilder(np.array([0.0, 0.0, 1.0]))
    opacity = np.zeros((64, 64), dtype=np.uint8)
    opacity[:, :32] = 255
    builder.add_quad(WALL, builder.add_texture(GREY, opacity), two_sided=True)
    scene = Scene(builder.surfaces(), build_atlas(builder.textures))
    rays = np.array([[-1.0, 0.0, 5.0], [1.0, 0.0, 5.0], [-0.1, 0.0, 5.0], [0.1, 0.0, 5.0]])
    assert np.isfinite(cast_rays(scene, Pose.identity(), rays)).tolist() == [True, False, True, False]


def test_a_scan_of_720_rays_takes_less_than_30_ms(street: Street) -> None:
    pose = Pose(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), street.path.at(20.0, 0.0, 0.5))
    rays = _rays(720)
    distances = cast_rays(street, pose, rays, 80.0)
    assert np.isfinite(distances).mean() > 0.6
    took_s = []
    for _ in range(5):
        start = time.thread_time()
        cast_rays(street, pose, rays, 80.0)
        took_s.append(time.thread_time() - start)
    assert min(took_s) < 0.03
