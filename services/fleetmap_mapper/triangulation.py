"""Points from two views, and which of them to believe."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose

Array = NDArray[np.float64]
CHI2_2DOF_95 = 5.991


def triangulate(camera: Camera, world_from_a: Pose, pixels_a: Array, world_from_b: Pose, pixels_b: Array) -> Array:
    """Midpoints (N, 3) of the shortest segments between the viewing rays of undistorted pixels (N, 2).

    Source: Hartley & Sturm, "Triangulation", CVIU 1997, section 5.1; bundle adjustment refines them.
    Parallel rays give no point: NaN, or one that neither pixel believes.
    """
    rays_a, rays_b = rays_of(camera, world_from_a, pixels_a), rays_of(camera, world_from_b, pixels_b)
    baseline = world_from_b.translation_m - world_from_a.translation_m
    cos = (rays_a * rays_b).sum(axis=1)
    along_a, along_b = rays_a @ baseline, rays_b @ baseline
    with np.errstate(divide="ignore", invalid="ignore"):
        reach_a = (along_a - cos * along_b) / (1.0 - cos * cos)
        reach_b = (cos * along_a - along_b) / (1.0 - cos * cos)
        ends_a = world_from_a.translation_m + reach_a[:, None] * rays_a
        ends_b = world_from_b.translation_m + reach_b[:, None] * rays_b
        points = 0.5 * (ends_a + ends_b)
    points[~np.isfinite(points).all(axis=1)] = np.nan
    return np.asarray(points)


def parallax_rad(points: Array, centre_a: Array, centre_b: Array) -> Array:
    """Angle (N,) at each point (N, 3) between the rays to two camera centres."""
    a, b = centre_a - points, centre_b - points
    with np.errstate(invalid="ignore"):
        cross = np.linalg.norm(np.cross(a, b), axis=1)
        return np.asarray(np.arctan2(cross, (a * b).sum(axis=1)))


def is_consistent(
    camera: Camera, world_from_cam: Pose, points: Array, pixels: Array, sigmas_px: Array
) -> NDArray[np.bool_]:
    """Which points (N, 3) lie in front of a camera and within 95 % of their pixels (N, 2)."""
    predicted = camera.project_ideal(world_from_cam.inverse().transform(points))
    with np.errstate(invalid="ignore"):
        return np.asarray(((predicted - pixels) ** 2).sum(axis=1) < CHI2_2DOF_95 * sigmas_px**2)


def rays_of(camera: Camera, world_from_cam: Pose, pixels: Array) -> Array:
    """Unit viewing rays (N, 3) in world of undistorted pixels (N, 2)."""
    x = (pixels[:, 0] - camera.cx_px) / camera.fx_px
    y = (pixels[:, 1] - camera.cy_px) / camera.fy_px
    rays = np.stack([x, y, np.ones_like(x)], axis=1) @ world_from_cam.rotation.T
    return np.asarray(rays / np.linalg.norm(rays, axis=1)[:, None])
