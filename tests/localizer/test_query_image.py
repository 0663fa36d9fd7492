"""Looking into an image once more finds there what the features were described by."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.errors import CalibrationError
from fleetmap.vision.features import FeatureExtractor, FeatureSettings
from fleetmap_localizer.query_image import QueryImage

CAMERA = Camera(320, 200, 250.0, 250.0, 159.5, 99.5, (-0.2, 0.05, 0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def image() -> QueryImage:
    blocks = np.random.default_rng(0).integers(0, 256, (25, 40)).astype(np.uint8)
    frame = Frame(7, np.kron(blocks, np.ones((8, 8), np.uint8)))
    return QueryImage.of(frame, FeatureExtractor(CAMERA, FeatureSettings(count=300, levels=5)))


def test_at_its_features_an_image_is_described_as_they_are(image) -> None:
    recorded_px = CAMERA.distort(image.features.pixels)
    known, descriptors = image.describe_at(recorded_px, image.features.octaves.astype(np.int64))
    assert len(image.features) > 200
    assert known.all()
    assert np.array_equal(descriptors, image.features.descriptors)


def test_along_another_orientation_they_are_others(image) -> None:
    recorded_px, octaves = CAMERA.distort(image.features.pixels), image.features.octaves.astype(np.int64)
    _, same = image.describe_at(recorded_px, octaves, image.features.angles_deg - 360.0)
    _, turned = image.describe_at(recorded_px, octaves, image.features.angles_deg + 90.0)
    assert np.mean(np.all(same == image.features.descriptors, axis=1)) > 0.99
    bits = np.bitwise_count(turned ^ image.features.descriptors).sum(axis=1)
    assert 90.0 < bits.mean() < 160.0


def test_a_place_that_is_less_than_half_a_pixel_of_its_level_away_is_the_same(image) -> None:
    aside_px = 0.4 * 1.2 ** image.features.octaves.astype(np.float64)
    recorded_px = CAMERA.distort(image.features.pixels) + aside_px[:, None] * [[1.0, -1.0]]
    _, descriptors = image.describe_at(recorded_px, image.features.octaves.astype(np.int64))
    assert np.mean(np.all(descriptors == image.features.descriptors, axis=1)) > 0.9


def test_at_the_border_nothing_is_known(image) -> None:
    places = np.array([[160.0, 100.0], [18.0, 100.0], [160.0, 181.4], [160.0, 182.0], [-50.0, 100.0]])
    known, _ = image.describe_at(places, np.zeros(5, np.int64))
    assert known.tolist() == [True, False, False, False, False]
    assert image.describe_at(places[:1], np.array([4]))[0].tolist() == [True]
    assert image.describe_at(np.array([[30.0, 100.0]]), np.array([4]))[0].tolist() == [False]  # 14 pixels there


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(CalibrationError):
        QueryImage.of(Frame(0, np.zeros((100, 100), np.uint8)), FeatureExtractor(CAMERA))
