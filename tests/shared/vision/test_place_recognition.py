"""Place recognition: the right keyframe wins, and nothing wins by nothing."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.vision.place_recognition import PlaceIndex, PlaceSearch

KEYFRAMES, NEW_PER_KEYFRAME, VIEWS = 40, 60, 3


class Road:
    """Every keyframe brings 60 landmarks, which the two keyframes after it see as well."""

    def __init__(self, seed: int = 0, landmarks_kept: float = 1.0) -> None:
        rng = np.random.default_rng(seed)
        # Clustered, as real descriptors are: around 30 prototypes, 50 bits away in the mean.
        prototypes = rng.integers(0, 2, (30, 256), dtype=np.uint8)
        bits = prototypes[rng.integers(0, 30, KEYFRAMES * NEW_PER_KEYFRAME)]
        bits ^= (rng.random(bits.shape) < 0.2).astype(np.uint8)
        self.descriptors = np.packbits(bits, axis=1)
        pairs = [
            (k, landmark)
            for k in range(KEYFRAMES)
            for landmark in range(max(0, k - VIEWS + 1) * NEW_PER_KEYFRAME, (k + 1) * NEW_PER_KEYFRAME)
        ]
        self.seen_by_keyframe, self.seen_landmark = np.array(pairs, dtype=np.int32).T.copy()
        kept = rng.random(len(bits)) < landmarks_kept
        seen = kept[self.seen_landmark]
        self.descriptors = self.descriptors[kept]
        self.seen_by_keyframe = self.seen_by_keyframe[seen]
        self.seen_landmark = (np.cumsum(kept) - 1)[self.seen_landmark[seen]].astype(np.int32)

    def index(self) -> PlaceIndex:
        return PlaceIndex(self.descriptors, self.seen_by_keyframe, self.seen_landmark, KEYFRAMES)

    def query(self, keyframe: int, seed: int = 1) -> np.ndarray:
        """Half of what a keyframe saw, 12 % of the bits turned over, among as many features of nothing."""
        rng = np.random.default_rng(seed)
        seen = self.seen_landmark[self.seen_by_keyframe == keyframe]
        bits = np.unpackbits(self.descriptors[rng.permutation(seen)[: len(seen) // 2]], axis=1)
        bits ^= (rng.random(bits.shape) < 0.12).astype(np.uint8)
        clutter = rng.integers(0, 256, (len(bits), 32), dtype=np.uint8)
        return np.concatenate([np.packbits(bits, axis=1), clutter])


@pytest.fixture(scope="module")
def road() -> Road:
    return Road()


def test_the_keyframe_that_saw_the_place_wins(road: Road) -> None:
    index = road.index()
    for keyframe in range(KEYFRAMES):
        scores = index.scores(road.query(keyframe))
        assert abs(int(np.argmax(scores)) - keyframe) <= 1  # its neighbours saw two thirds of the same
        far = np.abs(np.arange(KEYFRAMES) - keyframe) > VIEWS
        assert scores[far].max() < 0.5 * scores[keyframe]


def test_an_image_of_nowhere_scores_low_everywhere(road: Road) -> None:
    index = road.index()
    nowhere = np.random.default_rng(5).integers(0, 256, (180, 32), dtype=np.uint8)
    assert index.scores(nowhere).max() < 0.1 * index.scores(road.query(20)).max()


def test_no_features_score_nothing(road: Road) -> None:
    assert np.array_equal(road.index().scores(np.zeros((0, 32), np.uint8)), np.zeros(KEYFRAMES))


def test_the_same_map_gives_the_same_index(road: Road) -> None:
    query = road.query(11)
    assert np.array_equal(road.index().scores(query), road.index().scores(query))


def test_a_map_without_landmarks_is_no_place() -> None:
    nobody = np.zeros(0, np.int32)
    index = PlaceIndex(np.zeros((0, 32), np.uint8), nobody, nobody, 0)
    assert index.scores(np.ones((5, 32), np.uint8)).shape == (0,)


def test_a_map_of_three_landmarks_is_found(road: Road) -> None:
    few = road.descriptors[:3]
    index = PlaceIndex(few, np.array([0, 1, 1], np.int32), np.array([0, 1, 2], np.int32), 2)
    assert np.argmax(index.scores(few[1:])) == 1
    assert np.argmax(index.scores(few[:1])) == 0


def test_a_sparse_map_of_the_place_outdoes_a_dense_map_of_elsewhere() -> None:
    here, elsewhere = Road(seed=1, landmarks_kept=0.2), Road(seed=2)
    index = [elsewhere.index(), here.index()]
    for keyframe in range(2, KEYFRAMES - 2, 6):
        scores = PlaceSearch(index, here.query(keyframe)).scores
        assert abs(int(np.argmax(scores[1])) - keyframe) <= 2
        assert scores[1].max() > 2.0 * scores[0].max()


def test_landmarks_that_are_explained_no_longer_speak_for_a_place(road: Road) -> None:
    search = PlaceSearch([road.index()], road.query(20))
    before = search.scores[0].copy()
    search.explain(0, np.unique(road.seen_landmark[road.seen_by_keyframe == 20]))
    assert before[20] > 5.0
    assert search.scores[0][20] == 0.0
    assert search.scores[0].max() < 0.2 * before.max()


def test_a_keyframe_that_was_looked_at_stays_so(road: Road) -> None:
    search = PlaceSearch([road.index()], road.query(20))
    search.dismiss(0, np.array([20]))
    search.explain(0, np.array([], dtype=np.int64))
    assert search.scores[0][20] == 0.0
    assert search.scores[0][19] > 0.0


def test_what_is_alike_in_two_maps_scores_the_same_in_both(road: Road) -> None:
    first, second = PlaceSearch([road.index(), road.index()], road.query(7)).scores
    assert np.array_equal(first, second)
    assert np.argmax(first) in (6, 7, 8)
