"""Orientation and description of given corners, as ORB does it; compiled, without an object for every corner.

Source: Rublee, Rabaud, Konolige, Bradski, "ORB: an efficient alternative to SIFT or SURF", ICCV 2011. To the last
bit what cv2.ORB computes: stored maps hold its descriptors, so the same corner must get the same one for as long
as maps live.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.vision.orb_pattern import pattern_offsets_px
from fleetmap.vision.pyramid import GreyImage

DESCRIPTOR_BYTES = 32
BORDER_PX = 19  # what turning a descriptor's pattern may need on each side
_PATCH_RADIUS_PX = 15  # of the circle that orientation is measured in
_PATTERN = pattern_offsets_px()
_DEG = np.float32(np.pi / 180.0)
_ROUNDER = np.float32(1.5 * 2**23)  # added and taken away again it leaves a float32 whole, half to even


def describe_along(
    blurred_image: GreyImage, pixels: NDArray[np.int32], angles_deg: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Descriptors (N, 32) of whole pixels (N, 2) of one level, at least BORDER_PX from its border.

    They are taken from the blurred level, along orientations (N,).
    """
    descriptors = np.empty((len(pixels), DESCRIPTOR_BYTES), dtype=np.uint8)
    _describe(blurred_image.ravel(), blurred_image.shape[1], pixels, angles_deg, _PATTERN, descriptors)
    return descriptors


def orientations_deg(image: GreyImage, pixels: NDArray[np.int32]) -> NDArray[np.float32]:
    """Direction (N,) from x towards y, in [0, 360), in which the circle about each pixel (N, 2) is brightest.

    Whole moments, and OpenCV's quick arc tangent, which is good to 0.3 deg.
    """
    if len(pixels) == 0:
        return np.zeros(0, dtype=np.float32)
    across, down = _moments(np.ascontiguousarray(image), pixels, _CIRCLE)
    return np.asarray(cv2.phase(across, down, angleInDegrees=True), dtype=np.float32).ravel()


def _circle_mask(radius: int) -> NDArray[np.uint8]:
    """A filled circle of 255 in zeros, one column wider than high; as ORB draws it, the same from each side."""
    middle = int(radius * np.sqrt(0.5) + 1.0)
    half_widths = np.zeros(radius + 1, dtype=np.int64)  # row by row from the middle
    half_widths[: middle + 1] = np.rint(np.sqrt(radius**2 - np.arange(middle + 1) ** 2))
    column = 0
    for row in range(radius, int(np.ceil(radius * np.sqrt(0.5))) - 1, -1):
        while half_widths[column] == half_widths[column + 1]:
            column += 1
        half_widths[row] = column
        column += 1
    rows, columns = np.arange(-radius, radius + 1), np.arange(-radius, radius + 2)
    inside = np.abs(columns)[None, :] <= half_widths[np.abs(rows)][:, None]
    return np.where(inside, np.uint8(255), np.uint8(0))


_CIRCLE = _circle_mask(_PATCH_RADIUS_PX)


@njit(cache=True, nogil=True)
def _moments(image, pixels, circle):  # type: ignore[no-untyped-def]
    """First moments (N,) float32 across and down of the grey values in the circle about each pixel.

    Columns are summed first, sixteen at once; no sum of theirs leaves 16 bits (15 * 16 / 2 * 255 = 30600).
    """
    radius, columns = len(circle) // 2, circle.shape[1]
    across, down = np.empty(len(pixels), np.float32), np.empty(len(pixels), np.float32)
    greys, lean = np.empty(columns, np.int16), np.empty(columns, np.int16)
    for n in range(len(pixels)):
        x, y = pixels[n, 0] - radius, pixels[n, 1] - radius
        greys[:], lean[:] = 0, 0
        for v in range(len(circle)):
            row, mask = image[y + v, x : x + columns], circle[v]
            for u in range(columns):
                grey = np.int16(row[u] & mask[u])
                greys[u] += grey
                lean[u] += np.int16((v - radius) * grey)
        moment_across, moment_down = 0, 0
        for u in range(columns):
            moment_across += (u - radius) * greys[u]
            moment_down += lean[u]
        across[n], down[n] = moment_across, moment_down
    return across, down


@njit(cache=True, nogil=True)
def _describe(blurred, width, pixels, angles_deg, pattern, descriptors):  # type: ignore[no-untyped-def]
    """Compare the pairs of pixels (2, 2, 256) that the pattern names, turned by each corner's angle."""
    offsets = np.empty((2, pattern.shape[2]), np.int32)
    for n in range(len(pixels)):
        cosine, sine = math.cos(angles_deg[n] * _DEG), math.sin(angles_deg[n] * _DEG)
        for end in range(2):
            x, y, offset = pattern[end, 0], pattern[end, 1], offsets[end]
            for pair in range(len(offset)):
                across, down = x[pair] * cosine - y[pair] * sine, x[pair] * sine + y[pair] * cosine
                row, column = np.int32((down + _ROUNDER) - _ROUNDER), np.int32((across + _ROUNDER) - _ROUNDER)
                offset[pair] = row * np.int32(width) + column
        centre = pixels[n, 1] * width + pixels[n, 0]
        for byte in range(descriptors.shape[1]):
            bits = 0
            for bit in range(8):
                pair = 8 * byte + bit
                first = blurred[np.uint64(centre + offsets[0, pair])]
                second = blurred[np.uint64(centre + offsets[1, pair])]
                bits |= int(first < second) << bit
            descriptors[n, byte] = bits
