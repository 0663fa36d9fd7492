"""Orientation and description of given corners, as ORB does it.

Source: Rublee, Rabaud, Konolige, Bradski, "ORB: an efficient alternative to SIFT or SURF", ICCV 2011. cv2.ORB
describes; stored maps hold its descriptors, so the same corner must get the same one for as long as maps live.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.vision.pyramid import GreyImage

DESCRIPTOR_BYTES = 32
BORDER_PX = 19  # what turning a descriptor's pattern may need on each side
_PATCH_PX = 31  # diameter of the circle that orientation is measured in


class Describer:
    """Describes corners on every level of one kind of pyramid."""

    def __init__(self, levels: int, scale_factor: float) -> None:
        self._scales = scale_factor ** np.arange(levels)
        self._orb = cv2.ORB.create(
            scaleFactor=scale_factor, nlevels=levels, edgeThreshold=BORDER_PX, patchSize=_PATCH_PX
        )

    def describe(self, pyramid: list[GreyImage], corners: list[NDArray[np.int32]]) -> NDArray[np.uint8]:
        """Descriptors (N, 32) of whole pixels (n, 2) of every level, level after level.

        The pixels lie at least BORDER_PX from their level's border.
        """
        keypoints = [
            cv2.KeyPoint(x, y, _PATCH_PX * scale, angle, 0.0, level)
            for level, (scale, pixels) in enumerate(zip(self._scales.tolist(), corners, strict=True))
            for (x, y), angle in zip(
                (pixels * scale).tolist(), orientations_deg(pyramid[level], pixels).tolist(), strict=True
            )
        ]
        if not keypoints:
            return np.zeros((0, DESCRIPTOR_BYTES), dtype=np.uint8)
        _, descriptors = self._orb.compute(pyramid[0], keypoints)
        return np.asarray(descriptors, dtype=np.uint8)


def orientations_deg(image: GreyImage, pixels: NDArray[np.int32]) -> NDArray[np.float32]:
    """Direction (N,) from x towards y, in [0, 360), in which the circle about each pixel (N, 2) is brightest.

    To the last bit what cv2.ORB finds: whole moments, and OpenCV's quick arc tangent, which is good to 0.3 deg.
    """
    if len(pixels) == 0:
        return np.zeros(0, dtype=np.float32)
    moments = _moments(np.ascontiguousarray(image), pixels, _half_widths(_PATCH_PX // 2))
    angles = cv2.phase(moments[:, :1].copy(), moments[:, 1:].copy(), angleInDegrees=True)
    return np.asarray(angles, dtype=np.float32).ravel()


def _half_widths(radius: int) -> NDArray[np.int64]:
    """Half the width of a filled circle, row by row from its middle (radius + 1,); the same from each side."""
    middle = int(radius * np.sqrt(0.5) + 1.0)
    half_widths = np.zeros(radius + 1, dtype=np.int64)
    half_widths[: middle + 1] = np.rint(np.sqrt(radius**2 - np.arange(middle + 1) ** 2))
    column = 0
    for row in range(radius, int(np.ceil(radius * np.sqrt(0.5))) - 1, -1):
        while half_widths[column] == half_widths[column + 1]:
            column += 1
        half_widths[row] = column
        column += 1
    return half_widths


@njit(cache=True, nogil=True)
def _moments(image, pixels, half_widths):  # type: ignore[no-untyped-def]
    """First moments (N, 2) float32 of the grey values in the circle about each pixel."""
    moments = np.empty((len(pixels), 2), np.float32)
    radius = len(half_widths) - 1
    for n in range(len(pixels)):
        across, down = np.int32(0), np.int32(0)
        for v in range(-radius, radius + 1):
            row, half = image[pixels[n, 1] + v], half_widths[abs(v)]
            total = np.int32(0)
            for u in range(-half, half + 1):
                grey = np.int32(row[pixels[n, 0] + u])
                across += np.int32(np.int32(u) * grey)
                total += grey
            down += np.int32(v * total)
        moments[n, 0], moments[n, 1] = across, down
    return moments
