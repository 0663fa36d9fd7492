"""Points from two views, and which of them to believe; the loops are compiled."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose

Array = NDArray[np.float64]
CHI2_2DOF_95 = 5.991
_MIN_DEPTH = 1e-6


def triangulate(camera: Camera, world_from_a: Pose, pixels_a: Array, world_from_b: Pose, pixels_b: Array) -> Array:
    """Midpoints (N, 3) of the shortest segments between the viewing rays of undistorted pixels (N, 2).

    Source: Hartley & Sturm, "Triangulation", CVIU 1997, section 5.1; bundle adjustment refines them.
    Parallel rays give no point: NaN, or one that neither pixel believes.
    """
    rays_a, rays_b = rays_of(camera, world_from_a, pixels_a), rays_of(camera, world_from_b, pixels_b)
    points: Array = _midpoints(rays_a, world_from_a.translation_m, rays_b, world_from_b.translation_m)
    return points


def parallax_rad(points: Array, centre_a: Array, centre_b: Array) -> Array:
    """Angle (N,) at each point (N, 3) between the rays to two camera centres."""
    angles: Array = _angles_at(np.ascontiguousarray(points), centre_a, centre_b)
    return angles


def is_consistent(
    camera: Camera, world_from_cam: Pose, points: Array, pixels: Array, sigmas_px: Array
) -> NDArray[np.bool_]:
    """Which points (N, 3) lie in front of a camera and within 95 % of their pixels (N, 2)."""
    believed: NDArray[np.bool_] = _within(
        _intrinsics(camera),
        np.ascontiguousarray(world_from_cam.rotation),
        world_from_cam.translation_m,
        np.ascontiguousarray(points),
        np.ascontiguousarray(pixels),
        np.ascontiguousarray(sigmas_px),
    )
    return believed


def rays_of(camera: Camera, world_from_cam: Pose, pixels: Array) -> Array:
    """Unit viewing rays (N, 3) in world of undistorted pixels (N, 2)."""
    rays: Array = _unit_rays(
        _intrinsics(camera), np.ascontiguousarray(world_from_cam.rotation), np.ascontiguousarray(pixels)
    )
    return rays


def _intrinsics(camera: Camera) -> tuple[float, float, float, float]:
    return camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px


@njit(cache=True, nogil=True, error_model="numpy")
def _unit_rays(intrinsics, rotation, pixels):  # type: ignore[no-untyped-def]
    fx, fy, cx, cy = intrinsics
    rays = np.empty((len(pixels), 3))
    for n in range(len(pixels)):
        x, y = (pixels[n, 0] - cx) / fx, (pixels[n, 1] - cy) / fy
        length = np.sqrt(x * x + y * y + 1.0)
        for c in range(3):
            rays[n, c] = (rotation[c, 0] * x + rotation[c, 1] * y + rotation[c, 2]) / length
    return rays


@njit(cache=True, nogil=True, error_model="numpy")
def _midpoints(rays_a, centre_a, rays_b, centre_b):  # type: ignore[no-untyped-def]
    points = np.empty((len(rays_a), 3))
    for n in range(len(rays_a)):
        cos, along_a, along_b = 0.0, 0.0, 0.0
        for c in range(3):
            baseline = centre_b[c] - centre_a[c]
            cos += rays_a[n, c] * rays_b[n, c]
            along_a += rays_a[n, c] * baseline
            along_b += rays_b[n, c] * baseline
        reach_a = (along_a - cos * along_b) / (1.0 - cos * cos)
        reach_b = (cos * along_a - along_b) / (1.0 - cos * cos)
        is_finite = True
        for c in range(3):
            end_a, end_b = centre_a[c] + reach_a * rays_a[n, c], centre_b[c] + reach_b * rays_b[n, c]
            points[n, c] = 0.5 * (end_a + end_b)
            is_finite &= np.isfinite(points[n, c])
        if not is_finite:
            points[n] = np.nan
    return points


@njit(cache=True, nogil=True, error_model="numpy")
def _angles_at(points, centre_a, centre_b):  # type: ignore[no-untyped-def]
    angles = np.empty(len(points))
    for n in range(len(points)):
        ax, ay, az = centre_a[0] - points[n, 0], centre_a[1] - points[n, 1], centre_a[2] - points[n, 2]
        bx, by, bz = centre_b[0] - points[n, 0], centre_b[1] - points[n, 1], centre_b[2] - points[n, 2]
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        angles[n] = np.arctan2(np.sqrt(x * x + y * y + z * z), ax * bx + ay * by + az * bz)
    return angles


@njit(cache=True, nogil=True, error_model="numpy")
def _within(intrinsics, rotation, centre, points, pixels, sigmas):  # type: ignore[no-untyped-def]
    fx, fy, cx, cy = intrinsics
    believed = np.zeros(len(points), np.bool_)
    for n in range(len(points)):
        x, y, z = points[n, 0] - centre[0], points[n, 1] - centre[1], points[n, 2] - centre[2]
        depth = rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2] * z
        if not depth > _MIN_DEPTH:
            continue
        du = fx * (rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0] * z) / depth + cx - pixels[n, 0]
        dv = fy * (rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1] * z) / depth + cy - pixels[n, 1]
        believed[n] = du * du + dv * dv < CHI2_2DOF_95 * sigmas[n] ** 2
    return believed
