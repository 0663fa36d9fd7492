"""Which surface each pixel sees: a z-buffer on planes.

Everything is projective geometry: for a viewing ray d = (x, y, 1) in the camera's frame, a surface gives texture
coordinates (s, t, 1) ~ texture_from_ray @ d, and its inverse depth is a linear function of d. So texture, depth
and outline of a surface agree to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap.simulation.atlas import MAX_LEVEL, Atlas
from fleetmap.simulation.surfaces import GreyImage, Surfaces

Array = NDArray[np.float64]
FloatImage = NDArray[np.float32]
Ids = NDArray[np.int64]

NOTHING = -1  # the id of the sky
_NEAR_M = 0.2


@dataclass(frozen=True)
class View:
    """The surfaces as one camera sees them, with viewing rays d = (x, y, 1)."""

    texture_from_ray: Array  # (Q, 3, 3): rows give s, t and their common denominator
    inverse_depth: Array  # (Q, 3): 1 / z = row @ d
    corners_in_cam: Array  # (Q, 4, 3)
    front_to_back: Ids  # (M,) the surfaces that may be in view

    def narrowed_to(self, ids: Ids) -> View:
        """The same view without the surfaces that are not among the ids of an image."""
        seen = np.zeros(len(self.inverse_depth) + 1, dtype=np.bool_)
        seen[ids.ravel()] = True
        return replace(self, front_to_back=self.front_to_back[seen[self.front_to_back]])


def view_of(surfaces: Surfaces, camera: Camera, map_from_cam: Pose) -> View:
    """Carry surfaces into a camera's frame; those behind it or turned away are left out of ``front_to_back``."""
    weights = surfaces.weights
    texture = surfaces.map_from_texture - map_from_cam.translation_m[:, None] * weights[:, 2:3]
    ray_from_texture = map_from_cam.rotation.T @ texture
    determinant = np.linalg.det(ray_from_texture)
    faces = (determinant > 1e-9) | (surfaces.two_sided & (determinant < -1e-9))
    texture_from_ray = np.zeros_like(ray_from_texture)
    texture_from_ray[faces] = np.linalg.inv(ray_from_texture[faces])
    inverse_depth = (weights[:, 2:3] @ texture_from_ray)[:, 0]
    corners = (surfaces.corners_in_map - map_from_cam.translation_m) @ map_from_cam.rotation
    candidates = np.flatnonzero(faces & (corners[..., 2].max(axis=1) > _NEAR_M))
    distance = np.linalg.norm(corners[candidates].mean(axis=1), axis=1)
    return View(texture_from_ray, inverse_depth, corners, candidates[np.argsort(distance, kind="stable")])


@dataclass(frozen=True)
class Grid:
    """Where the pixels of an image look, and the even grid of ray coordinates on which visibility is decided.

    Without distortion both are the same; with it, each pixel asks its nearest neighbour on the even grid.
    """

    x: FloatImage  # (W',) even
    y: FloatImage  # (H',)
    px_per_unit: tuple[float, float]  # fx, fy
    pixel_x: FloatImage  # (H, W)
    pixel_y: FloatImage  # (H, W)
    nearest: tuple[Ids, Ids] | None  # row and column of each pixel's neighbour; None: the same grid

    def rays(self) -> tuple[FloatImage, FloatImage]:
        """Ray coordinates x, y of the pixels, each (H, W), undistorted."""
        return self.pixel_x, self.pixel_y


@lru_cache(maxsize=16)
def sampling_grid(camera: Camera, shift_px: tuple[float, float]) -> Grid:
    """The grid of a camera whose pixels look ``shift_px`` (x, y) beside their centres."""
    columns = np.arange(camera.width_px) + shift_px[0]
    rows = np.arange(camera.height_px) + shift_px[1]
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    rays = camera.unproject(pixels)[:, :2].reshape(camera.height_px, camera.width_px, 2)
    focal = np.array([camera.fx_px, camera.fy_px])
    low, high = rays.min(axis=(0, 1)), rays.max(axis=(0, 1))
    x, y = (low[i] + np.arange(round((high[i] - low[i]) * focal[i]) + 2) / focal[i] for i in range(2))
    nearest = None
    if any(camera.distortion):
        column, row = np.rint((rays - low) * focal).astype(np.int64).transpose(2, 0, 1)
        nearest = (row, column)
    else:
        x, y = x[:-1], y[:-1]
    x, y, rays = x.astype(np.float32), y.astype(np.float32), rays.astype(np.float32)
    pixel_x, pixel_y = np.ascontiguousarray(rays[..., 0]), np.ascontiguousarray(rays[..., 1])
    return Grid(x, y, (camera.fx_px, camera.fy_px), pixel_x, pixel_y, nearest)


