"""The features of the next images are found while the present one is being localised."""

from __future__ import annotations

from collections.abc import Generator, Iterable

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.read_ahead import read_ahead
from fleetmap.vision.features import FeatureExtractor, FeatureSettings
from fleetmap_localizer.query_image import QueryImage

_IMAGES_AHEAD = 2


def with_features(
    frames: Iterable[Frame], camera: Camera, settings: FeatureSettings
) -> Generator[QueryImage, None, None]:
    """Each frame with its features, in order; frames are read by one other thread, features found by a second.

    At most two images are in advance of the caller at either. For recordings that are worked through as fast as it
    goes: a frame that is only due later must not be asked for now. Closing the iterator ends the threads.

    Raises:
        CalibrationError: an image does not have the calibrated size; like what reading raises, after all frames
            before it.
    """
    extractor = FeatureExtractor(camera, settings)
    read = read_ahead(frames, _IMAGES_AHEAD)
    yield from read_ahead((QueryImage.of(frame, extractor) for frame in read), _IMAGES_AHEAD)
