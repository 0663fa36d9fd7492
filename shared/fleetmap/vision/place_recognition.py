"""Which keyframes show the same place as an image? Answered from the landmarks' descriptors alone.

A small vocabulary of binary words is trained on the map's own descriptors when the map is loaded, so no
vocabulary travels and none can be missing. Each feature of the query looks for its landmark among those of its
nearest words and votes for every keyframe that saw it.

Sources: J. Sivic, A. Zisserman, "Video Google", ICCV 2003 (inverted file); C. Grana et al., "A fast approach for
integrating ORB descriptors in the bag of words model", SPIE 2013 (k-majority); H. Jegou, M. Douze, C. Schmid,
"Hamming embedding and weak geometric consistency", ECCV 2008 (votes gated by Hamming distance within a word).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.vision.matching import as_words, hamming, nearest_words

Array = NDArray[np.float64]
Words = NDArray[np.uint64]


@dataclass(frozen=True)
class PlaceIndexSettings:
    """Size of the vocabulary and reach of a vote."""

    landmarks_per_word: int = 10
    max_words: int = 1024
    training_landmarks: int = 20_000
    training_rounds: int = 6
    words_per_feature: int = 3
    max_distance: int = 56  # Hamming bits between a feature and the landmark it votes for
    seed: int = 0


class PlaceIndex:
    """An inverted file over a map's landmarks. The same map always gives the same index."""

    def __init__(
        self,
        descriptors: NDArray[np.uint8],
        seen_by_keyframe: NDArray[np.int32],
        seen_landmark: NDArray[np.int32],
        keyframe_count: int,
        settings: PlaceIndexSettings | None = None,
    ) -> None:
        """Train and fill it from landmarks' descriptors (N, 32) and visibility pairs (M,), see LocalizationMap."""
        self._settings = settings or PlaceIndexSettings()
        self._landmarks = as_words(descriptors)
        self._seen_by_keyframe, self._seen_landmark = seen_by_keyframe, seen_landmark
        self._keyframe_count = keyframe_count
        seen_count = np.bincount(seen_by_keyframe, minlength=keyframe_count)
        # A keyframe with few landmarks should not win by a handful of chance votes.
        self._weights = 1.0 / np.sqrt(seen_count + max(1.0, seen_count.mean() if keyframe_count else 0.0))
        self._vocabulary = _train(self._landmarks, self._settings)
        word_of_landmark = nearest_words(self._landmarks, self._vocabulary, 1)[:, 0]
        self._members = np.argsort(word_of_landmark, kind="stable")
        self._starts = np.searchsorted(word_of_landmark[self._members], np.arange(len(self._vocabulary) + 1))

    def scores(self, descriptors: NDArray[np.uint8]) -> Array:
        """How well each keyframe (K,) fits the features' descriptors (F, 32) of an image; 0 = not at all."""
        if len(descriptors) == 0 or len(self._landmarks) == 0:
            return np.zeros(self._keyframe_count)
        features = as_words(descriptors)
        words = nearest_words(features, self._vocabulary, self._settings.words_per_feature)
        landmark_votes = _votes(
            features, words, self._starts, self._members, self._landmarks, self._settings.max_distance
        )
        votes = np.bincount(
            self._seen_by_keyframe, weights=landmark_votes[self._seen_landmark], minlength=self._keyframe_count
        )
        return np.asarray(votes * self._weights)


def _train(landmarks: Words, settings: PlaceIndexSettings) -> Words:
    """k-majority: every word becomes the bitwise majority of the descriptors nearest to it, (W, 4)."""
    rng = np.random.default_rng(settings.seed)
    sample = landmarks[rng.permutation(len(landmarks))[: settings.training_landmarks]]
    count = min(settings.max_words, max(1, len(landmarks) // settings.landmarks_per_word))
    vocabulary = sample[:count].copy()
    bits = np.unpackbits(sample.view(np.uint8), axis=1).astype(np.float32)
    for _ in range(settings.training_rounds):
        nearest = nearest_words(sample, vocabulary, 1)[:, 0]
        order = np.argsort(nearest, kind="stable")
        present, starts = np.unique(nearest[order], return_index=True)
        ones = np.add.reduceat(bits[order], starts, axis=0)
        members = np.bincount(nearest, minlength=count)[present]
        majority = np.packbits(ones * 2.0 > members[:, None], axis=1)
        vocabulary[present] = as_words(majority)
    return vocabulary


@njit(cache=True, nogil=True)
def _votes(features, words, starts, members, landmarks, max_distance):  # type: ignore[no-untyped-def]
    """Votes (N,) for the landmarks: each feature gives one to its closest, the more the closer it is."""
    votes = np.zeros(len(landmarks))
    for i in range(len(features)):
        best, chosen = max_distance, -1
        for word in words[i]:
            for slot in range(starts[word], starts[word + 1]):
                distance = hamming(features, i, landmarks, members[slot])
                if distance < best:
                    best, chosen = distance, members[slot]
        if chosen >= 0:
            votes[chosen] += 1.0 - best / max_distance
    return votes
