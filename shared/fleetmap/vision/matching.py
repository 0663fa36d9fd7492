"""Matching of binary descriptors by Hamming distance: freely, and around predictions.

The loops are compiled; descriptors of 32 bytes are looked at as four 64-bit words.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.vision.features import Features

Array = NDArray[np.float64]
IntArray = NDArray[np.int32]
BoolArray = NDArray[np.bool_]
Descriptors = NDArray[np.uint8]

_NO_PAIR = 1 << 20  # a Hamming distance that no pair has
_CELL_PX = 16.0
_BLOCK = 64  # distances that are looked at together


def match_descriptors(
    descriptors_a: Descriptors,
    descriptors_b: Descriptors,
    max_distance: int,
    ratio: float = 0.8,
    mutual: bool = True,
) -> IntArray:
    """Index pairs (P, 2) int32 of descriptors (N, 32) and (M, 32) that belong together, sorted by a.

    A pair is the closest of b to its a, at most ``max_distance`` bits apart, clearly closer than the second
    (distance <= ratio * second), and with ``mutual`` also the closest of a to its b.
    """
    if len(descriptors_a) == 0 or len(descriptors_b) == 0:
        return np.zeros((0, 2), dtype=np.int32)
    pairs: IntArray = _match_all(as_words(descriptors_a), as_words(descriptors_b), max_distance, ratio, mutual)
    return pairs


def match_by_projection(
    predicted_px: Array,
    radii_px: Array,
    octave_min: NDArray[np.integer],
    octave_max: NDArray[np.integer],
    descriptors: Descriptors,
    features: Features,
    max_distance: int,
    ratio: float,
) -> IntArray:
    """The feature that shows each landmark, (L,) int32, or -1 where none does.

    Args:
        predicted_px: (L, 2) undistorted pixels where the landmarks should be; NaN = not visible.
        radii_px: (L,) how far from there to look.
        octave_min: (L,) lowest pyramid level to accept; octave_max: (L,) the highest.
        descriptors: (L, 32) of the landmarks.
        features: of the image.
        max_distance: Hamming bits.
        ratio: the best candidate must be this much closer than the second best, where both are of
            neighbouring octaves. Source: Mur-Artal & Tardos, "ORB-SLAM", T-RO 2015, section V.

    A feature goes to at most one landmark, the closest in Hamming distance.
    """
    pairs = pairs_in_windows(predicted_px, radii_px, octave_min, octave_max, features)
    distances = _hamming_of_pairs(as_words(descriptors), as_words(features.descriptors), pairs)
    return closest_of_pairs(pairs, distances, len(predicted_px), features, max_distance, ratio)


def pairs_in_windows(
    predicted_px: Array,
    radii_px: Array,
    octave_min: NDArray[np.integer],
    octave_max: NDArray[np.integer],
    features: Features,
) -> IntArray:
    """Rows of landmark and feature (P, 2) that could belong together, sorted by landmark.

    Arguments as in :func:`match_by_projection`, whose first half this is.
    """
    if len(predicted_px) == 0 or len(features) == 0:
        return np.zeros((0, 2), dtype=np.int32)
    pairs: IntArray = _pairs_in_windows(
        np.ascontiguousarray(predicted_px, dtype=np.float64),
        np.ascontiguousarray(radii_px, dtype=np.float64),
        np.ascontiguousarray(octave_min, dtype=np.int32),
        np.ascontiguousarray(octave_max, dtype=np.int32),
        np.ascontiguousarray(features.pixels),
        features.octaves.astype(np.int32),
        *grid(features.pixels, _CELL_PX),
    )
    return pairs


def closest_of_pairs(
    pairs: IntArray,
    distances: NDArray[np.int64],
    landmark_count: int,
    features: Features,
    max_distance: int,
    ratio: float,
) -> IntArray:
    """For each landmark one of its pairs (P, 2), by their distances (P,) in bits: the feature (L,) int32, or -1.

    Arguments as in :func:`match_by_projection`, whose second half this is.
    """
    octaves = features.octaves.astype(np.int32)
    chosen: IntArray = _closest_of_pairs(pairs, distances, landmark_count, octaves, max_distance, ratio)
    return chosen


def medoid_descriptor(descriptors: Descriptors) -> int:
    """Index of the descriptor (K, 32) with the least median Hamming distance to the others."""
    return int(_medoid(as_words(descriptors)))


def bits_apart(first: Descriptors, second: Descriptors) -> NDArray[np.int64]:
    """Hamming distances (N,) of descriptors (N, 32) to those of the same rows of others."""
    return np.asarray(np.bitwise_count(as_words(first) ^ as_words(second)).sum(axis=1, dtype=np.int64))


def as_words(descriptors: Descriptors) -> NDArray[np.uint64]:
    """Descriptors (N, 32) uint8 as (N, 4) uint64, for counting bits."""
    return np.ascontiguousarray(descriptors, dtype=np.uint8).view(np.uint64)


@njit(cache=True, nogil=True, inline="always")
def hamming(a, i, b, j):  # type: ignore[no-untyped-def]
    """Bits that differ between descriptors a[i] and b[j]."""
    total = np.uint64(0)
    for word in range(4):
        total += bit_count(a[i, word] ^ b[j, word])
    return np.int64(total)


@njit(cache=True, nogil=True)
def hamming_to_all(words, columns, distances):  # type: ignore[no-untyped-def]
    """Bits that differ between a descriptor (4,) and each of a list (4, N), which lies word by word."""
    a, b, c, d = words[0], words[1], words[2], words[3]
    first, second, third, fourth = columns[0], columns[1], columns[2], columns[3]
    for n in range(len(distances)):
        near = bit_count(a ^ first[n]) + bit_count(b ^ second[n])
        distances[n] = near + bit_count(c ^ third[n]) + bit_count(d ^ fourth[n])


@njit(cache=True, nogil=True, inline="always")
def bit_count(x):  # type: ignore[no-untyped-def]
    """Bits set in a word; LLVM recognises the trick and makes it one instruction, for several words at once."""
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (x * np.uint64(0x0101010101010101)) >> np.uint64(56)


@njit(cache=True, nogil=True)
def _smallest(values):  # type: ignore[no-untyped-def]
    smallest = values[0]
    for n in range(len(values)):  # over the values themselves LLVM would go one by one
        smallest = min(smallest, values[n])
    return smallest


@njit(cache=True, nogil=True)
def _match_all(words_a, words_b, max_distance, ratio, mutual):  # type: ignore[no-untyped-def]
    """Passes over all of b that LLVM turns into vector instructions, in place of one with branches."""
    count_a, count_b = len(words_a), len(words_b)
    columns, distances = words_b.T.copy(), np.empty(count_b, np.int32)
    best_of_b, a_of_b = np.full(count_b, _NO_PAIR, np.int32), np.full(count_b, -1, np.int32)
    b_of_a = np.full(count_a, -1, np.int32)
    for i in range(count_a):
        hamming_to_all(words_a[i], columns, distances)
        if mutual:
            _take_if_closer(np.int32(i), distances, best_of_b, a_of_b)
        best = _smallest(distances)
        if best > max_distance:
            continue
        chosen = 0
        while distances[chosen] != best:
            chosen += 1
        distances[chosen] = _NO_PAIR
        if best <= ratio * _smallest(distances):
            b_of_a[i] = chosen
    return index_pairs(b_of_a, a_of_b, mutual)


@njit(cache=True, nogil=True)
def _take_if_closer(i, distances, best_of_b, a_of_b):  # type: ignore[no-untyped-def]
    for j in range(len(distances)):
        is_closer = distances[j] < best_of_b[j]
        best_of_b[j] = distances[j] if is_closer else best_of_b[j]
        a_of_b[j] = i if is_closer else a_of_b[j]


@njit(cache=True, nogil=True)
def index_pairs(b_of_a, a_of_b, mutual):  # type: ignore[no-untyped-def]
    """Pairs (P, 2) int32 from the partner of each a and of each b (-1 = none), sorted by a."""
    pairs = np.empty((len(b_of_a), 2), np.int32)
    found = 0
    for i in range(len(b_of_a)):
        j = b_of_a[i]
        if j >= 0 and (not mutual or a_of_b[j] == i):
            pairs[found, 0], pairs[found, 1] = i, j
            found += 1
    return pairs[:found].copy()


@njit(cache=True, nogil=True)
def grid(pixels, cell_px):  # type: ignore[no-untyped-def]
    """Features sorted into square cells: cell c holds members[starts[c]:starts[c + 1]]."""
    origin = np.array([pixels[:, 0].min(), pixels[:, 1].min()])
    across = int((pixels[:, 0].max() - origin[0]) / cell_px) + 1
    down = int((pixels[:, 1].max() - origin[1]) / cell_px) + 1
    cells = np.empty(len(pixels), np.int64)
    starts = np.zeros(across * down + 1, np.int64)
    for i in range(len(pixels)):
        column = int((pixels[i, 0] - origin[0]) / cell_px)
        row = int((pixels[i, 1] - origin[1]) / cell_px)
        cells[i] = row * across + column
        starts[cells[i] + 1] += 1
    for c in range(across * down):
        starts[c + 1] += starts[c]
    filled = starts[:-1].copy()
    members = np.empty(len(pixels), np.int64)
    for i in range(len(pixels)):
        members[filled[cells[i]]] = i
        filled[cells[i]] += 1
    return origin, across, down, starts, members


@njit(cache=True, nogil=True)
def _pairs_in_windows(  # type: ignore[no-untyped-def]
    predicted_px,
    radii_px,
    octave_min,
    octave_max,
    feature_px,
    feature_octaves,
    origin,
    cells_across,
    cells_down,
    starts,
    members,
):
    pairs, count = np.empty((4 * len(predicted_px), 2), np.int32), 0
    for landmark in range(len(predicted_px)):
        u, v, radius = predicted_px[landmark, 0], predicted_px[landmark, 1], radii_px[landmark]
        if not (np.isfinite(u) and np.isfinite(v) and radius > 0.0):
            continue
        left = max(0.0, np.floor((u - radius - origin[0]) / _CELL_PX))
        right = min(cells_across - 1.0, np.floor((u + radius - origin[0]) / _CELL_PX))
        top = max(0.0, np.floor((v - radius - origin[1]) / _CELL_PX))
        bottom = min(cells_down - 1.0, np.floor((v + radius - origin[1]) / _CELL_PX))
        if right < left or bottom < top:
            continue
        for row in range(int(top), int(bottom) + 1):
            first, end = starts[row * cells_across + int(left)], starts[row * cells_across + int(right) + 1]
            if count + end - first > len(pairs):
                pairs = np.concatenate((pairs, np.empty((len(pairs) + end - first, 2), np.int32)))
            for slot in range(first, end):
                feature = members[slot]
                octave = feature_octaves[feature]
                if octave < octave_min[landmark] or octave > octave_max[landmark]:
                    continue
                du, dv = feature_px[feature, 0] - u, feature_px[feature, 1] - v
                if du * du + dv * dv <= radius * radius:
                    pairs[count, 0], pairs[count, 1] = landmark, feature
                    count += 1
    return pairs[:count].copy()


@njit(cache=True, nogil=True)
def _hamming_of_pairs(landmark_words, feature_words, pairs):  # type: ignore[no-untyped-def]
    distances = np.empty(len(pairs), np.int64)
    for n in range(len(pairs)):
        distances[n] = hamming(landmark_words, pairs[n, 0], feature_words, pairs[n, 1])
    return distances


@njit(cache=True, nogil=True)
def _closest_of_pairs(  # type: ignore[no-untyped-def]
    pairs, distances, landmark_count, feature_octaves, max_distance, ratio
):
    chosen = np.full(landmark_count, -1, np.int32)
    taken_at = np.full(len(feature_octaves), _NO_PAIR, np.int64)
    taken_by = np.full(len(feature_octaves), -1, np.int64)
    n = 0
    while n < len(pairs):
        landmark = pairs[n, 0]
        best, second, best_feature, best_octave, second_octave = _NO_PAIR, _NO_PAIR, -1, -1, -10
        while n < len(pairs) and pairs[n, 0] == landmark:
            feature, distance = pairs[n, 1], distances[n]
            if distance < best:
                second, second_octave = best, best_octave
                best, best_octave, best_feature = distance, feature_octaves[feature], feature
            elif distance < second:
                second, second_octave = distance, feature_octaves[feature]
            n += 1
        if best > max_distance or (abs(best_octave - second_octave) <= 1 and best > ratio * second):
            continue
        if best < taken_at[best_feature]:
            if taken_by[best_feature] >= 0:
                chosen[taken_by[best_feature]] = -1
            taken_at[best_feature], taken_by[best_feature] = best, landmark
            chosen[landmark] = best_feature
    return chosen


@njit(cache=True, nogil=True)
def _medoid(words):  # type: ignore[no-untyped-def]
    count = len(words)
    distances = np.zeros((count, count), np.int64)
    for i in range(count):
        for j in range(i):
            distances[i, j] = distances[j, i] = hamming(words, i, words, j)
    best, chosen = 1 << 20, 0
    for i in range(count):
        median = np.sort(distances[i])[count // 2]
        if median < best:
            best, chosen = median, i
    return chosen
