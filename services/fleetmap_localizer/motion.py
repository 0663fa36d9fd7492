"""How the vehicle moves: where it should be next, and where it cannot have got to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import Pose, so3_exp, so3_log
from fleetmap_localizer.settings import TrackingSettings


@dataclass(frozen=True)
class Motion:
    """The last two poses of an unbroken track; constant velocity between images."""

    stamp_ns: int
    map_from_cam: Pose
    inlier_count: int
    previous_stamp_ns: int | None = None
    map_from_previous: Pose | None = None

    def follow(self, stamp_ns: int, map_from_cam: Pose, inlier_count: int) -> Motion:
        """The motion after one more pose."""
        return Motion(stamp_ns, map_from_cam, inlier_count, self.stamp_ns, self.map_from_cam)

    def predict(self, stamp_ns: int) -> Pose:
        """``map_from_cam`` at a later time; where it stands while its velocity is not known."""
        if self.previous_stamp_ns is None or self.map_from_previous is None:
            return self.map_from_cam
        fraction = (stamp_ns - self.stamp_ns) / (self.stamp_ns - self.previous_stamp_ns)
        step = self.map_from_previous.inverse() @ self.map_from_cam
        return self.map_from_cam @ Pose(so3_exp(fraction * so3_log(step.rotation)), fraction * step.translation_m)

    def can_reach(self, stamp_ns: int, map_from_cam: Pose, settings: TrackingSettings) -> bool:
        """Whether a vehicle can be there by then, as far as its brakes, engine and tyres go."""
        elapsed_s = (stamp_ns - self.stamp_ns) * 1e-9
        away_m = float(np.linalg.norm(map_from_cam.translation_m - self.predict(stamp_ns).translation_m))
        if self.previous_stamp_ns is None:
            return away_m <= settings.slack_m + settings.max_speed_mps * elapsed_s
        span_s = elapsed_s + (self.stamp_ns - self.previous_stamp_ns) * 1e-9
        return away_m <= settings.slack_m + 0.5 * settings.max_acceleration_mps2 * span_s**2
