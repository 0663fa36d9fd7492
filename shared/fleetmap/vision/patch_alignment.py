"""Where a patch of one image lies in another, to a tenth of a pixel; compiled.

Descriptors tell which corner is which, but not where it is: corners are found on the grid of a pyramid level, and
their place wanders by most of a pixel of it from image to image. The patch around the corner of one view is
therefore aligned with the other views by the inverse compositional algorithm, with brightness and contrast free.
Source: Baker & Matthews, "Lucas-Kanade 20 years on", IJCV 2004, sections 3.2 and (gain, bias) part 3; for maps of
points, Forster, Pizzoli, Scaramuzza, "SVO", ICRA 2014, section IV.B.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.vision.pyramid import GreyImage, level_from_image_px, scales_of_level

Array = NDArray[np.float64]
Patches = NDArray[np.float32]  # (N, PATCH_PX, PATCH_PX)

_HALF_PX = 5
PATCH_PX = 2 * (_HALF_PX + 1) + 1  # with a border for the gradients
_MAX_ITERATIONS = 12
_CONVERGED_PX = 0.01
_MAX_STEP_PX = 2.0  # of the level looked at; a longer step has lost the patch
_MIN_CORRELATION = 0.8
_MIN_TEXTURE = 4.0  # grey levels of standard deviation
_MIN_CORNERNESS = 0.01  # smaller over larger eigenvalue: along an edge a patch can slide


def sample_patches(pyramid: Sequence[GreyImage], pixels: Array, octaves: NDArray[np.integer]) -> Patches:
    """The patches (N, PATCH_PX, PATCH_PX) about pixels (N, 2) of an image, on their own pyramid levels.

    NaN in part or whole where a patch reaches beyond its image.
    """
    patches = np.full((len(pixels), PATCH_PX, PATCH_PX), np.nan, np.float32)
    for octave in np.unique(octaves):
        rows = np.flatnonzero(octaves == octave)
        level = pyramid[octave]
        centres = level_from_image_px(pixels[rows], pyramid[0].shape, level.shape)
        patches[rows] = _sampled(level, np.ascontiguousarray(centres))
    return patches


def align_patches(
    pyramid: Sequence[GreyImage],
    scale_factor: float,
    patches: Patches,
    warps: Array,
    pixels: Array,
    max_shifts_px: Array,
) -> tuple[Array, NDArray[np.bool_]]:
    """Where patches lie in an image, near pixels (N, 2): refined pixels (N, 2), and which could be aligned (N,).

    Args:
        pyramid: of the image looked at.
        scale_factor: between its levels.
        patches: (N, PATCH_PX, PATCH_PX), see :func:`sample_patches`.
        warps: (N, 2, 2) pixels of this image (level 0) per pixel of the patch.
        pixels: (N, 2) of this image, where to start.
        max_shifts_px: (N,) an alignment further from the start than this is not believed.

    Not aligned is what leaves the image, has no texture in two directions, slides away or does not look alike.
    """
    stretch = np.sqrt(np.abs(warps[:, 0, 0] * warps[:, 1, 1] - warps[:, 0, 1] * warps[:, 1, 0]))
    with np.errstate(divide="ignore", invalid="ignore"):
        wanted = np.log(stretch) / np.log(scale_factor)
    usable = np.isfinite(wanted) & np.isfinite(pixels).all(axis=1) & np.isfinite(patches).all(axis=(1, 2))
    levels = np.clip(np.rint(np.where(usable, wanted, 0.0)), 0, len(pyramid) - 1).astype(np.int64)
    refined, aligned = np.array(pixels, dtype=np.float64), np.zeros(len(pixels), np.bool_)
    for number in np.unique(levels[usable]):
        rows = np.flatnonzero(usable & (levels == number))
        level = pyramid[number]
        scales = scales_of_level(pyramid[0].shape, level.shape)
        starts = level_from_image_px(pixels[rows], pyramid[0].shape, level.shape)
        found, ok = _aligned(level, patches[rows], np.ascontiguousarray(warps[rows] / scales[:, None]), starts)
        shifts = (found - starts) * scales
        ok &= np.linalg.norm(shifts, axis=1) <= max_shifts_px[rows]
        refined[rows[ok]] = pixels[rows[ok]] + shifts[ok]
        aligned[rows] = ok
    return refined, aligned


@njit(cache=True, nogil=True)
def _bilinear(image, x, y):  # type: ignore[no-untyped-def]
    """NaN beyond the image's inner part."""
    height, width = image.shape
    if not (0.0 <= x < width - 1 and 0.0 <= y < height - 1):
        return np.nan
    column, row = int(x), int(y)
    a, b = x - column, y - row
    upper = (1.0 - a) * image[row, column] + a * image[row, column + 1]
    lower = (1.0 - a) * image[row + 1, column] + a * image[row + 1, column + 1]
    return (1.0 - b) * upper + b * lower


