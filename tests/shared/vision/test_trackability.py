"""What can be tracked in images of a plane whose motion is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.vision.trackability import Trackability, measure_trackability

CAMERA = Camera(320, 240, 250.0, 250.0, 159.5, 119.5)


@pytest.fixture(scope="module")
def texture():
    """Blobs of a few pixels, 240x1000."""
    noise = np.random.default_rng(0).integers(0, 256, (240, 1000)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def views(texture, count, step_px):
    return [np.ascontiguousarray(texture[:, k * step_px : k * step_px + 320]) for k in range(count)]


def test_the_same_image_again_and_again_is_tracked_to_the_end(texture):
    found = measure_trackability(views(texture, 5, 0), CAMERA)
    assert found.image_count == 5
    assert 0.9 < found.match_ratio <= 1.0
    assert 4.5 < found.track_length <= 5.0


def test_faster_motion_leaves_shorter_tracks(texture):
    slow, fast = (measure_trackability(views(texture, 7, step_px), CAMERA) for step_px in (10, 80))
    assert slow.match_ratio > 1.1 * fast.match_ratio
    assert 2.0 <= fast.track_length < 4.1  # a feature crosses 320 px in four images
    assert slow.track_length > 1.3 * fast.track_length


def test_images_of_different_places_have_nothing_in_common():
    rng = np.random.default_rng(1)
    images = [cv2.GaussianBlur(rng.integers(0, 256, (240, 320)).astype(np.uint8), (0, 0), 1.0) for _ in range(4)]
    assert 0.0 <= measure_trackability(images, CAMERA).match_ratio < 0.02


def test_more_texture_is_more_features(texture):
    plain = [np.full((240, 320), 128, np.uint8)] * 2
    half = [np.where(np.arange(320) < 160, view, 128).astype(np.uint8) for view in views(texture, 2, 0)]
    counts = [
        measure_trackability(images, CAMERA).features_per_megapixel
        for images in (plain, half, views(texture, 2, 0))
    ]
    assert counts[0] == 0.0
    assert 0.35 < counts[1] / counts[2] < 0.65


def test_factors_are_the_same_in_both_directions():
    a, b = Trackability(10, 20_000.0, 0.3, 3.0), Trackability(10, 40_000.0, 0.1, 3.0)
    assert a.factor_to(b) == b.factor_to(a)
    assert a.factor_to(b) == pytest.approx({"features": 2.0, "match ratio": 3.0, "track length": 1.0})


def test_one_image_cannot_be_measured(texture):
    with pytest.raises(ValueError, match="fewer than two"):
        measure_trackability(views(texture, 1, 0), CAMERA)
