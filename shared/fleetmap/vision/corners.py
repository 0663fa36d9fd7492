"""FAST corners of one image, and an even choice among them; compiled, without an object for every corner.

Source: Rosten & Drummond, "Machine learning for high-speed corner detection", ECCV 2006. A pixel is a corner when
nine contiguous pixels of the circle of sixteen about it are all brighter, or all darker, than itself by more than
a threshold; its score is the largest difference at which that holds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.vision.pyramid import GreyImage

IntArray = NDArray[np.int64]

_HALF_CIRCLE = np.array([(0, 3), (1, 3), (2, 2), (3, 1), (3, 0), (3, -1), (2, -2), (1, -3)])
_CIRCLE = np.concatenate([_HALF_CIRCLE, -_HALF_CIRCLE])  # (16, 2) x, y
_STRIP_PX = 4096  # pixels that are scored together: their intermediate values stay in the processor's cache


@dataclass(frozen=True)
class Corners:
    """Where an image's scores peak, row by row."""

    pixels: NDArray[np.int32]  # (N, 2) x, y
    scores: NDArray[np.uint8]  # (N,) grey levels

    def __len__(self) -> int:
        return len(self.pixels)


def corner_scores(image: GreyImage) -> NDArray[np.uint8]:
    """The score (H, W) uint8 of every pixel of a grey image (H, W); without meaning 3 pixels from its border."""
    if min(image.shape) < 7:
        return np.zeros(image.shape, dtype=np.uint8)
    scores: NDArray[np.uint8] = _scores(np.ascontiguousarray(image), _CIRCLE)
    return scores


def corners_of(scores: NDArray[np.uint8], threshold: int, border_px: int) -> Corners:
    """Pixels whose score is above a threshold and above their eight neighbours', off the border (at least 4)."""
    pixels, peaks = _peaks(scores, threshold, border_px)
    return Corners(pixels, peaks)


def spread_evenly(corners: Corners, count: int, cell_px: float) -> IntArray:
    """Indices, sorted, of at most ``count`` corners: round after round the next best of every square cell."""
    if count <= 0 or len(corners) == 0:
        return np.zeros(0, dtype=np.int64)
    cells = (corners.pixels / cell_px).astype(np.int64)
    chosen = _next_best_of_cells(cells[:, 1] * (cells[:, 0].max() + 1) + cells[:, 0], corners.scores, count)
    return np.sort(chosen)


@njit(cache=True, nogil=True)
def _scores(image, circle):  # type: ignore[no-untyped-def]
    """Strip by strip of the flattened image, each step a plain loop that LLVM turns into vector instructions.

    Of the 16 arcs of nine, two share eight pixels: their minima are those of the eight and of either neighbour.
    """
    height, width = image.shape
    pixels, scores = image.ravel(), np.zeros(height * width, np.uint8)
    offsets = circle[:, 1] * width + circle[:, 0]
    lowest, highest = np.empty((2, 8, _STRIP_PX), np.uint8), np.empty((2, 8, _STRIP_PX), np.uint8)
    floor, ceiling = np.empty(_STRIP_PX, np.uint8), np.empty(_STRIP_PX, np.uint8)
    start, end = 3 * width + 3, height * width - 3 * width - 3
    for first in range(start, end, _STRIP_PX):
        n = min(_STRIP_PX, end - first)
        for k in range(8):  # of two pixels
            a, b = first + offsets[2 * k + 1], first + offsets[(2 * k + 2) % 16]
            _lesser(pixels[a : a + n], pixels[b : b + n], lowest[0, k, :n])
            _greater(pixels[a : a + n], pixels[b : b + n], highest[0, k, :n])
        for k in range(8):  # of four
            _lesser(lowest[0, k], lowest[0, (k + 1) % 8], lowest[1, k, :n])
            _greater(highest[0, k], highest[0, (k + 1) % 8], highest[1, k, :n])
        floor[:], ceiling[:] = 0, 255
        for k in range(8):
            a, b = first + offsets[2 * k], first + offsets[(2 * k + 9) % 16]
            ends = pixels[a : a + n], pixels[b : b + n]
            _raise_floor(lowest[1, k], lowest[1, (k + 2) % 8], ends[0], ends[1], floor[:n])
            _lower_ceiling(highest[1, k], highest[1, (k + 2) % 8], ends[0], ends[1], ceiling[:n])
        _largest_contrast(pixels[first : first + n], floor, ceiling, scores[first : first + n])
    return scores.reshape(height, width)