@njit(cache=True, nogil=True)
def _sampled(level, centres):  # type: ignore[no-untyped-def]
    patches = np.empty((len(centres), PATCH_PX, PATCH_PX), np.float32)
    reach = PATCH_PX // 2
    for n in range(len(centres)):
        for j in range(PATCH_PX):
            for i in range(PATCH_PX):
                patches[n, j, i] = _bilinear(level, centres[n, 0] + i - reach, centres[n, 1] + j - reach)
    return patches


@njit(cache=True, nogil=True, error_model="numpy")
def _aligned(level, patches, warps, starts):  # type: ignore[no-untyped-def]
    found, ok = starts.copy(), np.zeros(len(starts), np.bool_)
    side = 2 * _HALF_PX + 1
    template, by_x, by_y = np.empty((side, side)), np.empty((side, side)), np.empty((side, side))
    seen = np.empty((side, side))
    for n in range(len(starts)):
        information = _prepare(patches[n], template, by_x, by_y)
        if information[3] <= 0.0:
            continue
        x, y, correlation = _follow(level, warps[n], starts[n], template, by_x, by_y, information, seen)
        if correlation >= _MIN_CORRELATION:
            found[n, 0], found[n, 1], ok[n] = x, y, True
    return found, ok


@njit(cache=True, nogil=True, error_model="numpy")
def _prepare(patch, template, by_x, by_y):  # type: ignore[no-untyped-def]
    """Template and its gradients without mean, the gradients without contrast; (h11, h12, h22, squares).

    The squares are zero where the patch cannot be aligned.
    """
    side = 2 * _HALF_PX + 1
    for j in range(side):
        for i in range(side):
            template[j, i] = patch[j + 1, i + 1]
            by_x[j, i] = 0.5 * (patch[j + 1, i + 2] - patch[j + 1, i])
            by_y[j, i] = 0.5 * (patch[j + 2, i + 1] - patch[j, i + 1])
    template -= template.mean()
    by_x -= by_x.mean()
    by_y -= by_y.mean()
    squares = (template * template).sum()
    if squares < _MIN_TEXTURE * _MIN_TEXTURE * side * side:
        return 0.0, 0.0, 0.0, 0.0
    by_x -= template * ((by_x * template).sum() / squares)
    by_y -= template * ((by_y * template).sum() / squares)
    h11, h12, h22 = (by_x * by_x).sum(), (by_x * by_y).sum(), (by_y * by_y).sum()
    root = np.sqrt((h11 - h22) ** 2 + 4.0 * h12 * h12)
    if h11 + h22 - root < _MIN_CORNERNESS * (h11 + h22 + root):
        return 0.0, 0.0, 0.0, 0.0
    return h11, h12, h22, squares


@njit(cache=True, nogil=True, error_model="numpy")
def _follow(level, warp, start, template, by_x, by_y, information, seen):  # type: ignore[no-untyped-def]
    """The patch shifted by Gauss-Newton: its place in the level and the correlation there, -1 where it is lost."""
    h11, h12, h22, squares = information
    determinant = h11 * h22 - h12 * h12
    x, y, correlation = start[0], start[1], -1.0
    side = 2 * _HALF_PX + 1
    for _ in range(_MAX_ITERATIONS):
        for j in range(side):
            for i in range(side):
                a, b = i - _HALF_PX, j - _HALF_PX
                seen[j, i] = _bilinear(
                    level, x + warp[0, 0] * a + warp[0, 1] * b, y + warp[1, 0] * a + warp[1, 1] * b
                )
        seen -= seen.mean()
        together, own = (seen * template).sum(), (seen * seen).sum()
        if not together > 0.0:  # NaN where the patch leaves the image
            return x, y, -1.0
        correlation = together / np.sqrt(own * squares)
        contrast = together / squares
        right = 0.0
        down = 0.0
        for j in range(side):
            for i in range(side):
                error = seen[j, i] / contrast - template[j, i]
                right += by_x[j, i] * error
                down += by_y[j, i] * error
        dx, dy = -(h22 * right - h12 * down) / determinant, -(h11 * down - h12 * right) / determinant
        step_x, step_y = warp[0, 0] * dx + warp[0, 1] * dy, warp[1, 0] * dx + warp[1, 1] * dy
        if not abs(step_x) + abs(step_y) < 2.0 * _MAX_STEP_PX:
            return x, y, -1.0
        x += step_x
        y += step_y
        if step_x * step_x + step_y * step_y < _CONVERGED_PX * _CONVERGED_PX:
            break
    return x, y, correlation
