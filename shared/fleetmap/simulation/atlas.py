"""All textures of a world in one picture, each halved again and again in width and in height separately.

Streets are seen at grazing angles: a road far away is foreshortened along, a wall sideways. So every texture is
kept at all combinations of widths and heights (a "ripmap", after R. McReynolds and D. Blythe, SIGGRAPH course
notes, 1998), and a pixel reads the one whose texels have the pixel's own size, in each direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import InputError
from fleetmap.simulation.surfaces import GreyImage, Texture

MAX_LEVEL = 6  # sides are multiples of 2**6
_WIDTH_PX = 16384
_MAX_HEIGHT_PX = 32000  # cv2.remap addresses pixels with 16 bits


class Opacities(NamedTuple):
    """Where see-through textures are solid: the mip pyramids of all of them in one row of texels."""

    texels: NDArray[np.uint8]  # (N,) 255 solid, 0 see-through
    level_starts: NDArray[np.int64]  # (T, MAX_LEVEL + 1) first texel of each level; -1: solid everywhere
    level_sizes: NDArray[np.int64]  # (T, MAX_LEVEL + 1, 2) width, height


@dataclass(frozen=True)
class Atlas:
    """Level (i, j) of a texture of size (w, h) at (x, y) starts at x + 2w(1 - 2**-i), y + 2h(1 - 2**-j)."""

    pixels: GreyImage  # (H, W) uint8
    origins_px: NDArray[np.float32]  # (T, 2) x, y of each texture
    sizes_px: NDArray[np.float32]  # (T, 2) width, height of each texture at level (0, 0)
    opacities: tuple[tuple[GreyImage, ...] | None, ...]  # a plain mip pyramid for each see-through texture

    @cached_property
    def packed_opacities(self) -> Opacities:
        """The same pyramids for compiled loops."""
        starts = np.full((len(self.opacities), MAX_LEVEL + 1), -1, dtype=np.int64)
        sizes = np.ones((len(self.opacities), MAX_LEVEL + 1, 2), dtype=np.int64)
        texels, end = [np.zeros(1, dtype=np.uint8)], 1
        for texture, pyramid in enumerate(self.opacities):
            for level, picture in enumerate(pyramid or ()):
                starts[texture, level], sizes[texture, level] = end, picture.shape[::-1]
                texels.append(picture.ravel())
                end += picture.size
        return Opacities(np.concatenate(texels), starts, sizes)


def build_atlas(textures: Sequence[Texture]) -> Atlas:
    """Pack textures, tallest first, onto shelves."""
    sizes = np.array([texture.grey.shape[::-1] for texture in textures], dtype=np.int64)
    origins, height_px = _shelves(2 * sizes)
    pixels = np.zeros((height_px, _WIDTH_PX), dtype=np.uint8)
    for texture, (x, y) in zip(textures, origins.tolist(), strict=True):
        _place_levels(pixels, texture.grey, x, y)
    opacities = tuple(None if t.opacity is None else _pyramid(t.opacity) for t in textures)
    return Atlas(pixels, origins.astype(np.float32), sizes.astype(np.float32), opacities)


def _shelves(sizes: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    if sizes[:, 0].max() > _WIDTH_PX:
        raise ValueError(f"a texture is {sizes[:, 0].max() // 2} px wide, more than {_WIDTH_PX // 2}")
    origins = np.zeros_like(sizes)
    x = y = shelf_height = 0
    for index in np.argsort(-sizes[:, 1], kind="stable").tolist():
        width, height = sizes[index].tolist()
        if x + width > _WIDTH_PX:
            x, y = 0, y + shelf_height
        if x == 0:
            shelf_height = height
        origins[index] = x, y
        x += width
    if y + shelf_height > _MAX_HEIGHT_PX:
        raise InputError(
            f"the street's textures need {y + shelf_height} rows of {_WIDTH_PX} pixels, "
            f"more than {_MAX_HEIGHT_PX}; build a shorter street"
        )
    return origins, y + shelf_height


def _place_levels(pixels: GreyImage, grey: GreyImage, x: int, y: int) -> None:
    height, width = grey.shape
    narrowed: GreyImage = grey
    for i in range(MAX_LEVEL + 1):
        level: GreyImage = narrowed
        column = x + 2 * width - 2 * (width >> i)
        for j in range(MAX_LEVEL + 1):
            row = y + 2 * height - 2 * (height >> j)
            pixels[row : row + level.shape[0], column : column + level.shape[1]] = level
            level = _halved(level, 1, 2)
        narrowed = _halved(narrowed, 2, 1)


def _pyramid(opacity: GreyImage) -> tuple[GreyImage, ...]:
    levels = [opacity]
    for _ in range(MAX_LEVEL):
        levels.append(_halved(levels[-1], 2, 2))
    return tuple(levels)


def _halved(image: GreyImage, across: int, down: int) -> GreyImage:
    size = (max(image.shape[1] // across, 1), max(image.shape[0] // down, 1))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
