"""What a 2-D lidar measures of a scene, and how it errs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Pose
from fleetmap.simulation.motion import Motion
from fleetmap.simulation.rendering import cast_rays
from fleetmap.simulation.world import Scene

Array = NDArray[np.float64]

_STREAM = 5
_BEAMS_AT_ONCE = 20  # the vehicle moves by less than a centimetre meanwhile


@dataclass(frozen=True)
class LidarModel:
    """A turning mirror: beams counter-clockwise about the sensor's z axis, one after the other.

    Figures: the data sheet of Hokuyo's UTM-30LX (270 deg, 40 turns/s, 30 m; 10 mm up to 10 m, beyond it 30 mm), of
    whose scans every fourth is kept, and every second beam.
    """

    first_rad: float = float(np.radians(-135.0))
    step_rad: float = float(np.radians(0.5))
    beams: int = 541
    turns_per_s: float = 40.0
    rate_hz: float = 10.0
    nearest_m: float = 0.1
    farthest_m: float = 30.0
    near_m: float = 10.0
    sigma_near_m: float = 0.01
    sigma_far_m: float = 0.03

    @property
    def scan_s(self) -> float:
        """How long the beams of one scan take."""
        return self.beams * self.step_rad / (2.0 * np.pi * self.turns_per_s)

    def directions(self) -> Array:
        """Unit vectors (beams, 3) in the sensor's frame."""
        angles = self.first_rad + self.step_rad * np.arange(self.beams)
        return np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)

    def true_ranges_m(self, scene: Scene, motion: Motion, cam_from_lidar: Pose, seconds: float) -> Array:
        """Distances (beams,) on the ground to what each beam meets from ``seconds`` on; infinite without."""
        directions, ranges = self.directions(), []
        reach_m = 1.1 * self.farthest_m * motion.grid_scale
        for first in range(0, self.beams, _BEAMS_AT_ONCE):
            chunk = directions[first : first + _BEAMS_AT_ONCE]
            middle_s = seconds + self.scan_s * (first + len(chunk) / 2.0) / self.beams
            ranges.append(cast_rays(scene, motion.map_from_cam(middle_s) @ cam_from_lidar, chunk, reach_m))
        return np.asarray(np.concatenate(ranges) / motion.grid_scale, dtype=np.float64)

    def measured(self, true_m: Array, stamp_ns: int, seed: int) -> Array:
        """What the lidar reports of true ranges (beams,); infinite where nothing is in its range (REP 117)."""
        generator = np.random.default_rng([seed, _STREAM, stamp_ns])
        sigma_m = np.where(true_m <= self.near_m, self.sigma_near_m, self.sigma_far_m)
        seen = (true_m >= self.nearest_m) & (true_m <= self.farthest_m)
        return np.where(seen, true_m + sigma_m * generator.standard_normal(self.beams), np.inf)
