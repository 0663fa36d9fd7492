"""Compiled loops over who saw what; each costs as much as the keyframes and landmarks it is given, however long
the drive has been.

``marks`` has one entry for every landmark: 0, or one more than its place in a list of landmarks at hand.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, nogil=True)
def count_marked(landmark_of, marks):  # type: ignore[no-untyped-def]
    """Number of features whose landmark is marked."""
    count = 0
    for landmark in landmark_of:
        if landmark >= 0 and marks[landmark] > 0:
            count += 1
    return count


@njit(cache=True, nogil=True)
def marked_features(landmark_of, marks):  # type: ignore[no-untyped-def]
    """Features (n,) int64 whose landmark is marked."""
    features = np.empty(len(landmark_of), np.int64)
    count = 0
    for feature, landmark in enumerate(landmark_of):
        if landmark >= 0 and marks[landmark] > 0:
            features[count] = feature
            count += 1
    return features[:count].copy()


def distinct_living(landmark_of: NDArray[np.int32], alive: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Sorted ids (n,) of the living landmarks among these, each once; -1 is skipped."""
    lowest, is_seen = _seen_and_living(landmark_of, alive)
    ids: NDArray[np.int32] = (np.flatnonzero(is_seen) + lowest).astype(np.int32)
    return ids


@njit(cache=True, nogil=True)
def _seen_and_living(landmark_of, alive):  # type: ignore[no-untyped-def]
    lowest, highest = len(alive), -1
    for landmark in landmark_of:
        if landmark >= 0:
            lowest, highest = min(lowest, landmark), max(highest, landmark)
    is_seen = np.zeros(max(highest - lowest + 1, 0), np.bool_)
    for landmark in landmark_of:
        if landmark >= 0 and alive[landmark]:
            is_seen[landmark - lowest] = True
    return lowest, is_seen


@njit(cache=True, nogil=True)
def add_views(  # type: ignore[no-untyped-def]
    landmark_of, feature_descriptors, feature_octaves, centre, marks, points, sums, descriptors, octaves, distances
):
    """Add one keyframe's unit rays to the sums (n, 3) of the marked landmarks; it is the latest to see them."""
    for feature, landmark in enumerate(landmark_of):
        if landmark < 0 or marks[landmark] == 0:
            continue
        x, y, z = centre[0] - points[landmark, 0], centre[1] - points[landmark, 1], centre[2] - points[landmark, 2]
        length = np.sqrt(x * x + y * y + z * z)
        row = marks[landmark] - 1
        sums[row, 0] += x / length
        sums[row, 1] += y / length
        sums[row, 2] += z / length
        for byte in range(feature_descriptors.shape[1]):
            descriptors[landmark, byte] = feature_descriptors[feature, byte]
        octaves[landmark] = feature_octaves[feature]
        distances[landmark] = length


@njit(cache=True, nogil=True)
def fuse_pairs(lost, kept, merged_into, tallies, oldest, newest):  # type: ignore[no-untyped-def]
    """Fuse landmarks that are themselves until now: pair after pair, and what a pair was fused with before.

    The successor takes over the tallies and the range of keyframes. Returns those that are gone (n,) int32.
    """
    gone = np.empty(len(lost), np.int32)
    count = 0
    for n in range(len(lost)):
        a, b = np.int64(lost[n]), np.int64(kept[n])
        while merged_into[a] != a:
            a = merged_into[a]
        while merged_into[b] != b:
            b = merged_into[b]
        if a == b:
            continue
        merged_into[a] = b
        gone[count] = a
        count += 1
        for tally in tallies:
            tally[b] += tally[a]
        oldest[b], newest[b] = min(oldest[a], oldest[b]), max(newest[a], newest[b])
    for a in gone[:count]:
        successor = merged_into[a]
        while merged_into[successor] != successor:
            successor = merged_into[successor]
        merged_into[a] = successor
    return gone[:count].copy()


@njit(cache=True, nogil=True)
def follow_fusions(landmark_of, marks, successors, observations):  # type: ignore[no-untyped-def]
    """Rename the marked landmarks in one keyframe; where it then holds one twice, the first feature keeps it."""
    is_renamed = False
    for feature, landmark in enumerate(landmark_of):
        if landmark >= 0 and marks[landmark] > 0:
            landmark_of[feature] = successors[marks[landmark] - 1]
            is_renamed = True
    if not is_renamed:
        return
    is_held = np.zeros(len(successors), np.bool_)
    for feature, landmark in enumerate(landmark_of):
        if landmark < 0 or marks[landmark] >= 0:
            continue
        place = -marks[landmark] - 1  # survivors of fusions are marked with negative places
        if is_held[place]:
            landmark_of[feature] = -1
            observations[landmark] -= 1
        is_held[place] = True


def sorted_by_landmark(
    places: NDArray[np.int32], count: int
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int64]]:
    """Observations of landmarks 0 .. count - 1, sorted by landmark, without those of landmarks seen once.

    Returns their order (m,), the landmark of each renumbered (m,), and the landmarks that are left (n,).
    """
    seen = np.bincount(places, minlength=count)
    kept = np.flatnonzero(seen >= 2)
    row = np.full(count, -1, np.int32)
    row[kept] = np.arange(len(kept))
    next_slot = np.zeros(count, np.int64)
    next_slot[kept[1:]] = np.cumsum(seen[kept])[:-1]
    order = _sorted_by_place(places, row, next_slot, int(seen[kept].sum()))
    return order, row[places[order]], kept


@njit(cache=True, nogil=True)
def _sorted_by_place(places, row, next_slot, total):  # type: ignore[no-untyped-def]
    order = np.empty(total, np.int64)
    for observation, place in enumerate(places):
        if row[place] >= 0:
            order[next_slot[place]] = observation
            next_slot[place] += 1
    return order
