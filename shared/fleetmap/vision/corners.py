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
    scores = np.empty(image.shape, dtype=np.uint8)
    _score_all(image.ravel(), image.shape[1], scores.ravel())
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
def _score_all(image, width, scores):  # type: ignore[no-untyped-def]
    """All rows as one, without ends: what reaches over the border has no meaning."""
    size = len(image) - 6 * width
    above_3, above_2, above_1 = image[:size], image[width:][:size], image[2 * width :][:size]
    row = image[3 * width :][:size]
    below_1, below_2, below_3 = image[4 * width :][:size], image[5 * width :][:size], image[6 * width :]
    _score_row(above_3, above_2, above_1, row, below_1, below_2, below_3, scores[3 * width + 3 :][: size - 6])


@njit(cache=True, nogil=True)
def _score_row(above_3, above_2, above_1, row, below_1, below_2, below_3, scores):  # type: ignore[no-untyped-def]
    """A plain loop over bytes, which LLVM turns into vector instructions."""
    for x in range(len(scores)):  # the left border of a window of 7 x 7 pixels
        a, b, c, d = above_3[x + 3], above_3[x + 4], above_2[x + 5], above_1[x + 6]
        e, f, g, h = row[x + 6], below_1[x + 6], below_2[x + 5], below_3[x + 4]
        i, j, k, l = below_3[x + 3], below_3[x + 2], below_2[x + 1], below_1[x]  # noqa: E741
        m, n, o, p = row[x], above_1[x], above_2[x + 1], above_3[x + 2]
        floor = _outstanding_arc(_lesser, _greater, a, b, c, d, e, f, g, h, i, j, k, l, m, n, o, p)
        ceiling = _outstanding_arc(_greater, _lesser, a, b, c, d, e, f, g, h, i, j, k, l, m, n, o, p)
        centre = row[x + 3]
        brighter, darker = max(floor, centre) - centre, centre - min(ceiling, centre)
        scores[x] = max(np.uint8(brighter), np.uint8(darker))


@njit(cache=True, nogil=True)
def _outstanding_arc(least, most, a, b, c, d, e, f, g, h, i, j, k, l, m, n, o, p):  # type: ignore[no-untyped-def]  # noqa: E741
    """Of the 16 arcs of nine on the circle a..p: the most of what is the least in each of them.

    The least of a row of pixels is named by its ends. Two arcs share eight pixels, and have one of either
    neighbour more.
    """
    bc, de, fg, hi = least(b, c), least(d, e), least(f, g), least(h, i)
    jk, lm, no, pa = least(j, k), least(l, m), least(n, o), least(p, a)
    be, dg, fi, hk = least(bc, de), least(de, fg), least(fg, hi), least(hi, jk)
    jm, lo, na, pc = least(jk, lm), least(lm, no), least(no, pa), least(pa, bc)
    first = most(least(least(be, fi), most(a, j)), least(least(dg, hk), most(c, l)))
    second = most(least(least(fi, jm), most(e, n)), least(least(hk, lo), most(g, p)))
    third = most(least(least(jm, na), most(i, b)), least(least(lo, pc), most(k, d)))
    fourth = most(least(least(na, be), most(m, f)), least(least(pc, dg), most(o, h)))
    return most(most(first, second), most(third, fourth))


@njit(cache=True, nogil=True)
def _lesser(a, b):  # type: ignore[no-untyped-def]
    return a if a < b else b


@njit(cache=True, nogil=True)
def _greater(a, b):  # type: ignore[no-untyped-def]
    return b if a < b else a


@njit(cache=True, nogil=True)
def _peaks(scores, threshold, border_px):  # type: ignore[no-untyped-def]
    height, width = scores.shape
    room = max(0, height - 2 * border_px) * max(0, width - 2 * border_px) // 4 + height + width
    pixels, peaks = np.empty((room, 2), np.int32), np.empty(room, np.uint8)
    row = np.zeros((width + 7) // 8 * 8, np.uint8)
    eights = row.view(np.uint64)
    count = 0
    for y in range(border_px, height - border_px):
        _peaks_of_row(scores[y - 1], scores[y], scores[y + 1], np.uint8(threshold), row[:width])
        for first in range(border_px // 8 * 8, width - border_px, 8):
            if eights[first // 8] == 0:  # as most are
                continue
            for x in range(max(first, border_px), min(first + 8, width - border_px)):
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
