"""Where every pixel of a camera looks, tile by tile."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera

BAND_ROWS = 4  # few, so that a rolling shutter moves by a fraction of a pixel from band to band
TILE_COLUMNS = 32
TILE_PIXELS = BAND_ROWS * TILE_COLUMNS


class RayTable(NamedTuple):
    """Unit viewing rays in the camera's frame, (bands B, tiles T of a band, ..., x y z, ...).

    A tile is small enough that within it rays are very nearly linear in the pixel's place, so ``across`` and
    ``down`` serve for all of it. Pixels beyond the image's edge repeat the last one; NaN: the lens images nothing.
    """

    rays: NDArray[np.float32]  # (B, T, 3, TILE_PIXELS) of the pixel centres, row by row
    across: NDArray[np.float32]  # (B, T, 3) what one pixel to the right adds
    down: NDArray[np.float32]  # (B, T, 3) what one pixel down adds
    middles: NDArray[np.float32]  # (B, T, 3) of the smallest box that holds the rays of a tile's pixels
    halves: NDArray[np.float32]  # (B, T, 3) of the box' sides; -inf where a tile has no ray
    widest_rad: float  # the largest angle between a ray and the optical axis
    finest_rad: float  # the smallest angle between neighbouring pixels' rays


@lru_cache(maxsize=6)
def ray_table(camera: Camera) -> RayTable:
    """The rays of a camera; 12 bytes a pixel, kept for the next image."""
    bands, tiles = -(-camera.height_px // BAND_ROWS), -(-camera.width_px // TILE_COLUMNS)
    rays = _unit_rays(camera, bands * BAND_ROWS, tiles * TILE_COLUMNS)
    across, down = (_mean_steps(camera, rays, axis) for axis in (1, 0))
    tiled = rays.reshape(bands, BAND_ROWS, tiles, TILE_COLUMNS, 3).transpose(0, 2, 4, 1, 3)
    tiled = tiled.reshape(bands, tiles, 3, TILE_PIXELS)
    margin = np.abs(across) + np.abs(down)
    low = np.where(np.isnan(tiled), np.inf, tiled).min(axis=-1) - margin
    high = np.where(np.isnan(tiled), -np.inf, tiled).max(axis=-1) + margin
    has_rays = low <= high
    low, high = np.where(has_rays, low, 0.0), np.where(has_rays, high, 0.0)
    middles, halves = 0.5 * (low + high), np.where(has_rays, 0.5 * (high - low), -np.inf)
    widest = float(np.arccos(np.clip(np.nanmin(rays[..., 2], initial=1.0), -1.0, 1.0)))
    finest = min(float(np.linalg.norm(steps, axis=-1)[has_rays[..., 0]].min()) for steps in (across, down))
    arrays = [np.ascontiguousarray(a, dtype=np.float32) for a in (tiled, across, down, middles, halves)]
    return RayTable(arrays[0], arrays[1], arrays[2], arrays[3], arrays[4], widest, finest)


def _unit_rays(camera: Camera, rows: int, columns: int) -> NDArray[np.float64]:
    """Rays (rows, columns, 3) of a grid of pixels that reaches beyond the image."""
    x = np.minimum(np.arange(columns), camera.width_px - 1)
    y = np.minimum(np.arange(rows), camera.height_px - 1)
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float64)
    rays = camera.unproject(pixels)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays.reshape(rows, columns, 3)


def _mean_steps(camera: Camera, rays: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """The mean difference (B, T, 3) of neighbours along an axis within each tile; 0 where there are none.

    The last pixel has the step of the one before it, so that a tile of one column has a step as well.
    """
    steps = np.diff(rays[: camera.height_px, : camera.width_px], axis=axis)
    missing = [(0, total - have) for total, have in zip(rays.shape, steps.shape, strict=True)]
    steps = np.pad(steps, missing, mode="edge" if steps.size else "constant")
    bands, tiles = rays.shape[0] // BAND_ROWS, rays.shape[1] // TILE_COLUMNS
    tiled = steps.reshape(bands, BAND_ROWS, tiles, TILE_COLUMNS, 3)
    known = ~np.isnan(tiled)
    return np.asarray(np.where(known, tiled, 0.0).sum(axis=(1, 3)) / np.maximum(known.sum(axis=(1, 3)), 1))


def first_sample(tiled: NDArray[Any], camera: Camera) -> NDArray[Any]:
    """Values (B, T, K, TILE_PIXELS) of a camera's tiles as an image (H, W) of the first of the K samples."""
    bands, tiles = tiled.shape[:2]
    image = tiled[:, :, 0].reshape(bands, tiles, BAND_ROWS, TILE_COLUMNS).transpose(0, 2, 1, 3)
    return image.reshape(bands * BAND_ROWS, tiles * TILE_COLUMNS)[: camera.height_px, : camera.width_px]
