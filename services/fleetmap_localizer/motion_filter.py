"""The error-state Kalman filter that carries a vehicle's pose from one measured pose to the next.

Source: J. Solà, "Quaternion kinematics for the error-state Kalman filter", 2017 (arXiv:1711.02508), sections 5.4
and 6.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainc

from fleetmap.drive import GnssFix
from fleetmap.geodesy import UtmGrid, normal_gravity_m_s2
from fleetmap.geometry import Pose
from fleetmap_localizer.filter_measurements import (
    Measurement,
    camera_jacobian,
    camera_pose,
    fix_covariance_m2,
    fix_measurement,
    pose_measurement,
    wheel_measurement,
)
from fleetmap_localizer.filter_noise import inertial_rates, side_covariance, turning_rates
from fleetmap_localizer.filter_process import inertial_step, turning_step
from fleetmap_localizer.filter_settings import DeadReckoningSettings
from fleetmap_localizer.filter_state import GNSS_BIAS, GYRO_BIAS, POSITION, ROTATION, SIZE, FilterState
from fleetmap_localizer.filter_update import corrected, innovation_distance

Array = NDArray[np.float64]

_SITE_M = 1000.0  # after which scale, convergence and gravity are looked up again


@dataclass(frozen=True)
class Rig:
    """What the filter's base carries."""

    base_from_cam: Pose
    vehicle_from_base: Pose  # x forward, y left, z up, at the rolling axle
    antenna_in_base_m: Array  # (3,)
    has_wheels: bool  # whose speed is read
    is_mounting_known: bool  # of the vehicle's frame


@dataclass(frozen=True)
class Site:
    """What the Earth and its grid are like around a place."""

    grid: UtmGrid
    position_m: Array  # (3,) in the grid
    grid_scale: float  # grid metres per metre on the ground
    gravity_m_s2: float

    @staticmethod
    def around(epsg: int, position_m: Array) -> Site:
        """The site at a place in the grid."""
        grid = UtmGrid(epsg)
        lat_deg, lon_deg, height_m = (float(value) for value in grid.to_geodetic(position_m))
        scale = grid.point_scale_factor(lat_deg, lon_deg)
        return Site(grid, position_m, scale, normal_gravity_m_s2(lat_deg, height_m))


