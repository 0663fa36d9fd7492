"""Features found ahead are those of the frames, in their order, and nothing is left behind."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.errors import CalibrationError, DriveError
from fleetmap.vision.features import FeatureExtractor, FeatureSettings
from fleetmap_localizer.feature_stream import with_features

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5, (-0.2, 0.05, 0.0, 0.0, 0.0))
SETTINGS = FeatureSettings(count=200, levels=4)


def frames(count: int, width: int = 160) -> list[Frame]:
    rng = np.random.default_rng(0)
    return [Frame(i, rng.integers(0, 256, (120, width)).astype(np.uint8)) for i in range(count)]


def test_every_frame_comes_with_its_own_features() -> None:
    given = frames(5)
    alone = FeatureExtractor(CAMERA, SETTINGS)
    found = list(with_features(given, CAMERA, SETTINGS))
    assert [image.stamp_ns for image in found] == [frame.stamp_ns for frame in given]
    for frame, image in zip(given, found, strict=True):
        expected = alone.extract(frame.image)
        assert np.array_equal(image.features.pixels, expected.pixels)
        assert np.array_equal(image.features.descriptors, expected.descriptors)
        assert len(image.features) > 50
        assert np.array_equal(image.pyramid.levels[0], frame.image)


def test_reading_and_finding_happen_elsewhere_and_not_far_ahead() -> None:
    read_by: list[str] = []

    def source() -> Iterator[Frame]:
        for frame in frames(12):
            read_by.append(threading.current_thread().name)
            yield frame

    for number, _ in enumerate(with_features(source(), CAMERA, SETTINGS)):
        assert len(read_by) <= number + 1 + 2 * (2 + 1)
    assert len(read_by) == 12
    assert threading.current_thread().name not in read_by


def test_what_is_damaged_is_told_at_its_frame() -> None:
    def source() -> Iterator[Frame]:
        yield from frames(3)
        raise DriveError("the recording ends in the middle of an image")

    for given, error in ((source(), DriveError), (iter([*frames(3), *frames(1, width=80)]), CalibrationError)):
        coming = with_features(given, CAMERA, SETTINGS)
        assert [next(coming).stamp_ns for _ in range(3)] == [0, 1, 2]
        with pytest.raises(error):
            next(coming)


def test_giving_up_early_leaves_no_thread_behind() -> None:
    before = threading.active_count()
    coming = with_features(frames(50), CAMERA, SETTINGS)
    next(coming)
    assert threading.active_count() == before + 2
    coming.close()
    assert threading.active_count() == before
