"""What an RGB-D camera adds to an image, and how its depth errs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatImage = NDArray[np.float32]

_STREAM = 4


@dataclass(frozen=True)
class DepthErrorModel:
    """Noise that grows with the square of the depth, as triangulation has it, and a range.

    Source: C. V. Nguyen, S. Izadi and D. Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction and
    tracking", 3DIMPVT 2012: sigma = 0.0012 + 0.0019 (z - 0.4)^2, in metres. The range is what outdoor RGB-D
    cameras promise today.
    """

    sigma_near_m: float = 0.0012
    sigma_per_m2: float = 0.0019  # per square metre beyond nearest_m
    nearest_m: float = 0.4
    farthest_m: float = 10.0

    def sigma_m(self, depth_m: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """Standard deviation (...) at depths (...)."""
        return np.asarray(self.sigma_near_m + self.sigma_per_m2 * (depth_m - self.nearest_m) ** 2)

    def measured(self, true_m: FloatImage, stamp_ns: int, seed: int) -> FloatImage:
        """What the camera reports of true depths (H, W); NaN where it sees nothing."""
        generator = np.random.default_rng([seed, _STREAM, stamp_ns])
        noise = generator.standard_normal(true_m.shape, dtype=np.float32)
        seen = (true_m >= self.nearest_m) & (true_m <= self.farthest_m)
        depth_m = np.where(seen, true_m, np.float32(np.nan))
        return np.asarray(depth_m + noise * self.sigma_m(depth_m), dtype=np.float32)
