"""How the vehicle moves: where it should be next, and where it cannot have got to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Pose, so3_exp, so3_log
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.settings import TrackingSettings


@dataclass(frozen=True)
class Motion:
    """The last two poses of an unbroken track; constant velocity between images.

    In UTM, so that it goes on where one version of a map takes the place of another.
    """

    stamp_ns: int
    utm_from_cam: Pose
    inlier_count: int
    epsg: int
    map_id: str
    version: str
    previous_stamp_ns: int | None = None
    utm_from_previous: Pose | None = None

    @property
    def is_fresh(self) -> bool:
        """Whether it rests on a single image, which another place may have deceived."""
        return self.previous_stamp_ns is None

    def follow(self, stamp_ns: int, utm_from_cam: Pose, inlier_count: int, map_id: str, version: str) -> Motion:
        """The motion after one more pose in the same zone."""
        return Motion(
            stamp_ns, utm_from_cam, inlier_count, self.epsg, map_id, version, self.stamp_ns, self.utm_from_cam
        )

    def distance_to(self, view: MapView) -> int:
        """0 for the map of the last pose, 1 for another version of it, 2 for others."""
        if view.map_id != self.map_id:
            return 2
        return int(view.version != self.version)

    def predict(self, stamp_ns: int) -> Pose:
        """``utm_from_cam`` at a later time; where it stands while its velocity is not known."""
        if self.previous_stamp_ns is None or self.utm_from_previous is None:
            return self.utm_from_cam
        fraction = (stamp_ns - self.stamp_ns) / (self.stamp_ns - self.previous_stamp_ns)
        step = self.utm_from_previous.inverse() @ self.utm_from_cam
        return self.utm_from_cam @ _fraction_of(step, fraction)

    def can_reach(self, stamp_ns: int, position_in_utm_m: NDArray[np.float64], settings: TrackingSettings) -> bool:
        """Whether a vehicle can be there (3,) by then, as far as its brakes, engine and tyres go."""
        elapsed_s = (stamp_ns - self.stamp_ns) * 1e-9
        away_m = float(np.linalg.norm(position_in_utm_m - self.predict(stamp_ns).translation_m))
        if self.previous_stamp_ns is None:
            return away_m <= settings.slack_m + settings.max_speed_mps * elapsed_s
        span_s = elapsed_s + (self.stamp_ns - self.previous_stamp_ns) * 1e-9
        return away_m <= settings.slack_m + 0.5 * settings.max_acceleration_mps2 * span_s**2


def _fraction_of(step: Pose, fraction: float) -> Pose:
    """The same screw motion for another length of time: exp(fraction * log(step)) in SE(3)."""
    rotation_vector = so3_log(step.rotation)
    velocity = np.linalg.solve(_left_jacobian(rotation_vector), step.translation_m)
    scaled = fraction * rotation_vector
    return Pose(so3_exp(scaled), _left_jacobian(scaled) @ (fraction * velocity))


def _left_jacobian(rotation_vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """V of SE(3)'s exponential (3, 3). Source: T. Barfoot, "State Estimation for Robotics", 2017, section 7.1."""
    angle = float(np.linalg.norm(rotation_vector))
    x, y, z = rotation_vector
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-6:
        return np.asarray(np.eye(3) + 0.5 * K)
    return np.asarray(
        np.eye(3) + (1.0 - np.cos(angle)) / angle**2 * K + (angle - np.sin(angle)) / angle**3 * (K @ K)
    )
