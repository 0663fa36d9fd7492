"""Matching along epipolar lines finds what an exhaustive search finds, wherever the epipole is."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.geometry import so3_exp
from fleetmap.vision.epipolar_matching import match_epipolar
from fleetmap.vision.features import Features

K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 200.0], [0.0, 0.0, 1.0]])
ANYWHERE = np.full(2, np.nan)


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


def two_views(count: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pixels of common points in two cameras, F with x_b^T F x_a = 0, and a's centre seen in b."""
    rng = np.random.default_rng(7)
    points = rng.uniform((-6, -3, 6), (6, 3, 25), (count, 3))
    angle = 0.05
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    t = np.array([0.2, 0.05, -1.5])
    fundamental = np.linalg.inv(K).T @ cross_matrix(t) @ rotation @ np.linalg.inv(K)
    in_b = points @ rotation.T + t
    pixels_a, pixels_b = (points @ K.T)[:, :2] / points[:, 2:], (in_b @ K.T)[:, :2] / in_b[:, 2:]
    epipole = (K @ t)[:2] / t[2]
    return pixels_a, pixels_b, fundamental, epipole


def test_epipolar_matching_finds_true_pairs_among_look_alikes() -> None:
    pixels_a, pixels_b, fundamental, epipole = two_views()
    descriptors = random_descriptors(400)
    descriptors[200:] = flip_bits(descriptors[:200], 12)  # everything has a look-alike elsewhere in the image
    noise = np.random.default_rng(1).normal(0.0, 0.3, pixels_b.shape)
    a, b = features_at(pixels_a, descriptors), features_at(pixels_b + noise, flip_bits(descriptors, 10, seed=9))
    pairs = match_epipolar(a, b, np.ones(400, bool), np.ones(400, bool), fundamental, epipole, 60)
    true = pairs[:, 0] == pairs[:, 1]
    far_from_epipole = np.linalg.norm(b.pixels - epipole, axis=1) > 10.0
    assert len(pairs) > 0.97 * far_from_epipole.sum()
    assert true.mean() > 0.97
    assert len(np.unique(pairs[:, 1])) == len(pairs)


def test_epipolar_matching_respects_the_line_the_epipole_and_the_flags() -> None:
    pixels_a, pixels_b, fundamental, epipole = two_views()
    descriptors = random_descriptors(400)
    a = features_at(pixels_a, descriptors)
    every = np.ones(400, bool)

    lines = np.c_[pixels_a, np.ones(400)] @ fundamental.T
    normals = lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    for off_px, expected in ((1.9, 400), (2.1, 0)):
        b = features_at(pixels_b + off_px * normals, descriptors)
        assert len(match_epipolar(a, b, every, every, fundamental, ANYWHERE, 0)) == expected
    coarse = features_at(pixels_b + 2.1 * normals, descriptors, np.full(400, 1))
    assert len(match_epipolar(a, coarse, every, every, fundamental, ANYWHERE, 0)) == 400

    b = features_at(pixels_b, descriptors)
    near = np.linalg.norm(pixels_b - epipole, axis=1) < 10.0
    assert 0 < near.sum() < 20
    pairs = match_epipolar(a, b, every, every, fundamental, epipole, 0)
    assert not np.any(near[pairs[:, 1]])
    assert len(pairs) == 400 - near.sum()

    use_a, use_b = np.arange(400) % 2 == 0, np.arange(400) % 3 == 0
    pairs = match_epipolar(a, b, use_a, use_b, fundamental, ANYWHERE, 0)
    assert np.array_equal(pairs[:, 0], np.flatnonzero(use_a & use_b))


def cross_matrix(t: np.ndarray) -> np.ndarray:
    return np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])


@pytest.mark.parametrize(
    "b_from_a",
    [(0, 0, 1), (0, 0, -1), (1, 0, 0), (1, 0, 1e-9), (1, 0.2, 0.1), (0, 1, 0), (0.9, 0.4, 1), (-2, 3, 1)],
    ids=str,
)
def test_epipolar_matching_agrees_with_an_exhaustive_search(b_from_a: tuple[float, float, float]) -> None:
    """Epipoles in the image, beside it, far off and at infinity; many features look exactly alike."""
    rng = np.random.default_rng(3)
    kinds = random_descriptors(5)
    a, b = (
        features_at(
            rng.uniform((-20, -20), (660, 420), (300, 2)), kinds[rng.integers(0, 5, 300)], rng.integers(0, 8, 300)
        )
        for _ in range(2)
    )
    use_a, use_b = rng.random(300) < 0.8, rng.random(300) < 0.8
    t = np.array(b_from_a, dtype=np.float64)
    fundamental = np.linalg.inv(K).T @ cross_matrix(t) @ so3_exp(rng.normal(0.0, 0.05, 3)) @ np.linalg.inv(K)
    pairs = match_epipolar(a, b, use_a, use_b, fundamental, ANYWHERE, 60)
    expected = exhaustive_search(a, b, use_a, use_b, fundamental, 60)
    assert len(expected) > 10
    assert pairs.tolist() == expected


def exhaustive_search(
    a: Features, b: Features, use_a: np.ndarray, use_b: np.ndarray, fundamental: np.ndarray, max_distance: int
) -> list[list[int]]:
    lines = np.c_[a.pixels, np.ones(len(a))] @ fundamental.T
    lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    off_px = np.abs(lines @ np.c_[b.pixels, np.ones(len(b))].T)
    bits = np.bitwise_count(a.descriptors[:, None] ^ b.descriptors[None]).sum(axis=2).astype(int)
    bits[(off_px > 1.96 * b.sigmas_px) | ~use_a[:, None] | ~use_b[None]] = 999
    best_b, best_a = bits.argmin(axis=1), bits.argmin(axis=0)
    return [[i, j] for i, j in enumerate(best_b.tolist()) if bits[i, j] <= max_distance and best_a[j] == i]


def test_nothing_matches_nothing() -> None:
    empty, full = (
        features_at(np.zeros((0, 2)), random_descriptors(0)),
        features_at(np.ones((4, 2)), random_descriptors(4)),
    )
    flags = np.ones(4, bool)
    assert match_epipolar(empty, full, flags[:0], flags, np.eye(3), ANYWHERE, 64).shape == (0, 2)
    assert match_epipolar(full, empty, flags, flags[:0], np.eye(3), ANYWHERE, 64).shape == (0, 2)
    assert match_epipolar(full, full, flags, ~flags, np.eye(3), ANYWHERE, 64).shape == (0, 2)
    assert match_epipolar(full, full, flags, flags, np.zeros((3, 3)), ANYWHERE, 64).shape == (0, 2)
