"""Which keyframes show the same place as an image? Answered from the landmarks' descriptors alone.

It is the image that gets an index, not the map: its few thousand features are sorted by the pieces of their
descriptors, and all landmarks run past. So there is no vocabulary that could be missing or foreign to a place,
nothing to build when a map is loaded, nothing to keep in memory, and maps come and go as they like; what a
landmark is compared with does not depend on the map it is of, which makes the scores of all maps comparable.
Chosen by measurement on 27,000 landmarks of a real drive, one thread: a vocabulary trained on the map took 370 ms
to build and 9.5 ms to ask; faiss 1.15 860 and 7 ms (IndexBinaryIVF) or 39 and 155 ms (IndexBinaryMultiHash, the
same idea as here); this 0.3 and 5 ms. The pieces lie as ORB's pattern has them: its bits are sorted so that those
which follow one another are hardly correlated, and pieces drawn at random had a third more in common by chance.

A keyframe's votes are held against those it would have got by chance. Where a hundred were to be expected, ten
more mean nothing; so neither the maps with many landmarks win, nor the keyframes that saw many.

Sources: M. Norouzi, A. Punjani, D. Fleet, "Fast exact search in Hamming space with multi-index hashing", TPAMI
2014 (pieces of the descriptor as keys); J. Sivic, A. Zisserman, "Video Google", ICCV 2003 (rare features say
more); H. Jegou, M. Douze, C. Schmid, "Hamming embedding and weak geometric consistency", ECCV 2008 (votes by
distance).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.vision.matching import as_words, hamming

Array = NDArray[np.float64]

_PIECES = 16  # of a descriptor, of 16 bits each
_FARTHEST = 255


@dataclass(frozen=True)
class PlaceIndexSettings:
    """What counts as alike, and how far a place reaches."""

    key_bits: int = 14  # of a piece, that must agree; fewer find more and compare more
    max_distance: int = 56  # Hamming bits between a feature and the landmark it votes for
    neighbours: int = 2  # keyframes on either side, in the order of the drive, that vote with one


class PlaceIndex:
    """The landmarks of a map and who saw them, ready to be asked for places. It holds no copies of them."""

    def __init__(
        self,
        descriptors: NDArray[np.uint8],
        seen_by_keyframe: NDArray[np.int32],
        seen_landmark: NDArray[np.int32],
        keyframe_count: int,
    ) -> None:
        """From landmarks' descriptors (N, 32) and visibility pairs (M,), see LocalizationMap."""
        self._words = as_words(descriptors)
        self._seen_by_keyframe, self._seen_landmark = seen_by_keyframe, seen_landmark
        self._seen_counts = np.bincount(seen_by_keyframe, minlength=keyframe_count).astype(np.float64)

    def __len__(self) -> int:
        return len(self._words)

    def scores(self, descriptors: NDArray[np.uint8]) -> Array:
        """How well each keyframe (K,) fits the features' descriptors (F, 32) of an image; see PlaceSearch."""
        return PlaceSearch([self], descriptors).scores[0]

    def votes_of(self, features: _HashedFeatures, max_distance: int) -> Votes:
        """For each landmark the feature that is most like it, as far as one agrees with it in a piece."""
        found, distances = _nearest_features(
            self._words,
            _pieces(self._words),
            features.words,
            features.starts,
            features.members,
            features.mask,
            max_distance,
        )
        return Votes(found, np.maximum(1.0 - distances / (max_distance + 1.0), 0.0))

    def sums(self, landmark_votes: Array, reach: int) -> tuple[Array, Array]:
        """What the landmarks (N,) of each keyframe (K,) and its neighbours give, and how many these are."""
        votes = np.bincount(
            self._seen_by_keyframe, landmark_votes[self._seen_landmark], minlength=len(self._seen_counts)
        )
        return _pooled(votes.astype(np.float64), reach), _pooled(self._seen_counts, reach)


@dataclass(frozen=True)
class Votes:
    """What an image's features say of a map's landmarks."""

    features: NDArray[np.int32]  # (N,) the feature most like each landmark; -1 where none is
    weights: Array  # (N,) 0 to 1, the more the more alike


