"""The motion filter's first state, from two measured poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Pose, so3_log
from fleetmap_localizer.filter_measurements import to_grid
from fleetmap_localizer.filter_process import skew
from fleetmap_localizer.filter_settings import DeadReckoningSettings
from fleetmap_localizer.filter_state import (
    ACCEL_BIAS,
    AXLE,
    GYRO_BIAS,
    GYRO_MIXING,
    POSITION,
    ROTATION,
    SIZE,
    SLIP,
    VELOCITY,
    WHEEL_SCALE,
    FilterState,
)
from fleetmap_localizer.motion_filter import MotionFilter, Rig, Site
from fleetmap_localizer.pose_estimate import PoseEstimate

Array = NDArray[np.float64]


def start_filter(
    first: PoseEstimate, second: PoseEstimate, rig: Rig, *, has_imu: bool, settings: DeadReckoningSettings
) -> MotionFilter | None:
    """A filter at the second of two measured poses; None if no vehicle gets from one to the other."""
    seconds = (second.stamp_ns - first.stamp_ns) * 1e-9
    if first.epsg != second.epsg or not 0.0 < seconds <= settings.longest_start_s:
        return None
    site = Site.around(second.epsg, second.utm_from_cam.translation_m)
    scale = to_grid(site.grid_scale)
    before, after = (_base(pose.utm_from_cam, rig, scale) for pose in (first, second))
    velocity = (after.translation_m - before.translation_m) / scale / seconds
    if np.linalg.norm(velocity) > settings.fastest_mps:
        return None
    turn_rate = so3_log(before.rotation.T @ after.rotation) / seconds
    state = FilterState(
        position_m=after.translation_m,
        velocity_m_s=velocity,
        rotation=after.rotation,
        gyro_bias_rad_s=np.zeros(3) if has_imu else -turn_rate,
        accel_bias_m_s2=np.zeros(3),
        gyro_mixing=np.zeros((3, 3)),
        wheel_scale=0.0,
        slip_rad=np.zeros(2),
        axle_m=0.0,
        gnss_bias_m=np.zeros(3),
        covariance=_first_covariance(first, second, rig, settings, has_imu=has_imu),
    )
    return MotionFilter(state, site, rig, settings)


def _base(utm_from_cam: Pose, rig: Rig, scale: Array) -> Pose:
    """``utm_from_base`` of a camera pose."""
    rotation = utm_from_cam.rotation @ rig.base_from_cam.rotation.T
    return Pose(rotation, utm_from_cam.translation_m - scale * (rotation @ rig.base_from_cam.translation_m))


def _first_covariance(
    first: PoseEstimate, second: PoseEstimate, rig: Rig, settings: DeadReckoningSettings, *, has_imu: bool
) -> Array:
    """Of the error state (SIZE, SIZE): rotation and position of the base as measured, all else by its prior."""
    own = 1.0 - settings.common_share
    before, after = (own * _of_base(pose, rig) for pose in (first, second))
    seconds = (second.stamp_ns - first.stamp_ns) * 1e-9
    P = np.zeros((SIZE, SIZE))
    pose = np.r_[ROTATION, POSITION]
    P[np.ix_(pose, pose)] = after
    speeding_up = 0.5 * settings.start_acceleration_m_s2 * seconds
    P[VELOCITY, VELOCITY] = (before + after)[3:, 3:] / seconds**2 + speeding_up**2 * np.eye(3)
    variances = np.zeros(SIZE)
    if has_imu:
        variances[GYRO_BIAS] = settings.imu.gyro_bias_sigma_rad_s**2
        variances[ACCEL_BIAS] = settings.imu.accel_bias_sigma_m_s2**2
        variances[GYRO_MIXING] = settings.imu.gyro_mixing_sigma**2
    else:
        turning = 0.5 * settings.start_angular_acceleration_rad_s2 * seconds
        P[GYRO_BIAS, GYRO_BIAS] = (before + after)[:3, :3] / seconds**2 + turning**2 * np.eye(3)
    wheel = settings.wheel
    variances[WHEEL_SCALE] = wheel.scale_sigma**2
    variances[AXLE] = wheel.axle_sigma_m**2
    variances[SLIP] = (wheel.slip_sigma_rad if rig.is_mounting_known else wheel.slip_sigma_unknown_rad) ** 2
    return P + np.diag(variances)


def _of_base(pose: PoseEstimate, rig: Rig) -> Array:
    """Covariance (6, 6) of [the base's rotation in its own frame, its position in the grid]."""
    by_tangent = np.zeros((6, 6))
    utm_from_base = pose.utm_from_cam.rotation @ rig.base_from_cam.rotation.T
    by_tangent[:3, :3] = rig.base_from_cam.rotation
    by_tangent[3:, 3:] = pose.utm_from_cam.rotation
    by_tangent[3:, :3] = utm_from_base @ skew(rig.base_from_cam.translation_m) @ rig.base_from_cam.rotation
    return by_tangent @ pose.covariance @ by_tangent.T
