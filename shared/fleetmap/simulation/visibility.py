"""Which surface each pixel sees: a z-buffer on planes.

Everything is projective geometry: for a viewing ray d = (x, y, 1) in the camera's frame, a surface gives texture
coordinates (s, t, 1) ~ texture_from_ray @ d, and its inverse depth is a linear function of d. So texture, depth
and outline of a surface agree to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap.simulation.atlas import MAX_LEVEL, Atlas
from fleetmap.simulation.surfaces import GreyImage, Surfaces

Array = NDArray[np.float64]
FloatImage = NDArray[np.float32]
Ids = NDArray[np.int32]
Boxes = list[tuple[slice, slice] | None]  # rows, columns of each surface

NOTHING = -1  # the id of the sky
_NEAR_M = 0.2
_NEARLY_ZERO = np.float32(1e-12)
_EMPTY = (slice(0, 0), slice(0, 0))


@dataclass(frozen=True)
class View:
    """The surfaces as one camera sees them, with viewing rays d = (x, y, 1)."""

    texture_from_ray: Array  # (Q, 3, 3): rows give s, t and their common denominator
    inverse_depth: Array  # (Q, 3): 1 / z = row @ d
    outlines_in_cam: Array  # (Q, 8, 3): corners, and where edges cross the near plane
    on_outline: NDArray[np.bool_]  # (Q, 8): which of them bound the part before the near plane
    front_to_back: NDArray[np.int64]  # (M,) the surfaces that may be in view


def view_of(surfaces: Surfaces, map_from_cam: Pose) -> View:
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
    outlines, on_outline = _cut_at_near_plane(corners)
    candidates = np.flatnonzero(faces & on_outline.any(axis=1))
    distance = np.linalg.norm(corners[candidates].mean(axis=1), axis=1)
    front_to_back = candidates[np.argsort(distance, kind="stable")]
    return View(texture_from_ray, inverse_depth, outlines, on_outline, front_to_back)


def _cut_at_near_plane(corners: Array) -> tuple[Array, NDArray[np.bool_]]:
    following = np.roll(corners, -1, axis=1)
    depth, next_depth = corners[..., 2], following[..., 2]
    crossing = (depth - _NEAR_M) * (next_depth - _NEAR_M) < 0.0
    fraction = np.where(crossing, (_NEAR_M - depth) / np.where(crossing, next_depth - depth, 1.0), 0.0)
    cuts = corners + fraction[..., None] * (following - corners)
    return np.concatenate([corners, cuts], axis=1), np.concatenate([depth >= _NEAR_M, crossing], axis=1)


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
    nearest: (
        tuple[NDArray[np.int64], NDArray[np.int64]] | None
    )  # row and column of each pixel's neighbour; None: the same grid

    def at_pixels(self, ids: Ids) -> Ids:
        """Values (H', W') of the even grid at the pixels (H, W)."""
        return ids if self.nearest is None else ids[self.nearest]


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
    pixel_x, pixel_y = (np.ascontiguousarray(rays[..., i], dtype=np.float32) for i in range(2))
    focal_px = (camera.fx_px, camera.fy_px)
    return Grid(x.astype(np.float32), y.astype(np.float32), focal_px, pixel_x, pixel_y, nearest)


def boxes_in_view(view: View, grid: Grid) -> Boxes:
    """Rows and columns of the even grid that hold the outline of each surface; None when out of view."""
    with np.errstate(divide="ignore", invalid="ignore"):
        rays = view.outlines_in_cam[..., :2] / view.outlines_in_cam[..., 2:]
    low = np.where(view.on_outline[..., None], rays, np.inf).min(axis=1)
    high = np.where(view.on_outline[..., None], rays, -np.inf).max(axis=1)
    origin, size = np.array([grid.x[0], grid.y[0]], dtype=np.float64), np.array([len(grid.x), len(grid.y)])
    first = np.clip(np.floor((low - origin) * grid.px_per_unit), 0, size).astype(np.int64)
    last = np.clip(np.ceil((high - origin) * grid.px_per_unit) + 1, 0, size).astype(np.int64)
    return [
        (slice(top, bottom), slice(left, right)) if top < bottom and left < right else None
        for (left, top), (right, bottom) in zip(first.tolist(), last.tolist(), strict=True)
    ]


def boxes_seen(ids: Ids, count: int) -> Boxes:
    """Rows and columns where each surface was seen, two pixels wider; None for those that were not seen.

    Enough for renderings shifted by less than a pixel; it misses what is thinner than a pixel everywhere.
    """
    found = find_objects(ids + 1)
    seen: Boxes = [None] * count
    for surface, box in enumerate(found):
        if box is not None:
            rows, columns = (slice(max(side.start - 2, 0), side.stop + 2) for side in box)
            seen[surface] = rows, columns
    return seen


def visible_surfaces(surfaces: Surfaces, atlas: Atlas, view: View, boxes: Boxes, grid: Grid) -> Ids:
    """Id (H', W') of the surface seen at each place of the even grid; NOTHING for the sky."""
    nearest = np.zeros((len(grid.y), len(grid.x)), dtype=np.float32)  # inverse depth
    ids = np.full(nearest.shape, NOTHING, dtype=np.int32)
    s, t, scale = view.texture_from_ray.transpose(1, 0, 2)
    # All that must be positive where a surface is hit: the distances from its four edges, and 1 / z.
    planes = np.stack([s, t, scale - s, scale - t, view.inverse_depth], axis=1).astype(np.float32)
    largest = 1.001 / np.where(view.on_outline, view.outlines_in_cam[..., 2], np.inf).min(axis=1)
    for surface in view.front_to_back.tolist():
        rows, columns = boxes[surface] or _EMPTY
        buffer = nearest[rows, columns]
        if not buffer.size or largest[surface] < buffer.min():
            continue
        values = _affine(planes[surface], grid.x[columns], grid.y[rows])
        mask = (values[:4].min(axis=0) >= 0.0) & (values[4] > buffer)
        pyramid = atlas.opacities[surfaces.texture_indices[surface]]
        if pyramid is not None:
            scale_here = values[0] + values[2]
            scale_here[scale_here == 0.0] = _NEARLY_ZERO  # on the surface's own horizon, where it is never seen
            mask &= _is_opaque(pyramid, values[0] / scale_here, values[1] / scale_here)
        seen = mask.view(np.uint8)  # cv2.copyTo writes into the views in place, faster than numpy's masked copy
        cv2.copyTo(values[4], seen, buffer)
        cv2.copyTo(np.full(seen.shape, surface, dtype=np.int32), seen, ids[rows, columns])
    return ids


def _affine(rows: FloatImage, x: FloatImage, y: FloatImage) -> FloatImage:
    """rows (K, 3) @ (x, y, 1) on the grid of x (W,) and y (H,): (K, H, W)."""
    across, down = rows[:, :1] * x, rows[:, 1:2] * y + rows[:, 2:]
    return np.asarray(across[:, None, :] + down[:, :, None])


def _is_opaque(pyramid: tuple[GreyImage, ...], s: FloatImage, t: FloatImage) -> NDArray[np.bool_]:
    """Where a see-through texture is solid, read from the level that fits the box."""
    texels_per_px = pyramid[0].shape[0] * np.median(np.abs(np.diff(t, axis=0))) if len(t) > 1 else np.inf
    level = pyramid[int(np.clip(np.log2(max(float(texels_per_px), 1.0)), 0, MAX_LEVEL))]
    column = s * np.float32(level.shape[1]) - np.float32(0.5)
    row = t * np.float32(level.shape[0]) - np.float32(0.5)
    return np.asarray(cv2.remap(level, column, row, cv2.INTER_LINEAR) > 127)