@njit(cache=True, nogil=True)
def _lesser(a, b, out):  # type: ignore[no-untyped-def]
    for n in range(len(out)):
        out[n] = a[n] if a[n] < b[n] else b[n]


@njit(cache=True, nogil=True)
def _greater(a, b, out):  # type: ignore[no-untyped-def]
    for n in range(len(out)):
        out[n] = b[n] if a[n] < b[n] else a[n]


@njit(cache=True, nogil=True)
def _raise_floor(a, b, end_a, end_b, floor):  # type: ignore[no-untyped-def]
    """The darkest of nine: of eight (a and b), and of the brighter of their neighbours on the circle."""
    for n in range(len(floor)):
        eight = a[n] if a[n] < b[n] else b[n]
        end = end_b[n] if end_a[n] < end_b[n] else end_a[n]
        nine = eight if eight < end else end
        floor[n] = nine if floor[n] < nine else floor[n]


@njit(cache=True, nogil=True)
def _lower_ceiling(a, b, end_a, end_b, ceiling):  # type: ignore[no-untyped-def]
    for n in range(len(ceiling)):
        eight = b[n] if a[n] < b[n] else a[n]
        end = end_a[n] if end_a[n] < end_b[n] else end_b[n]
        nine = end if eight < end else eight
        ceiling[n] = ceiling[n] if ceiling[n] < nine else nine


@njit(cache=True, nogil=True)
def _largest_contrast(centre, floor, ceiling, out):  # type: ignore[no-untyped-def]
    for n in range(len(out)):
        above = floor[n] - centre[n] if floor[n] > centre[n] else 0
        below = centre[n] - ceiling[n] if ceiling[n] < centre[n] else 0
        out[n] = np.uint8(above if above > below else below)


@njit(cache=True, nogil=True)
def _peaks(scores, threshold, border_px):  # type: ignore[no-untyped-def]
    height, width = scores.shape
    room = max(0, height - 2 * border_px) * max(0, width - 2 * border_px) // 4 + height + width
    pixels, peaks, row = np.empty((room, 2), np.int32), np.empty(room, np.uint8), np.zeros(width, np.uint8)
    count = 0
    for y in range(border_px, height - border_px):
        _peaks_of_row(scores[y - 1], scores[y], scores[y + 1], np.uint8(threshold), row)
        for x in range(border_px, width - border_px):
            if row[x] > 0:
                pixels[count, 0], pixels[count, 1], peaks[count] = x, y, row[x]
                count += 1
    return pixels[:count].copy(), peaks[:count].copy()


@njit(cache=True, nogil=True)
def _peaks_of_row(above, row, below, threshold, out):  # type: ignore[no-untyped-def]
    for x in range(1, len(row) - 1):
        top, bottom = (
            max(max(above[x - 1], above[x]), above[x + 1]),
            max(max(below[x - 1], below[x]), below[x + 1]),
        )
        around = max(max(top, bottom), max(row[x - 1], row[x + 1]))
        out[x] = row[x] if (row[x] > around) & (row[x] > threshold) else np.uint8(0)


@njit(cache=True, nogil=True)
def _next_best_of_cells(cells, scores, count):  # type: ignore[no-untyped-def]
    """The strongest of every cell, strongest first, then every cell's second, and so on; at a tie the earlier."""
    strongest_first = _sorted_by_key(255 - scores.astype(np.int64), 256)
    seen, rank = np.zeros(cells.max() + 1, np.int64), np.empty(len(cells), np.int64)
    for place, corner in enumerate(strongest_first):
        rank[place] = seen[cells[corner]]
        seen[cells[corner]] += 1
    return strongest_first[_sorted_by_key(rank, seen.max())[:count]]


@njit(cache=True, nogil=True)
def _sorted_by_key(keys, key_count):  # type: ignore[no-untyped-def]
    """Indices in the order of small whole keys, equal ones in the order they stand in (counting sort)."""
    slots = np.zeros(key_count + 1, np.int64)
    for key in keys:
        slots[key + 1] += 1
    for key in range(key_count):
        slots[key + 1] += slots[key]
    order = np.empty(len(keys), np.int64)
    for index, key in enumerate(keys):
        order[slots[key]] = index
        slots[key] += 1
    return order
