"""Matching: true pairs are found, false ones refused, and no feature is given away twice."""

from __future__ import annotations

import numpy as np

from fleetmap.vision.features import Features
from fleetmap.vision.matching import (
    as_words,
    hamming,
    match_by_projection,
    match_descriptors,
    medoid_descriptor,
)

K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 200.0], [0.0, 0.0, 1.0]])


def random_descriptors(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, 32), dtype=np.uint8)


def flip_bits(descriptors: np.ndarray, bits: int, seed: int = 1) -> np.ndarray:
    """Every row with exactly so many of its bits turned over."""
    rng = np.random.default_rng(seed)
    unpacked = np.unpackbits(descriptors, axis=1)
    for row in unpacked:
        row[rng.choice(256, bits, replace=False)] ^= 1
    return np.packbits(unpacked, axis=1)


def features_at(pixels: np.ndarray, descriptors: np.ndarray, octaves: np.ndarray | None = None) -> Features:
    return Features(
        pixels=np.asarray(pixels, dtype=np.float64),
        octaves=np.zeros(len(pixels), np.uint8) if octaves is None else octaves.astype(np.uint8),
        descriptors=descriptors,
        angles_deg=np.zeros(len(pixels), np.float32),
        scale_factor=1.2,
    )


def test_hamming_distance_counts_the_bits_that_differ() -> None:
    descriptors = random_descriptors(50)
    for others, differing in ((descriptors, 0), (flip_bits(descriptors, 37), 37), (~descriptors, 256)):
        words, other_words = as_words(descriptors), as_words(others)
        assert all(hamming(words, i, other_words, i) == differing for i in range(50))


def test_shuffled_and_disturbed_descriptors_find_their_partners() -> None:
    a = random_descriptors(300)
    order = np.random.default_rng(2).permutation(300)
    pairs = match_descriptors(a, flip_bits(a, 30)[order], max_distance=64)
    assert pairs.dtype == np.int32
    assert np.array_equal(pairs[:, 0], np.arange(300))
    assert np.array_equal(order[pairs[:, 1]], pairs[:, 0])


def test_descriptors_that_differ_by_more_than_allowed_are_not_paired() -> None:
    a = random_descriptors(100)
    b = flip_bits(a, 40)
    assert len(match_descriptors(a, b, max_distance=40)) == 100
    assert len(match_descriptors(a, b, max_distance=39)) == 0


def test_an_ambiguous_descriptor_is_refused_by_the_ratio() -> None:
    a = random_descriptors(1)
    b = np.concatenate([flip_bits(a, 20, seed=3), flip_bits(a, 22, seed=4)])
    assert len(match_descriptors(a, b, 64, ratio=0.8)) == 0
    assert match_descriptors(a, b, 64, ratio=1.0).tolist() == [[0, 0]]


def test_mutual_matching_gives_each_partner_once() -> None:
    b = random_descriptors(1)
    a = np.concatenate([flip_bits(b, 20), flip_bits(b, 5)])
    assert match_descriptors(a, b, 64, mutual=True).tolist() == [[1, 0]]
    assert match_descriptors(a, b, 64, mutual=False).tolist() == [[0, 0], [1, 0]]


def test_matches_are_those_of_an_exhaustive_search_also_where_distances_tie() -> None:
    a = random_descriptors(150, seed=3)
    b = np.concatenate([flip_bits(a[:90], 60), flip_bits(a[:90], 60, seed=4), a[:5], a[:5]])
    distances = np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2)
    b_of_a, a_of_b = distances.argmin(axis=1), distances.argmin(axis=0)
    best, second = np.sort(distances, axis=1)[:, :2].T
    for mutual in (True, False):
        expected = [
            (i, j)
            for i, j in enumerate(b_of_a)
            if best[i] <= 64 and best[i] <= 1.0 * second[i] and (not mutual or a_of_b[j] == i)
        ]
        assert len(expected) == 90
        assert match_descriptors(a, b, 64, ratio=1.0, mutual=mutual).tolist() == [list(pair) for pair in expected]


def test_nothing_matches_nothing() -> None:
    none, some = random_descriptors(0), random_descriptors(4)
    assert match_descriptors(none, some, 64).shape == (0, 2)
    assert match_descriptors(some, none, 64).shape == (0, 2)
    empty = features_at(np.zeros((0, 2)), none)
    found = match_by_projection(
        np.ones((4, 2)), np.ones(4), np.zeros(4, int), np.full(4, 7), some, empty, max_distance=64, ratio=0.8
    )
    assert found.tolist() == [-1] * 4


def test_projection_finds_each_landmark_near_its_prediction() -> None:
    rng = np.random.default_rng(5)
    pixels = rng.uniform((0, 0), (640, 400), (500, 2))
    descriptors = random_descriptors(500)
    octaves = rng.integers(0, 8, 500)
    features = features_at(pixels, flip_bits(descriptors, 25), octaves)
    predicted = pixels + rng.uniform(-5, 5, pixels.shape)
    predicted[:20] = np.nan
    predicted[20:40] += 40.0
    found = match_by_projection(
        predicted, np.full(500, 8.0), octaves - 1, octaves + 1, descriptors, features, max_distance=50, ratio=0.8
    )
    assert np.array_equal(found[40:], np.arange(40, 500))
    assert np.all(found[:40] == -1)


def test_projection_refuses_other_octaves() -> None:
    descriptors = random_descriptors(1)
    features = features_at(np.array([[10.0, 10.0]]), descriptors, np.array([5]))
    here = np.array([[10.0, 10.0]])
    common = {"descriptors": descriptors, "features": features, "max_distance": 50, "ratio": 0.8}
    radius = np.array([5.0])
    assert match_by_projection(here, radius, np.array([2]), np.array([4]), **common).tolist() == [-1]
    assert match_by_projection(here, radius, np.array([4]), np.array([6]), **common).tolist() == [0]


def test_projection_gives_a_feature_to_the_closest_landmark_only() -> None:
    feature = random_descriptors(1)
    landmarks = np.concatenate([flip_bits(feature, 20), flip_bits(feature, 10), flip_bits(feature, 30)])
    found = match_by_projection(
        np.full((3, 2), 50.0),
        np.full(3, 5.0),
        np.zeros(3, int),
        np.full(3, 7),
        landmarks,
        features_at(np.array([[51.0, 50.0]]), feature),
        max_distance=50,
        ratio=0.8,
    )
    assert found.tolist() == [-1, 0, -1]


def test_projection_applies_the_ratio_between_neighbouring_octaves_only() -> None:
    landmark = random_descriptors(1)
    candidates = np.concatenate([flip_bits(landmark, 20, seed=3), flip_bits(landmark, 22, seed=4)])
    pixels = np.array([[10.0, 10.0], [12.0, 10.0]])
    window = (np.array([[11.0, 10.0]]), np.array([5.0]), np.array([0]), np.array([7]), landmark)
    neighbours = features_at(pixels, candidates, np.array([2, 3]))
    apart = features_at(pixels, candidates, np.array([2, 5]))
    assert match_by_projection(*window, neighbours, max_distance=50, ratio=0.8).tolist() == [-1]
    assert match_by_projection(*window, apart, max_distance=50, ratio=0.8).tolist() == [0]


def test_the_medoid_is_the_descriptor_in_the_middle() -> None:
    middle = random_descriptors(1)
    around = np.concatenate([flip_bits(middle, 30, seed=seed) for seed in range(6)])
    track = np.concatenate([around[:3], middle, around[3:]])
    assert medoid_descriptor(track) == 3
    assert medoid_descriptor(middle) == 0
