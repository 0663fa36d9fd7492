"""ORB features, spread evenly over the image.

Source: Rublee, Rabaud, Konolige, Bradski, "ORB: an efficient alternative to SIFT or SURF", ICCV 2011. OpenCV
finds and describes the corners; it ranks them by strength alone, which leaves them clustered on the strongest
texture, so the choice among them is made here, cell by cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.errors import CalibrationError

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
DESCRIPTOR_BYTES = 32
_CANDIDATES_PER_FEATURE = 6  # the choice that the even spread is made from
_FEATURES_PER_CELL = 2.0


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
        self._detectors = [
            _orb(self.settings, threshold)
            for threshold in (self.settings.fast_threshold, self.settings.faint_fast_threshold)
        ]

    def extract(self, image: NDArray[np.uint8]) -> Features:
        """Features of a grey image (H, W) uint8; none in an image without texture.

        Raises:
            CalibrationError: the image does not have the calibrated size.
        """
        self._check_size(image)
        candidates, chosen = self._detect(np.ascontiguousarray(image))
        keypoints = [candidates[index] for index in chosen]
        if not keypoints:
            return _no_features(self.settings.scale_factor)
        described, descriptors = self._detectors[0].compute(image, keypoints)
        pixels, valid = self._undistort(np.asarray(cv2.KeyPoint.convert(described), dtype=np.float64))
        return Features(
            pixels=pixels[valid],
            octaves=np.array([keypoint.octave for keypoint in described], dtype=np.uint8)[valid],
            descriptors=np.ascontiguousarray(descriptors[valid], dtype=np.uint8),
            scale_factor=self.settings.scale_factor,
            camera=self.camera if self.camera.has_distortion else None,
        )

    def _undistort(self, distorted: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Undistorted pixels (N, 2), and which are to be trusted.

        Towards the corners of a strongly distorted image the polynomial may have no inverse, and what a fisheye
        lens sees beyond fleetmap.camera.WIDEST_ANGLE_DEG is left out.
        """
        with np.errstate(all="ignore"):
            pixels = self.camera.undistort(distorted)
            back = self.camera.project(self.camera.unproject(distorted))
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

    def _detect(self, image: NDArray[np.uint8]) -> tuple[Sequence[cv2.KeyPoint], IntArray]:
        for detector in self._detectors:
            candidates = detector.detect(image, None)
            chosen = self._choose(candidates)
            if 2 * len(chosen) >= self.settings.count:
                break
        return candidates, chosen

    def _choose(self, candidates: Sequence[cv2.KeyPoint]) -> IntArray:
        """Indices of at most ``count`` candidates: per octave, round after round the next best of every cell."""
        if not candidates:
            return np.zeros(0, dtype=np.int64)
        pixels = np.asarray(cv2.KeyPoint.convert(candidates), dtype=np.float64)
        octaves = np.array([keypoint.octave for keypoint in candidates])
        responses = np.array([keypoint.response for keypoint in candidates])
        present = np.bincount(octaves, minlength=self.settings.levels)
        quotas = _octave_quotas(self.settings, present)
        chosen = []
        for octave, quota in enumerate(quotas):
            members = np.flatnonzero(octaves == octave)
            picked = _spread(pixels[members], responses[members], quota, self.camera)
            chosen.append(np.sort(members[picked]))
        return np.concatenate(chosen)


def _orb(settings: FeatureSettings, threshold: int) -> cv2.ORB:
    return cv2.ORB.create(
        nfeatures=settings.count * _CANDIDATES_PER_FEATURE,
        scaleFactor=settings.scale_factor,
        nlevels=settings.levels,
        fastThreshold=threshold,
        scoreType=cv2.ORB_HARRIS_SCORE,
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


def _spread(pixels: Array, responses: Array, quota: int, camera: Camera) -> IntArray:
    """Indices of ``quota`` points: first the strongest of every cell, then every cell's second, and so on."""
    if quota == 0:
        return np.zeros(0, dtype=np.int64)
    cell_px = np.sqrt(camera.width_px * camera.height_px * _FEATURES_PER_CELL / quota)
    columns = int(camera.width_px // cell_px) + 1
    cells = (pixels[:, 1] // cell_px).astype(np.int64) * columns + (pixels[:, 0] // cell_px).astype(np.int64)
    strongest_first = np.argsort(-responses, kind="stable")
    rank_in_cell = np.empty(len(cells), dtype=np.int64)
    rank_in_cell[strongest_first] = _count_before(cells[strongest_first], int(cells.max()) + 1)
    by_rank = np.argsort(rank_in_cell[strongest_first], kind="stable")
    return np.asarray(strongest_first[by_rank[:quota]])


@njit(cache=True, nogil=True)
def _count_before(cells, cell_count):  # type: ignore[no-untyped-def]
    """How often each cell of the list occurs before that place in it."""
    seen, before = np.zeros(cell_count, np.int64), np.empty(len(cells), np.int64)
    for n, cell in enumerate(cells):
        before[n] = seen[cell]
        seen[cell] += 1
    return before


def _no_features(scale_factor: float) -> Features:
    return Features(
        pixels=np.zeros((0, 2)),
        octaves=np.zeros(0, dtype=np.uint8),
        descriptors=np.zeros((0, DESCRIPTOR_BYTES), dtype=np.uint8),
        scale_factor=scale_factor,
    )
