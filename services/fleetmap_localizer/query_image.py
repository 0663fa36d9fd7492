"""An image to be localised: the features found in it, and the image itself, to be looked into once more."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.drive import Frame
from fleetmap.vision.descriptors import BORDER_PX, DESCRIPTOR_BYTES, describe
from fleetmap.vision.features import FeatureExtractor, Features
from fleetmap.vision.pyramid import GreyImage, level_from_image_px


@dataclass(frozen=True)
class QueryImage:
    """One image of a camera."""

    stamp_ns: int
    features: Features
    pyramid: tuple[GreyImage, ...]  # that the features were found on

    @staticmethod
    def of(frame: Frame, extractor: FeatureExtractor) -> QueryImage:
        """Find the features of a frame.

        Raises:
            CalibrationError: the image does not have the calibrated size.
        """
        pyramid = extractor.pyramid(frame.image)
        return QueryImage(frame.stamp_ns, extractor.extract_from(pyramid), tuple(pyramid))

    def describe_at(
        self, recorded_px: NDArray[np.float64], octaves: NDArray[np.int64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.uint8]]:
        """Descriptors (L, 32) at places (L, 2) of the image as recorded, be there corners or not.

        The first answer (L,) tells for which places they are known: close to the border of their octave, or beyond
        it, they are not.
        """
        known = np.zeros(len(recorded_px), dtype=np.bool_)
        descriptors = np.zeros((len(recorded_px), DESCRIPTOR_BYTES), dtype=np.uint8)
        for octave, level in enumerate(self.pyramid):
            on_level = np.flatnonzero(octaves == octave)
            pixels = level_from_image_px(recorded_px[on_level], self.pyramid[0].shape, level.shape)
            whole = np.rint(pixels).astype(np.int32)
            beyond = np.array([level.shape[1], level.shape[0]]) - BORDER_PX
            inside = np.all((whole >= BORDER_PX) & (whole < beyond), axis=1)
            known[on_level[inside]] = True
            descriptors[on_level[inside]] = describe(level, np.ascontiguousarray(whole[inside]))
        return known, descriptors
