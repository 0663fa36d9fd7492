"""FAST corners: where OpenCV finds them, and chosen evenly."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from fleetmap.vision.corners import Corners, corner_scores, corners_of, spread_evenly


def noisy_blocks(seed: int, width: int = 321, height: int = 203) -> np.ndarray:
    rng = np.random.default_rng(seed)
    blocks = rng.integers(0, 256, (height // 9 + 1, width // 9 + 1)).astype(np.uint8)
    image = np.kron(blocks, np.ones((9, 9), np.uint8))[:height, :width]
    return np.clip(cv2.blur(image, (2, 2)) + rng.normal(0.0, 6.0, image.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("threshold", [3, 7, 40])
def test_corners_and_scores_are_those_of_opencv(threshold: int) -> None:
    image = noisy_blocks(seed=threshold)
    corners = corners_of(corner_scores(image), threshold, border_px=4)
    found = {
        (x, y): score - 1 for (x, y), score in zip(corners.pixels.tolist(), corners.scores.tolist(), strict=True)
    }
    expected = {
        (int(k.pt[0]), int(k.pt[1])): int(k.response)
        for k in cv2.FastFeatureDetector.create(threshold).detect(image)
        if 4 <= k.pt[0] < image.shape[1] - 4 and 4 <= k.pt[1] < image.shape[0] - 4
    }
    assert len(expected) > 200
    assert found == expected


@pytest.mark.parametrize(("ground", "point"), [(0, 255), (255, 0)])
def test_a_lone_point_scores_its_full_contrast(ground: int, point: int) -> None:
    image = np.full((40, 50), ground, np.uint8)
    image[20, 30] = point
    corners = corners_of(corner_scores(image), 7, border_px=4)
    assert corners.pixels.tolist() == [[30, 20]]
    assert corners.scores.tolist() == [255]


@pytest.mark.parametrize("shape", [(1, 1), (6, 40), (40, 6), (7, 7), (12, 60)])
def test_images_too_small_for_a_corner_have_none(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    assert len(corners_of(corner_scores(image), 7, border_px=19)) == 0


def test_every_cell_gives_its_best_before_any_gives_its_second() -> None:
    pixels = np.array([[1, 1], [3, 1], [5, 1], [21, 1], [23, 1], [41, 1]], np.int32)
    scores = np.array([200, 190, 180, 30, 20, 10], np.uint8)
    corners = Corners(pixels, scores)
    assert spread_evenly(corners, 3, cell_px=20.0).tolist() == [0, 3, 5]
    assert spread_evenly(corners, 4, cell_px=20.0).tolist() == [0, 1, 3, 5]
    assert spread_evenly(corners, 5, cell_px=20.0).tolist() == [0, 1, 3, 4, 5]
    assert spread_evenly(corners, 99, cell_px=20.0).tolist() == [0, 1, 2, 3, 4, 5]
    assert spread_evenly(corners, 0, cell_px=20.0).tolist() == []


def test_of_equally_strong_corners_the_earlier_is_taken() -> None:
    corners = Corners(np.array([[9, 9], [8, 10], [9, 11]], np.int32), np.array([50, 50, 50], np.uint8))
    assert spread_evenly(corners, 1, cell_px=100.0).tolist() == [0]
    assert spread_evenly(corners, 2, cell_px=100.0).tolist() == [0, 1]
