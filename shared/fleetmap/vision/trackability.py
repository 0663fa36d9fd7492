"""How well images can be tracked: how many features they have, how many are found again, and for how long.

It says whether a simulated world is as hard, and as easy, as a real road.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.vision.features import FeatureExtractor, Features, FeatureSettings
from fleetmap.vision.matching import match_descriptors

# Every corner that there is at the threshold of daylight: the texture is counted, not the wish.
_ALL_FEATURES = FeatureSettings(count=1_000_000, faint_fast_threshold=FeatureSettings().fast_threshold)
_MAX_DISTANCE = 50  # Hamming bits
_EPIPOLAR_LIMIT_PX = 1.0


@dataclass(frozen=True)
class Trackability:
    """Means over neighbouring images of one drive."""

    image_count: int
    features_per_megapixel: float  # corners of all octaves, without an upper limit
    match_ratio: float  # of an image's 2000 best spread features, found again in the next along epipolar lines
    track_length: float  # images through which a feature that is found again at all is followed

    def factor_to(self, other: Trackability) -> dict[str, float]:
        """How many times as much, or as little, as the other's; at least 1, by figure."""
        pairs = {
            "features": (self.features_per_megapixel, other.features_per_megapixel),
            "match ratio": (self.match_ratio, other.match_ratio),
            "track length": (self.track_length, other.track_length),
        }
        return {name: max(a, b) / max(min(a, b), 1e-9) for name, (a, b) in pairs.items()}


def measure_trackability(images: Iterable[NDArray[np.uint8]], camera: Camera) -> Trackability:
    """Measure neighbouring grey images (H, W) uint8 of one camera in the order they were taken.

    Raises:
        CalibrationError: an image does not have the calibrated size.
        ValueError: fewer than two images.
    """
    counting, tracking = FeatureExtractor(camera, _ALL_FEATURES), FeatureExtractor(camera)
    counts, ratios, lengths = [], [], []
    before: Features | None = None
    ages = np.zeros(0, dtype=np.int64)  # images that have seen each feature of the image before
    for image in images:
        counts.append(len(counting.extract(image)))
        now = tracking.extract(image)
        ages_now = np.ones(len(now), dtype=np.int64)
        if before is not None:
            pairs = _consistent_pairs(before, now)
            ratios.append(len(pairs) / max(1, min(len(before), len(now))))
            ages_now[pairs[:, 1]] = ages[pairs[:, 0]] + 1
            lengths.append(np.delete(ages, pairs[:, 0]))
        before, ages = now, ages_now
    if len(counts) < 2:
        raise ValueError("trackability is measured between images; there are fewer than two")
    followed = np.concatenate([*lengths, ages])
    followed = followed[followed >= 2]
    megapixels = camera.width_px * camera.height_px * 1e-6
    return Trackability(
        image_count=len(counts),
        features_per_megapixel=float(np.mean(counts) / megapixels),
        match_ratio=float(np.mean(ratios)),
        track_length=float(followed.mean()) if len(followed) else 0.0,
    )


def _consistent_pairs(a: Features, b: Features) -> NDArray[np.int64]:
    """Index pairs (P, 2) that look alike and obey one epipolar geometry; false matches mostly do not."""
    pairs = match_descriptors(a.descriptors, b.descriptors, _MAX_DISTANCE)
    if len(pairs) < 16:
        return np.zeros((0, 2), dtype=np.int64)
    _, inliers = cv2.findFundamentalMat(
        a.pixels[pairs[:, 0]], b.pixels[pairs[:, 1]], cv2.USAC_MAGSAC, _EPIPOLAR_LIMIT_PX, 0.999, 2000
    )
    if inliers is None:
        return np.zeros((0, 2), dtype=np.int64)
    return np.asarray(pairs[inliers.ravel() != 0], dtype=np.int64)
