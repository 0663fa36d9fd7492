"""An image to be localised: the features found in it, and the image itself, to be looked into once more."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fleetmap.drive import Frame
from fleetmap.vision.descriptors import BORDER_PX, DESCRIPTOR_BYTES, describe_along, orientations_deg
from fleetmap.vision.features import FeatureExtractor, Features
from fleetmap.vision.pyramid import Pyramid, level_from_image_px


@dataclass(frozen=True)
class QueryImage:
    """One image of a camera."""

    stamp_ns: int
    features: Features
    pyramid: Pyramid  # that the features were found on

    @staticmethod
    def of(frame: Frame, extractor: FeatureExtractor) -> QueryImage:
        """Find the features of a frame.

        Raises:
            CalibrationError: the image does not have the calibrated size.
        """
        pyramid = extractor.pyramid(frame.image)
        return QueryImage(frame.stamp_ns, extractor.extract_from(pyramid), pyramid)

    def describe_at(
        self,
        recorded_px: NDArray[np.float64],
        octaves: NDArray[np.int64],
        angles_deg: NDArray[np.float64] | None = None,
    ) -> tuple[NDArray[np.bool_], NDArray[np.uint8]]:
        """Descriptors (L, 32) at places (L, 2) of the image as recorded, be there corners or not.

        They are taken along ``angles_deg`` (L,), from x towards y; where those are not known, along what the image
        itself shows. The first answer (L,) tells which descriptors are known: close to the border of their octave,
        or beyond it, they are not.
        """
        known = np.zeros(len(recorded_px), dtype=np.bool_)
        descriptors = np.zeros((len(recorded_px), DESCRIPTOR_BYTES), dtype=np.uint8)
        levels = self.pyramid.levels
        for octave, (level, blurred) in enumerate(zip(levels, self.pyramid.blurred, strict=True)):
            on_level = np.flatnonzero(octaves == octave)
            pixels = level_from_image_px(recorded_px[on_level], levels[0].shape, level.shape)
            whole = np.rint(pixels).astype(np.int32)
            beyond = np.array([level.shape[1], level.shape[0]]) - BORDER_PX
            inside = np.all((whole >= BORDER_PX) & (whole < beyond), axis=1)
            rows, corners = on_level[inside], np.ascontiguousarray(whole[inside])
            along = orientations_deg(level, corners) if angles_deg is None else angles_deg[rows].astype(np.float32)
            known[rows] = True
            descriptors[rows] = describe_along(blurred, corners, along)
        return known, descriptors

    @cached_property
    def recorded_px(self) -> NDArray[np.float64]:
        """Where the features (N, 2) are in the image as recorded."""
        camera = self.features.camera
        return self.features.pixels if camera is None else camera.distort(self.features.pixels)
