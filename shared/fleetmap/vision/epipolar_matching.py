"""Matching of binary descriptors along epipolar lines.

All lines pass through the epipole. The angles about it are divided into sectors, each feature of the second image
is put into those whose lines it may lie on, and a line looks at the features of one sector.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.vision.features import Features
from fleetmap.vision.matching import as_words, hamming_to_all, index_pairs

Array = NDArray[np.float64]
IntArray = NDArray[np.int32]
BoolArray = NDArray[np.bool_]

_SECTORS = 512
_NEARLY_INFINITE = 1e-9  # of the epipole's homogeneous coordinates
_EPIPOLE_RADIUS_PX = 10.0  # around the epipole every line passes close by, and the depth is unseen


def match_epipolar(
    features_a: Features,
    features_b: Features,
    use_a: BoolArray,
    use_b: BoolArray,
    fundamental_ba: Array,
    epipole_in_b_px: Array,
    max_distance: int,
    sigma_threshold: float = 1.96,
) -> IntArray:
    """Index pairs (P, 2) int32 of features that look alike and lie on each other's epipolar line, sorted by a.

    Args:
        features_a: of the first image; use_a: (N,) which of them may be matched.
        features_b: of the second image; use_b: (M,).
        fundamental_ba: (3, 3) with x_b^T F x_a = 0 for undistorted pixels.
        epipole_in_b_px: (2,) image of camera a's centre in b; features near it are left out. NaN = anywhere.
        max_distance: Hamming bits; a pair is each other's closest among the candidates.
        sigma_threshold: distance to the line, in sigmas of the feature in b.
    """
    sigmas_b = features_b.sigmas_px
    seen_b = np.flatnonzero(use_b & _is_off_epipole(features_b.pixels, sigmas_b, epipole_in_b_px))
    if len(features_a) == 0 or len(seen_b) == 0:
        return np.zeros((0, 2), dtype=np.int32)
    pairs: IntArray = _match_along_lines(
        np.ascontiguousarray(features_a.pixels),
        as_words(features_a.descriptors),
        np.flatnonzero(use_a),
        features_b.pixels[seen_b],
        as_words(features_b.descriptors[seen_b]),
        sigma_threshold * sigmas_b[seen_b],
        np.ascontiguousarray(fundamental_ba, dtype=np.float64),
        _epipole(fundamental_ba),
        max_distance,
    )
    pairs[:, 1] = seen_b[pairs[:, 1]]
    return pairs


def _is_off_epipole(pixels: Array, sigmas_px: Array, epipole_px: Array) -> BoolArray:
    if not np.all(np.isfinite(epipole_px)):
        return np.ones(len(pixels), dtype=np.bool_)
    distances = np.linalg.norm(pixels - epipole_px, axis=1)
    return np.asarray(distances >= _EPIPOLE_RADIUS_PX * sigmas_px)


def _epipole(fundamental_ba: Array) -> Array:
    """The pixel (2,) of b that all its epipolar lines pass through; very far away in place of at infinity."""
    x, y, w = np.linalg.svd(fundamental_ba)[0][:, 2]
    return np.array([x, y]) / (w if abs(w) > _NEARLY_INFINITE else _NEARLY_INFINITE)


@njit(cache=True, nogil=True)
def _match_along_lines(pixels_a, words_a, chosen_a, pixels_b, words_b, reach_b, F, epipole, max_distance):  # type: ignore[no-untyped-def]
    middle, axes, is_far = _pencil(epipole, pixels_b)
    starts, members = _features_in_sectors(pixels_b, reach_b, epipole, axes)
    columns = np.empty((4, len(members)), np.uint64)
    for slot, j in enumerate(members):
        for word in range(4):
            columns[word, slot] = words_b[j, word]
    distances = np.empty(len(pixels_b), np.int64)
    best_of_b = np.full(len(pixels_b), max_distance + 1, np.int64)
    a_of_b = np.full(len(pixels_b), -1, np.int32)
    b_of_a = np.full(len(pixels_a), -1, np.int32)
    for i in chosen_a:
        u, v = pixels_a[i, 0], pixels_a[i, 1]
        x = F[0, 0] * u + F[0, 1] * v + F[0, 2]
        y = F[1, 0] * u + F[1, 1] * v + F[1, 2]
        w = F[2, 0] * u + F[2, 1] * v + F[2, 2]
        length = np.sqrt(x * x + y * y)
        if not length > 0.0:
            continue
        x, y, w = x / length, y / length, w / length
        dx, dy = -y, x
        if is_far:  # all lines look alike but for where they pass the middle
            offset = x * middle[0] + y * middle[1] + w
            dx, dy = middle[0] - offset * x - epipole[0], middle[1] - offset * y - epipole[1]
        sector = int(_sector(axes, dx, dy)) % _SECTORS
        first, end = starts[sector], starts[sector + 1]
        hamming_to_all(words_a[i], columns[:, first:end], distances[: end - first])
        best = max_distance + 1
        for slot in range(first, end):
            distance, j = distances[slot - first], members[slot]
            if distance > max_distance or abs(x * pixels_b[j, 0] + y * pixels_b[j, 1] + w) > reach_b[j]:
                continue
            if distance < best:
                best = distance
                b_of_a[i] = j
            if distance < best_of_b[j]:
                best_of_b[j] = distance
                a_of_b[j] = i
    return index_pairs(b_of_a, a_of_b, True)


@njit(cache=True, nogil=True)
def _pencil(epipole, pixels):  # type: ignore[no-untyped-def]
    """The middle of the pixels, the two axes that angles are taken in, and whether the epipole is far away.

    Far away, the axes lie along and across the line to the middle; the second grows with the distance, so that
    the lines that cross the image always fill the sectors.
    """
    left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
    for j in range(len(pixels)):
        left, right = min(left, pixels[j, 0]), max(right, pixels[j, 0])
        top, bottom = min(top, pixels[j, 1]), max(bottom, pixels[j, 1])
    size = max(0.5 * np.sqrt((right - left) ** 2 + (bottom - top) ** 2), 1.0)
    middle = (0.5 * (left + right), 0.5 * (top + bottom))
    dx, dy = middle[0] - epipole[0], middle[1] - epipole[1]
    distance = np.sqrt(dx * dx + dy * dy)
    if not distance > 2.0 * size:
        return middle, ((1.0, 0.0), (0.0, 1.0)), False
    dx, dy, stretch = dx / distance, dy / distance, distance / size
    return middle, ((dx, dy), (-stretch * dy, stretch * dx)), True


@njit(cache=True, nogil=True)
def _sector(axes, dx, dy):  # type: ignore[no-untyped-def]
    """Where a line of this direction falls in [0, _SECTORS]; grows with its angle, without trigonometry."""
    along, across = axes[0][0] * dx + axes[0][1] * dy, axes[1][0] * dx + axes[1][1] * dy
    if along < 0.0:
        along, across = -along, -across
    total = along + abs(across)
    return 0.5 * _SECTORS * (1.0 + across / total) if total > 0.0 else 0.0


@njit(cache=True, nogil=True)
def _features_in_sectors(pixels, reach, epipole, axes):  # type: ignore[no-untyped-def]
    """Features within reach of any line of a sector: sector s holds members[starts[s]:starts[s + 1]], sorted."""
    first, count = np.empty(len(pixels), np.int64), np.empty(len(pixels), np.int64)
    starts = np.zeros(_SECTORS + 1, np.int64)
    for j in range(len(pixels)):
        dx, dy = pixels[j, 0] - epipole[0], pixels[j, 1] - epipole[1]
        sine = 1.001 * reach[j] / max(np.sqrt(dx * dx + dy * dy), 1e-9)
        first[j], count[j] = 0, _SECTORS
        if sine < 0.7:
            cosine = np.sqrt(1.0 - sine * sine)
            first[j] = int(_sector(axes, cosine * dx + sine * dy, cosine * dy - sine * dx))
            last = int(_sector(axes, cosine * dx - sine * dy, cosine * dy + sine * dx))
            count[j] = (last - first[j]) % _SECTORS + 1
        for n in range(count[j]):
            starts[(first[j] + n) % _SECTORS + 1] += 1
    for s in range(_SECTORS):
        starts[s + 1] += starts[s]
    filled, members = starts[:-1].copy(), np.empty(starts[-1], np.int64)
    for j in range(len(pixels)):
        for n in range(count[j]):
            s = (first[j] + n) % _SECTORS
            members[filled[s]] = j
            filled[s] += 1
    return starts, members