class MotionFilter:
    """Predict with motion, correct with what is measured; one of each per call, in time order."""

    def __init__(self, state: FilterState, site: Site, rig: Rig, settings: DeadReckoningSettings) -> None:
        self.state = state
        self._site, self._rig, self._settings = site, rig, settings
        self._turn_rate_rad_s = -state.gyro_bias_rad_s
        self._gnss_variances_m2 = np.zeros(3)  # until there is a fix
        self._inertial_rates = inertial_rates(settings, self._gnss_variances_m2)
        self._wander = np.zeros(SIZE)  # variance per second by which the map's error changes along the way

    @property
    def speed_mps(self) -> float:
        """Over ground."""
        return float(np.linalg.norm(self.state.velocity_m_s))

    def predict_inertial(self, turn_rad_s: Array, force_m_s2: Array, seconds: float) -> None:
        """Go on for some time, in which an IMU measured these means (Solà, eq. 260, 261, 269)."""
        state, site = self.state, self._site
        decays, noises = self._inertial_rates
        self.state = state.carried(
            *inertial_step(
                state.position_m, state.velocity_m_s, state.rotation, state.gyro_bias_rad_s,
                state.accel_bias_m_s2, state.gyro_mixing, state.covariance, turn_rad_s, force_m_s2,
                site.gravity_m_s2, site.grid_scale, seconds, decays, noises + self._wander,
            )
        )  # fmt: skip
        self._turn_rate_rad_s = turn_rad_s - state.gyro_bias_rad_s

    def predict_turning(self, seconds: float) -> None:
        """Go on for some time, of which no IMU tells; in steps that are short enough."""
        for _ in range(steps := int(np.ceil(seconds / self._settings.turning.longest_step_s))):
            self._turn_on(seconds / steps)

    def _turn_on(self, seconds: float) -> None:
        state = self.state
        decays, noises = turning_rates(self._settings, self._gnss_variances_m2, self.speed_mps)
        self._turn_rate_rad_s = -state.gyro_bias_rad_s
        carried = state.carried(
            *turning_step(
                state.position_m, state.velocity_m_s, state.rotation, state.gyro_bias_rad_s, state.covariance,
                self._site.grid_scale, seconds, decays, noises + self._wander,
            )
        )  # fmt: skip
        waning = np.exp(-seconds * decays[GYRO_BIAS])
        self.state = replace(carried, gyro_bias_rad_s=waning * state.gyro_bias_rad_s)

    def correct_by_pose(self, utm_from_cam: Pose, own: Array, common: Array, before: Array) -> bool:
        """Take in a measured camera pose, unless it contradicts what is known.

        Args:
            utm_from_cam: the pose.
            own: (6, 6) the covariance of its error that neighbouring poses do not share.
            common: (6, 6) that of the error which they do share, for a while.
            before: (6, 6) the same of the pose before; both widen the gate.
        """
        measured = pose_measurement(self.state, self._rig.base_from_cam, self._site.grid_scale, utm_from_cam, own)
        is_taken = self._correct(measured, before + common)
        self._wander[ROTATION] = np.trace(common[:3, :3]) / 3.0 * 2.0 / self._settings.common_time_s
        self._wander[POSITION] = np.trace(common[3:, 3:]) / 3.0 * 2.0 / self._settings.common_time_s
        if is_taken and np.linalg.norm(self.state.position_m - self._site.position_m) > _SITE_M:
            self._site = Site.around(self._site.grid.epsg, self.state.position_m)
        return is_taken

    def correct_by_wheels(self, speed_mps: float | None, since_s: float) -> bool:
        """Take in a wheel speed, or without one only that wheels roll where they point.

        ``since_s`` is the time that it speaks for: since the one before.
        """
        covariance = side_covariance(self._settings.wheel, self.speed_mps, since_s)
        return self._correct(
            wheel_measurement(
                self.state, self._rig.vehicle_from_base, self._turn_rate_rad_s, speed_mps, covariance
            )
        )

    def correct_by_fix(self, fix: GnssFix) -> bool:
        """Take in a GNSS fix; with the first, the filter begins to learn what the receiver's error is."""
        variances_m2 = fix_covariance_m2(self._site.grid, fix)
        if not self._gnss_variances_m2.any():
            covariance = self.state.covariance.copy()
            covariance[GNSS_BIAS, GNSS_BIAS] = variances_m2
            self.state = replace(self.state, covariance=covariance)
        self._gnss_variances_m2 = np.diag(variances_m2).copy()
        self._inertial_rates = inertial_rates(self._settings, self._gnss_variances_m2)
        return self._correct(
            fix_measurement(self.state, self._rig.antenna_in_base_m, self._site.grid, self._site.grid_scale, fix)
        )

    def camera_pose(self) -> tuple[Pose, Array]:
        """``utm_from_cam``, and its covariance (6, 6) in the tangent [rotation, translation] of the camera."""
        arm, scale = self._rig.base_from_cam, self._site.grid_scale
        jacobian = camera_jacobian(self.state, arm, scale)
        return camera_pose(self.state, arm, scale), jacobian @ self.state.covariance @ jacobian.T

    def doubt_pose(self, covariance: Array) -> None:
        """Be less sure of the camera's pose, by a covariance (6, 6) of its tangent: another map counts now."""
        jacobian = camera_jacobian(self.state, self._rig.base_from_cam, self._site.grid_scale)
        self.state = self.state.with_more_pose_uncertainty(covariance, jacobian)

    def _correct(self, measured: Measurement, slack: Array | None = None) -> bool:
        """Take in a measurement if it is one that the filter, wider by ``slack``, expects; else stay as it is."""
        H, P, r, V = measured.jacobian, self.state.covariance, measured.residual, measured.covariance
        distance = innovation_distance(P, H, r, V if slack is None else V + slack)
        if gammainc(0.5 * len(r), 0.5 * distance) > self._settings.gate_probability:  # chi-square's distribution
            return False
        self.state = self.state.injected(*corrected(P, H, r, V))
        return True