def visible_surfaces(surfaces: Surfaces, atlas: Atlas, view: View, grid: Grid) -> Ids:
    """Id (H, W) of the surface that each pixel sees; NOTHING for the sky."""
    nearest = np.zeros((len(grid.y), len(grid.x)), dtype=np.float32)  # inverse depth
    ids = np.full(nearest.shape, NOTHING, dtype=np.int32)
    boxes, nearest_corner = _boxes(view, grid)
    texture_rows, depth_rows = view.texture_from_ray.astype(np.float32), view.inverse_depth.astype(np.float32)
    for surface in view.front_to_back.tolist():
        left, top, right, bottom = boxes[surface]
        buffer = nearest[top:bottom, left:right]
        if not buffer.size or nearest_corner[surface] < buffer.min():
            continue
        x, y = grid.x[left:right], grid.y[top:bottom, None]
        s, t, scale = (_affine(row, x, y) for row in texture_rows[surface])
        inverse_depth = _affine(depth_rows[surface], x, y)
        inside = np.minimum(np.minimum(s, t), scale - np.maximum(s, t))
        mask = (inside >= 0.0) & (inverse_depth > buffer)
        pyramid = atlas.opacities[surfaces.texture_indices[surface]]
        if pyramid is not None:
            mask &= _is_opaque(pyramid, s, t, scale)
        seen = mask.view(np.uint8)  # cv2.copyTo writes into the views in place, faster than numpy's masked copy
        cv2.copyTo(inverse_depth, seen, buffer)
        cv2.copyTo(np.full(seen.shape, surface, dtype=np.int32), seen, ids[top:bottom, left:right])
    return ids.astype(np.int64) if grid.nearest is None else ids[grid.nearest].astype(np.int64)


def _affine(row: FloatImage, x: FloatImage, y: FloatImage) -> FloatImage:
    """row @ (x, y, 1) on the grid of x (W,) and y (H, 1)."""
    return np.asarray(row[0] * x + (row[1] * y + row[2]))


def _boxes(view: View, grid: Grid) -> tuple[list[list[int]], list[float]]:
    """Box (left, top, right, bottom exclusive) of each surface, empty when out of view, and its largest 1 / z."""
    corners = view.corners_in_cam
    following = np.roll(corners, -1, axis=1)
    depth, next_depth = corners[..., 2], following[..., 2]
    crossing = (depth - _NEAR_M) * (next_depth - _NEAR_M) < 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = ((_NEAR_M - depth) / (next_depth - depth))[..., None]
        points = np.concatenate([corners, corners + fraction * (following - corners)], axis=1)
        valid = np.concatenate([depth >= _NEAR_M, crossing], axis=1)
        rays = points[..., :2] / points[..., 2:]
    low = np.where(valid[..., None], rays, np.inf).min(axis=1)
    high = np.where(valid[..., None], rays, -np.inf).max(axis=1)
    origin, size = np.array([grid.x[0], grid.y[0]], dtype=np.float64), np.array([len(grid.x), len(grid.y)])
    first = np.clip(np.floor((low - origin) * grid.px_per_unit), 0, size)
    last = np.clip(np.ceil((high - origin) * grid.px_per_unit) + 1, 0, size)
    largest = 1.001 / np.where(valid, points[..., 2], np.inf).min(axis=1)
    return np.concatenate([first, last], axis=1).astype(np.int64).tolist(), largest.tolist()


def _is_opaque(
    pyramid: tuple[GreyImage, ...], s: FloatImage, t: FloatImage, scale: FloatImage
) -> NDArray[np.bool_]:
    """Where a see-through texture is solid, read from the level that fits the box."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        s, t = s / scale, t / scale
    texels_per_px = pyramid[0].shape[0] * np.median(np.abs(np.diff(t, axis=0))) if len(t) > 1 else np.inf
    level = pyramid[int(np.clip(np.log2(max(float(texels_per_px), 1.0)), 0, MAX_LEVEL))]
    column = s * np.float32(level.shape[1]) - np.float32(0.5)
    row = t * np.float32(level.shape[0]) - np.float32(0.5)
    return np.asarray(cv2.remap(level, column, row, cv2.INTER_LINEAR) > 127)
