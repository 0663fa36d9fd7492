"""The image pyramid that features are found on, and where its pixels lie in the image.

Level n is ``scale_factor ** n`` smaller than the image, to whole pixels. Both have the centre of their top-left
pixel at (0, 0) and cover the same field of view, so along each axis

    x_level = (x + 0.5) / s - 0.5,    s = size of the image / size of the level,

with s from the whole sizes: at the far border of an image, the nominal factor would be up to half a pixel wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
GreyImage = NDArray[np.uint8]
# Not cv2.GaussianBlur: for bytes it has an arithmetic of its own, which cv2.ORB does not meet.
_BLUR = cv2.getGaussianKernel(7, 2.0, cv2.CV_32F)


@dataclass(frozen=True)
class Pyramid:
    """The levels of an image, itself first; and the same as descriptors look at them."""

    levels: tuple[GreyImage, ...]

    @cached_property
    def blurred(self) -> tuple[GreyImage, ...]:
        """See fleetmap.vision.descriptors."""
        return tuple(blurred(level) for level in self.levels)


def blurred(image: GreyImage) -> GreyImage:
    """A level as descriptors look at it."""
    smooth = cv2.sepFilter2D(image, -1, _BLUR, _BLUR, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(smooth, dtype=np.uint8)


def image_pyramid(image: GreyImage, levels: int, scale_factor: float) -> list[GreyImage]:
    """Grey images (H, W) uint8 of falling size, the image itself first, each interpolated from the one before.

    They are, bit by bit, the images that cv2.ORB looks at.
    """
    pyramid = [np.ascontiguousarray(image)]
    for width_px, height_px in pyramid_sizes_px(image.shape[1], image.shape[0], levels, scale_factor)[1:]:
        smaller = cv2.resize(pyramid[-1], (width_px, height_px), interpolation=cv2.INTER_LINEAR_EXACT)
        pyramid.append(np.asarray(smaller, dtype=np.uint8))
    return pyramid


def pyramid_sizes_px(width_px: int, height_px: int, levels: int, scale_factor: float) -> list[tuple[int, int]]:
    """Width and height of every level; none is smaller than one pixel."""
    scales = [scale_factor**level for level in range(levels)]
    return [(max(1, round(width_px / scale)), max(1, round(height_px / scale))) for scale in scales]


def scales_of_level(image_shape: tuple[int, ...], level_shape: tuple[int, ...]) -> Array:
    """Image pixels per level pixel along x and y (2,), from the shapes (H, W) of both."""
    return np.array([image_shape[1] / level_shape[1], image_shape[0] / level_shape[0]])


def level_from_image_px(pixels: Array, image_shape: tuple[int, ...], level_shape: tuple[int, ...]) -> Array:
    """Where pixels (N, 2) of the image lie in a level; shapes are (H, W)."""
    return (pixels + 0.5) / scales_of_level(image_shape, level_shape) - 0.5


def image_from_level_px(pixels: Array, image_shape: tuple[int, ...], level_shape: tuple[int, ...]) -> Array:
    """Where pixels (N, 2) of a level lie in the image; shapes are (H, W)."""
    return (pixels + 0.5) * scales_of_level(image_shape, level_shape) - 0.5
