"""How bright each pixel is: the texel of the pixel's own size, times the light on its surface."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.simulation.atlas import MAX_LEVEL, Atlas
from fleetmap.simulation.surfaces import Surfaces
from fleetmap.simulation.visibility import NOTHING, Ids, View

FloatArray = NDArray[np.float32]
Shader = Callable[[Ids, FloatArray, FloatArray], FloatArray]

SKY_GREY = 238.0
_READ_COLUMNS = 1024


def shade(surfaces: Surfaces, atlas: Atlas, view: View, camera: Camera) -> Shader:
    """A function that gives the light (...) at surfaces' ids (...) along viewing rays x, y (...)."""
    textures = surfaces.texture_indices
    sizes, rows = atlas.sizes_px[textures], view.texture_from_ray
    scale_columns = _columns(rows[:, 2], sky=(0.0, 0.0, 1.0))
    texel_columns = [_columns(rows[:, axis] * sizes[:, axis, None], sky=(0.0, 0.0, 0.0)) for axis in range(2)]
    ends = (atlas.origins_px + 2.0 * atlas.sizes_px)[textures]
    # Level i of a texture starts at origin + 2 size (1 - shrink), shrink = 2**-i: see Atlas.
    size_columns, end_columns = _columns(sizes, sky=(64.0, 64.0)), _columns(ends, sky=(128.0, 128.0))
    (brightness,) = _columns(surfaces.brightness[:, None], sky=(0.0,))
    px_size = np.float32(1.0 / camera.fx_px), np.float32(1.0 / camera.fy_px)

    def light(ids: Ids, x: FloatArray, y: FloatArray) -> FloatArray:
        g, h, i = (np.take(column, ids) for column in scale_columns)
        weight = 1.0 / (g * x + h * y + i)
        places = []
        for axis in range(2):
            a, b, c = (np.take(column, ids) for column in texel_columns[axis])
            texel = (a * x + b * y + c) * weight
            across, down = np.abs(a - texel * g) * px_size[0], np.abs(b - texel * h) * px_size[1]
            shrink = _shrink(np.maximum(across, down) * weight)
            size = np.take(size_columns[axis], ids) * shrink
            within = np.clip(texel * shrink - np.float32(0.5), np.float32(0.0), size - np.float32(1.0))
            places.append(np.take(end_columns[axis], ids) - size - size + within)
        result = _read(atlas.pixels, places[0], places[1]) * np.take(brightness, ids)
        result[ids == NOTHING] = SKY_GREY
        return np.asarray(result)

    return light


def _columns(table: NDArray[Any], sky: tuple[float, ...]) -> list[FloatArray]:
    """The columns of a table (Q, K) with a last row for the sky, whose id is -1."""
    whole = np.append(table, [sky], axis=0).astype(np.float32)
    return [np.ascontiguousarray(column) for column in whole.T]


def _shrink(texels_per_px: FloatArray) -> FloatArray:
    """2**-level of the level whose texels are about as large as the pixel.

    The exponent of a float is its floored binary logarithm; the factor rounds it to the nearer level.
    """
    exponent = (np.maximum(texels_per_px * np.float32(1.6), np.float32(1.0)).view(np.int32) >> 23) - 127
    return np.asarray(((127 - np.minimum(exponent, MAX_LEVEL)) << 23).view(np.float32))


def _read(pixels: NDArray[np.uint8], x: FloatArray, y: FloatArray) -> FloatArray:
    """Bilinear look-up (...); OpenCV wants maps of less than 32,768 rows and columns."""
    if x.ndim == 2:
        return np.asarray(cv2.remap(pixels, x, y, cv2.INTER_LINEAR), dtype=np.float32)
    padding = -len(x) % _READ_COLUMNS
    x, y = (np.pad(v, (0, padding)).reshape(-1, _READ_COLUMNS) for v in (x, y))
    return np.asarray(cv2.remap(pixels, x, y, cv2.INTER_LINEAR), dtype=np.float32).ravel()[: x.size - padding]
