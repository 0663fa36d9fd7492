"""ORB features, spread evenly over the image.

Source: Rublee, Rabaud, Konolige, Bradski, "ORB: an efficient alternative to SIFT or SURF", ICCV 2011. FAST corners
of every pyramid level; an image's strongest are clustered on its strongest texture, so they are chosen cell by
cell. Chosen by measurement: ranked by Harris' measure in place of FAST's score, a tenth fewer are found again in
the next image of a drive; of peaks of the smaller eigenvalue (Shi & Tomasi), another tenth fewer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.errors import CalibrationError
from fleetmap.vision.corners import corner_scores, corners_of, spread_evenly
from fleetmap.vision.descriptors import BORDER_PX, describe_along, orientations_deg
from fleetmap.vision.pyramid import GreyImage, Pyramid, image_from_level_px, image_pyramid

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
_FEATURES_PER_CELL = 5.0  # fewer spread more evenly, more leave the choice of the stronger corners


@dataclass(frozen=True)
class FeatureSettings:
    """How many features, on which pyramid, and how faint a corner may be."""

    count: int = 2000
    levels: int = 8
    scale_factor: float = 1.2
    fast_threshold: int = 7  # grey levels; finds enough in daylight
    faint_fast_threshold: int = 3  # tried where the first finds fewer than half of count: dusk, fog, dark images


@dataclass(frozen=True)
class Features:
    """Corners of one image; arrays run in parallel, sorted by octave."""

    pixels: Array  # (N, 2) float64 undistorted pixels (Camera.undistort); may lie outside the image
    octaves: NDArray[np.uint8]  # (N,) uint8 pyramid level
    descriptors: NDArray[np.uint8]  # (N, 32) uint8
    angles_deg: NDArray[np.float32]  # (N,) float32 orientation in the image as recorded, from x towards y
    scale_factor: float  # between pyramid levels
    camera: Camera | None = None  # whose lens was undone; None = one without distortion

    def __len__(self) -> int:
        return len(self.pixels)

    @cached_property
    def sigmas_px(self) -> Array:
        """Localisation sigma of each feature (N,): one pixel of its pyramid level, stretched by undistorting."""
        recorded_px = np.asarray(self.scale_factor ** self.octaves.astype(np.float64))
        return recorded_px if self.camera is None else recorded_px * self.camera.magnification(self.pixels)


class FeatureExtractor:
    """Finds features in the images of one camera; the same image always gives the same features."""

    def __init__(self, camera: Camera, settings: FeatureSettings | None = None) -> None:
        self.camera = camera
        self.settings = settings or FeatureSettings()

    def extract(self, image: NDArray[np.uint8]) -> Features:
        """Features of a grey image (H, W) uint8; none in an image without texture.

        Raises:
            CalibrationError: the image does not have the calibrated size.
        """
        return self.extract_from(self.pyramid(image))

    def pyramid(self, image: NDArray[np.uint8]) -> Pyramid:
        """The levels that features of a grey image (H, W) uint8 are found on.

        Raises:
            CalibrationError: the image does not have the calibrated size.
        """
        self._check_size(image)
        return Pyramid(tuple(image_pyramid(image, self.settings.levels, self.settings.scale_factor)))

    def extract_from(self, pyramid: Pyramid) -> Features:
        """Features of the image that ``pyramid`` was made of."""
        levels, shape = pyramid.levels, pyramid.levels[0].shape
        chosen = self._chosen_corners(levels)
        angles = [orientations_deg(*on_level) for on_level in zip(levels, chosen, strict=True)]
        descriptors = [describe_along(*on_level) for on_level in zip(pyramid.blurred, chosen, angles, strict=True)]
        recorded = [
            image_from_level_px(pixels.astype(np.float64), shape, level.shape)
            for pixels, level in zip(chosen, levels, strict=True)
        ]
        octaves = np.repeat(np.arange(len(levels), dtype=np.uint8), [len(pixels) for pixels in chosen])
        pixels, valid = self._undistort(np.concatenate(recorded))
        return Features(
            pixels=pixels[valid],
            octaves=octaves[valid],
            descriptors=np.concatenate(descriptors)[valid],
            angles_deg=np.concatenate(angles)[valid],
            scale_factor=self.settings.scale_factor,
            camera=self.camera if self.camera.has_distortion else None,
        )

    def _chosen_corners(self, levels: Sequence[GreyImage]) -> list[NDArray[np.int32]]:
        """Pixels (n, 2) of every level, together at most ``count``."""
        scores = [corner_scores(level) for level in levels]
        for threshold in (self.settings.fast_threshold, self.settings.faint_fast_threshold):
            corners = [corners_of(level_scores, threshold, BORDER_PX) for level_scores in scores]
            if 2 * sum(len(on_level) for on_level in corners) >= self.settings.count:
                break
        quotas = _octave_quotas(self.settings, np.array([len(on_level) for on_level in corners]))
        chosen = []
        for level, on_level, quota in zip(levels, corners, quotas, strict=True):
            cell_px = float(np.sqrt(level.size * _FEATURES_PER_CELL / max(quota, 1)))
            chosen.append(on_level.pixels[spread_evenly(on_level, quota, cell_px)])
        return chosen

    def _undistort(self, distorted: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Undistorted pixels (N, 2), and which are to be trusted.

        Towards the corners of a strongly distorted image the polynomial may have no inverse, and what a fisheye
        lens sees beyond fleetmap.camera.WIDEST_ANGLE_DEG is left out.
        """
        with np.errstate(all="ignore"):
            pixels = self.camera.undistort(distorted)
            back = self.camera.distort(pixels)
            valid = np.linalg.norm(back - distorted, axis=1) < 0.1
            return pixels, np.asarray(valid & self.camera.is_within_reach(pixels))

    def _check_size(self, image: NDArray[np.uint8]) -> None:
        calibrated = (self.camera.height_px, self.camera.width_px)
        if image.shape != calibrated:
            seen = f"{image.shape[1]}x{image.shape[0]}" if image.ndim == 2 else f"of shape {image.shape}"
            raise CalibrationError(
                f"an image is {seen}, but its camera is calibrated for {calibrated[1]}x{calibrated[0]}; "
                "give the calibration of the images as they were recorded"
            )


def _octave_quotas(settings: FeatureSettings, present: IntArray) -> list[int]:
    """Features per octave in proportion to its side length; what an octave lacks goes to the finer ones."""
    shares = settings.scale_factor ** -np.arange(settings.levels, dtype=np.float64)
    quotas = [0] * settings.levels
    left = settings.count
    for octave in reversed(range(settings.levels)):
        fair = left * shares[octave] / shares[: octave + 1].sum()
        quotas[octave] = min(round(fair), int(present[octave]))
        left -= quotas[octave]
    for octave in range(settings.levels):  # what the finest could not take either
        more = min(left, int(present[octave]) - quotas[octave])
        quotas[octave] += more
        left -= more
    return quotas
