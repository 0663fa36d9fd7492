"""How good a map is along the road: measured at each keyframe, at each fix and on each step of the way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Stamps = NDArray[np.int64]


def horizontal_sigmas_m(covariances_m2: NDArray[np.floating]) -> Array:
    """Sigma (N,) of positions with covariances (N, 3, 3) in their worst horizontal direction."""
    east, north = covariances_m2[:, 0, 0].astype(np.float64), covariances_m2[:, 1, 1].astype(np.float64)
    half_spread = np.hypot((east - north) / 2.0, covariances_m2[:, 0, 1])
    return np.asarray(np.sqrt((east + north) / 2.0 + half_spread))


@dataclass(frozen=True)
class KeyframeQuality:
    """At each keyframe, in time order."""

    stamps_ns: Stamps  # (K,) int64
    along_m: Array  # (K,) float64 way driven since the first posed image
    positions_m: Array  # (K, 3) float64 camera centres in map
    covariances_m2: Array32  # (K, 3, 3) float32 of the positions, in map; NaN where no fix determines them
    reprojection_rms_px: Array32  # (K,) float32, errors in sigmas of the features: pixels in the finest octave
    landmarks: NDArray[np.int32]  # (K,) int32 seen

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def horizontal_sigmas_m(self) -> Array:
        """Sigma (K,) of the position in its worst horizontal direction; NaN where undetermined."""
        return horizontal_sigmas_m(self.covariances_m2)

    @property
    def vertical_sigmas_m(self) -> Array:
        """Sigma (K,) of the height; NaN where undetermined."""
        return np.sqrt(self.covariances_m2[:, 2, 2].astype(np.float64))


@dataclass(frozen=True)
class FixQuality:
    """At each fix that lies between two posed images, in time order."""

    stamps_ns: Stamps  # (F,) int64
    along_m: Array  # (F,) float64
    residuals_m: Array32  # (F, 3) float32 east, north, up: the antenna as mapped minus the fix
    sigmas: Array32  # (F,) float32 RMS of the residual's three parts, each over its own sigma
    claimed_sigmas_m: Array32  # (F,) float32 as the receiver states them, in the worst horizontal direction

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True)
class RoadQuality:
    """All that is known along the road."""

    keyframes: KeyframeQuality
    fixes: FixQuality
    edges_m: Array  # (S + 1,) float64 ascending: where the steps of the way begin and end
    landmarks_per_m: Array32  # (S,) float32 on each step; a landmark counts in parts where it was seen from
    gap_stamps_ns: Stamps  # (G, 2) int64 last posed image before and first one after a time without
    gaps_m: Array  # (G, 2) float64 the same along the road

    @property
    def length_m(self) -> float:
        """Way driven from the first to the last posed image."""
        return float(self.edges_m[-1])
