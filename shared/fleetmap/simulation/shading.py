"""How bright each pixel is: the texel of the pixel's own size, times the light on its surface."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.simulation.atlas import MAX_LEVEL
from fleetmap.simulation.planes import S, T, W
from fleetmap.simulation.rays import BAND_ROWS, TILE_COLUMNS, RayTable
from fleetmap.simulation.visibility import NOTHING

SKY_GREY = 238.0
_RUN = 16  # pixels that share a texture level
_SHARPNESS = np.float32(1.6)  # rounds the binary logarithm of the texels per pixel to the nearer level
_HALF, _ONE, _TWO = np.float32(0.5), np.float32(1.0), np.float32(2.0)
_ZERO = np.float32(0.0)


class Paint(NamedTuple):
    """What surfaces (M,) in view look like."""

    texels: NDArray[np.uint8]  # the atlas
    origins: NDArray[np.float32]  # (M, 2) of their textures in it
    sizes: NDArray[np.float32]  # (M, 2)
    brightness: NDArray[np.float32]  # (M,)
    sky: np.float32  # light where no surface is


@njit(cache=True, nogil=True, error_model="numpy")
def shade(planes: Any, paint: Paint, table: RayTable, samples_px: Any, seen: Any, light: Any) -> None:
    """Fill ``light`` (H, W) float32 with the light of what the samples see; arguments as in ``visibility.see``.

    Where all samples of a pixel see the same surface, its texel at the pixel's centre; else the samples' mean.
    Where the lens images nothing it is dark.
    """
    light[:] = _ZERO
    for band in range(seen.shape[0]):
        here = planes[min(band, len(planes) - 1)]
        for tile in range(seen.shape[1]):
            steps = (table.across[band, tile], table.down[band, tile])
            corner = (band * BAND_ROWS, tile * TILE_COLUMNS)
            _shade_tile(here, paint, table.rays[band, tile], steps, samples_px, seen[band, tile], corner, light)


@njit(cache=True, nogil=True, error_model="numpy")
def _shade_tile(
    planes: Any, paint: Paint, rays: Any, steps: Any, samples_px: Any, seen: Any, corner: Any, light: Any
) -> None:
    """Fill the tile of ``light`` whose top left pixel is ``corner`` (row, column)."""
    rows, columns = min(BAND_ROWS, light.shape[0] - corner[0]), min(TILE_COLUMNS, light.shape[1] - corner[1])
    for row in range(rows):
        column = 0
        while column < columns:
            p = row * TILE_COLUMNS + column
            place = (corner[0] + row, corner[1] + column)
            length = 0
            while length < _RUN and column + length < columns and _is_alike(seen, p + length, seen[0, p]):
                length += 1
            if length > 0:
                _shade_run(planes, paint, seen[0, p], rays, p, length, _ZERO, _ZERO, steps, _ONE, place, light)
            else:
                length = 1
                share = _ONE / np.float32(len(samples_px))
                for k in range(len(samples_px)):
                    dx, dy = samples_px[k, 0], samples_px[k, 1]
                    _shade_run(planes, paint, seen[k, p], rays, p, 1, dx, dy, steps, share, place, light)
            column += length


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _is_alike(seen: Any, p: int, m: int) -> bool:
    alike = True
    for k in range(len(seen)):
        alike &= seen[k, p] == m
    return alike


@njit(cache=True, nogil=True, error_model="numpy")
def _shade_run(
    planes: Any,
    paint: Paint,
    m: int,
    rays: Any,
    start: int,
    length: int,
    right_px: Any,
    below_px: Any,
    steps: Any,
    share: Any,
    place: Any,
    light: Any,
) -> None:
    """Add ``share`` of the light of plane ``m`` to a run of pixels in a row, with one texture level for all.

    Seen ``right_px``, ``below_px`` beside the pixels' centres; ``steps`` are what a pixel across and down adds to
    a ray.
    """
    row, column = place
    across, down = steps
    dx, dy = right_px * across[0] + below_px * down[0], right_px * across[1] + below_px * down[1]
    dz = right_px * across[2] + below_px * down[2]
    if m == NOTHING:
        for i in range(length):
            x = rays[0, start + i]
            light[row, column + i] += share * paint.sky if x == x else _ZERO
        return
    middle = start + length // 2
    x, y, z = rays[0, middle] + dx, rays[1, middle] + dy, rays[2, middle] + dz
    s0, s1, s2 = planes[m, S, 0], planes[m, S, 1], planes[m, S, 2]
    t0, t1, t2 = planes[m, T, 0], planes[m, T, 1], planes[m, T, 2]
    w0, w1, w2 = planes[m, W, 0], planes[m, W, 1], planes[m, W, 2]
    width = _level_length(planes, m, S, x, y, z, across, down, paint.sizes[m, 0])
    height = _level_length(planes, m, T, x, y, z, across, down, paint.sizes[m, 1])
    left = paint.origins[m, 0] + _TWO * (paint.sizes[m, 0] - width)
    top = paint.origins[m, 1] + _TWO * (paint.sizes[m, 1] - height)
    texels = paint.texels
    brightness = share * paint.brightness[m]
    for i in range(length):
        x, y, z = rays[0, start + i] + dx, rays[1, start + i] + dy, rays[2, start + i] + dz
        weight = _ONE / (w0 * x + w1 * y + w2 * z)
        u = left + min(max((s0 * x + s1 * y + s2 * z) * weight * width - _HALF, _ZERO), width - _ONE)
        v = top + min(max((t0 * x + t1 * y + t2 * z) * weight * height - _HALF, _ZERO), height - _ONE)
        light[row, column + i] += brightness * _bilinear(texels, u, v)


@njit(cache=True, nogil=True, error_model="numpy")
def _level_length(
    planes: Any, m: Any, axis: int, x: Any, y: Any, z: Any, across: Any, down: Any, size: Any
) -> Any:
    """How many texels of a texture's side has the level whose texels are about as large as the pixel along a ray.

    Level i has size 2**-i and starts at 2 size (1 - 2**-i): see Atlas.
    """
    weight = _ONE / _along(planes, m, W, x, y, z)
    at = _along(planes, m, axis, x, y, z) * weight
    i, j, k = across[0], across[1], across[2]
    step_across = abs(_along(planes, m, axis, i, j, k) - at * _along(planes, m, W, i, j, k))
    i, j, k = down[0], down[1], down[2]
    step_down = abs(_along(planes, m, axis, i, j, k) - at * _along(planes, m, W, i, j, k))
    texels_per_px = max(step_across, step_down) * weight * size * _SHARPNESS
    length, level = size, 0
    while texels_per_px >= _TWO and level < MAX_LEVEL:
        texels_per_px *= _HALF
        length *= _HALF
        level += 1
    return length


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _along(planes: Any, m: Any, row: Any, x: Any, y: Any, z: Any) -> Any:
    return planes[m, row, 0] * x + planes[m, row, 1] * y + planes[m, row, 2] * z


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _bilinear(picture: Any, x: Any, y: Any) -> Any:
    """A picture (H, W) between its pixels; x and y are at least 0."""
    column, row = int(x), int(y)
    right, below = min(column + 1, picture.shape[1] - 1), min(row + 1, picture.shape[0] - 1)
    fx, fy = x - np.float32(column), y - np.float32(row)
    top = np.float32(picture[row, column]) * (_ONE - fx) + np.float32(picture[row, right]) * fx
    bottom = np.float32(picture[below, column]) * (_ONE - fx) + np.float32(picture[below, right]) * fx
    return top * (_ONE - fy) + bottom * fy