class PlaceSearch:
    """One image's search for its place among maps: ``scores``, which change as landmarks are explained.

    A score says by how many standard deviations a keyframe's votes exceed those of chance; 0 = not at all. Scores
    of different maps compare.
    """

    def __init__(
        self,
        maps: Sequence[PlaceIndex],
        descriptors: NDArray[np.uint8],
        settings: PlaceIndexSettings | None = None,
    ) -> None:
        """Ask all maps for the features' descriptors (F, 32) of an image."""
        self._maps, self._settings = maps, settings or PlaceIndexSettings()
        features = _HashedFeatures(descriptors, self._settings.key_bits)
        self._votes = _rarer_first(
            [each.votes_of(features, self._settings.max_distance) for each in maps], len(features)
        )
        count = max(sum(map(len, self._votes)), 1)
        self._mean = sum(float(each.sum()) for each in self._votes) / count
        self._square = sum(float(each @ each) for each in self._votes) / count
        self.scores = [self._scores_of(number) for number in range(len(maps))]  # (K,) of each map

    def explain(self, number: int, landmarks: NDArray[np.integer]) -> None:
        """Take away the votes of a map's landmarks: what is left speaks for other places."""
        self._votes[number][landmarks] = 0.0
        self.scores[number] = np.minimum(self.scores[number], self._scores_of(number))

    def dismiss(self, number: int, keyframes: NDArray[np.integer]) -> None:
        """These keyframes of a map have been looked at."""
        self.scores[number][keyframes] = 0.0

    def _scores_of(self, number: int) -> Array:
        got, seen = self._maps[number].sums(self._votes[number], self._settings.neighbours)
        noise = np.sqrt(self._square * (seen + 1.0))
        return np.asarray(np.maximum(got - self._mean * seen, 0.0) / np.maximum(noise, 1e-12))


class _HashedFeatures:
    """The features of one image, to be found by any piece of their descriptors."""

    def __init__(self, descriptors: NDArray[np.uint8], key_bits: int) -> None:
        """Sort descriptors (F, 32); of more than 65,535 the first."""
        self.words = as_words(descriptors[: 2**16 - 1])
        self.mask = np.uint16((1 << key_bits) - 1)
        self.starts, self.members = _sorted_by_pieces(_pieces(self.words), self.mask)

    def __len__(self) -> int:
        return len(self.words)


def _rarer_first(votes: Sequence[Votes], feature_count: int) -> list[Array]:
    """The weights (N,) of each map's votes, less for a feature that many landmarks are like."""
    counts = np.zeros(feature_count + 1)
    for each in votes:
        counts += np.bincount(each.features + 1, minlength=len(counts))
    rarity = 1.0 / np.sqrt(np.maximum(counts, 1.0))
    return [np.asarray(rarity[each.features + 1] * each.weights) for each in votes]


def _pooled(votes: Array, reach: int) -> Array:
    """Sums (K,) over neighbours in the order of the drive, the nearer counting more: a place, not an image."""
    kernel = reach + 1.0 - np.abs(np.arange(-reach, reach + 1))
    return np.convolve(votes, kernel / kernel[reach])[reach : reach + len(votes)] if len(votes) else votes


def _pieces(words: NDArray[np.uint64]) -> NDArray[np.uint16]:
    return words.view(np.uint16)  # (N, 16)


@njit(cache=True, nogil=True)
def _sorted_by_pieces(pieces, mask):  # type: ignore[no-untyped-def]
    """For each piece: the features with key k are members[starts[k]:starts[k + 1]]."""
    count, keys = len(pieces), np.int64(mask) + 1
    starts = np.zeros((_PIECES, keys + 1), np.uint16)
    members = np.empty((_PIECES, count), np.uint16)
    filled = np.empty(keys, np.uint16)
    for piece in range(_PIECES):
        for i in range(count):
            starts[piece, np.int64(pieces[i, piece] & mask) + 1] += 1
        for key in range(keys):
            starts[piece, key + 1] += starts[piece, key]
            filled[key] = starts[piece, key]
        for i in range(count):
            key = pieces[i, piece] & mask
            members[piece, filled[key]] = i
            filled[key] += 1
    return starts, members


@njit(cache=True, nogil=True)
def _nearest_features(words, pieces, feature_words, starts, members, mask, max_distance):  # type: ignore[no-untyped-def]
    nearest = np.full(len(words), -1, np.int32)
    distances = np.full(len(words), _FARTHEST, np.uint8)
    for i in range(len(words)):
        best, chosen = max_distance + 1, -1
        for piece in range(_PIECES):
            key = pieces[i, piece] & mask
            for slot in range(starts[piece, key], starts[piece, np.int64(key) + 1]):
                feature = members[piece, slot]
                distance = hamming(words, i, feature_words, feature)
                if distance < best:
                    best, chosen = distance, feature
        if chosen >= 0:
            nearest[i], distances[i] = chosen, best
    return nearest, distances
