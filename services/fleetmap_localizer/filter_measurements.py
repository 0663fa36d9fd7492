"""What poses, wheels and receivers say about the motion filter's state: residuals and their derivatives.

Source: Solà (see ``filter_state``), section 6.1; every residual is linear in the error state, to first order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.drive import GnssFix
from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import Pose, so3_log
from fleetmap_localizer.filter_process import skew
from fleetmap_localizer.filter_state import (
    AXLE,
    GNSS_BIAS,
    GYRO_BIAS,
    POSITION,
    ROTATION,
    SIZE,
    SLIP,
    VELOCITY,
    WHEEL_SCALE,
    FilterState,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Measurement:
    """M numbers that were measured, against what the state makes of them."""

    residual: Array  # (M,) measured - expected
    jacobian: Array  # (M, SIZE) of what is expected, by the error state
    covariance: Array  # (M, M) of what was measured


def pose_measurement(
    state: FilterState, base_from_cam: Pose, grid_scale: float, utm_from_cam: Pose, covariance: Array
) -> Measurement:
    """A measured camera pose, in the tangent [rotation, translation] of the camera."""
    expected = camera_pose(state, base_from_cam, grid_scale)
    turn = so3_log(expected.rotation.T @ utm_from_cam.rotation)
    shift = expected.rotation.T @ (utm_from_cam.translation_m - expected.translation_m)
    jacobian = camera_jacobian(state, base_from_cam, grid_scale)
    return Measurement(np.concatenate([turn, shift]), jacobian, covariance)


def camera_pose(state: FilterState, base_from_cam: Pose, grid_scale: float) -> Pose:
    """``utm_from_cam``; the lever arm is in metres on the ground."""
    arm_m = to_grid(grid_scale) * (state.rotation @ base_from_cam.translation_m)
    return Pose(state.rotation @ base_from_cam.rotation, state.position_m + arm_m)


def camera_jacobian(state: FilterState, base_from_cam: Pose, grid_scale: float) -> Array:
    """Derivative (6, SIZE) of the camera's tangent [rotation, translation] by the error state."""
    jacobian = np.zeros((6, SIZE))
    cam_from_utm = (state.rotation @ base_from_cam.rotation).T
    jacobian[:3, ROTATION] = base_from_cam.rotation.T
    jacobian[3:, POSITION] = cam_from_utm
    jacobian[3:, ROTATION] = cam_from_utm @ _by_turn(state, base_from_cam.translation_m, grid_scale)
    return jacobian


def wheel_measurement(
    state: FilterState,
    vehicle_from_base: Pose,
    turn_rate_rad_s: Array,
    speed_mps: float | None,
    covariance: Array,
) -> Measurement:
    """A forward speed, and that wheels do not slide aside nor leave the road; without a speed only that.

    Source: G. Dissanayake et al., "The aiding of a low-cost strapdown inertial measurement unit using vehicle
    model constraints for land vehicle applications", IEEE TRA 17(5), 2001, eq. 9 and 10; with the slip angles.

    Args:
        state: of the filter.
        vehicle_from_base: the vehicle's frame: x forward, y left, z up.
        turn_rate_rad_s: (3,) of the base.
        speed_mps: as the wheels report it.
        covariance: (3, 3) of forward, left, up; its lower right without a speed.
    """
    arm_m = vehicle_from_base.inverse().translation_m
    in_base = state.rotation.T @ state.velocity_m_s
    forward, left, up = vehicle_from_base.rotation @ (in_base - skew(arm_m) @ turn_rate_rad_s)
    yaw_rate = float(vehicle_from_base.rotation[2] @ turn_rate_rad_s)
    left += state.axle_m * yaw_rate
    by_error = np.zeros((3, SIZE))
    by_error[:, VELOCITY] = vehicle_from_base.rotation @ state.rotation.T
    by_error[:, ROTATION] = vehicle_from_base.rotation @ skew(in_base)
    by_error[:, GYRO_BIAS] = vehicle_from_base.rotation @ skew(arm_m)
    by_error[1, GYRO_BIAS] -= state.axle_m * vehicle_from_base.rotation[2]
    by_error[1, AXLE] = yaw_rate

    scale, (to_left, to_above) = 1.0 + state.wheel_scale, state.slip_rad
    mixing = np.array([[scale, 0.0, 0.0], [-to_left, 1.0, 0.0], [-to_above, 0.0, 1.0]])
    jacobian = mixing @ by_error
    jacobian[0, WHEEL_SCALE] = forward
    jacobian[1, SLIP.start] = jacobian[2, SLIP.start + 1] = -forward
    measured = np.array([0.0 if speed_mps is None else speed_mps, 0.0, 0.0])
    rows = slice(1 if speed_mps is None else 0, 3)
    residual = measured - mixing @ np.array([forward, left, up])
    return Measurement(residual[rows], jacobian[rows], np.ascontiguousarray(covariance[rows, rows]))


def fix_measurement(
    state: FilterState, antenna_in_base_m: Array, grid: UtmGrid, grid_scale: float, fix: GnssFix
) -> Measurement:
    """A fix of the antenna, in the grid; its covariance comes in true east, north, up."""
    found = grid.from_geodetic(np.array(fix.lat_deg), np.array(fix.lon_deg), np.array(fix.height_m))
    scale = to_grid(grid_scale)
    expected = state.position_m + scale * (state.rotation @ antenna_in_base_m + state.gnss_bias_m)
    jacobian = np.zeros((3, SIZE))
    jacobian[:, POSITION] = np.eye(3)
    jacobian[:, ROTATION] = _by_turn(state, antenna_in_base_m, grid_scale)
    jacobian[:, GNSS_BIAS] = np.diag(scale)
    return Measurement(found - expected, jacobian, np.outer(scale, scale) * fix_covariance_m2(grid, fix))


def fix_covariance_m2(grid: UtmGrid, fix: GnssFix) -> Array:
    """A fix's covariance (3, 3) along the grid's axes, in metres on the ground."""
    turn = grid.grid_from_enu(fix.lat_deg, fix.lon_deg)
    return turn @ fix.covariance_enu_m2 @ turn.T


def to_grid(grid_scale: float) -> Array:
    """What metres on the ground east, north, up (3,) are multiplied by to be the grid's."""
    return np.array([grid_scale, grid_scale, 1.0])


def _by_turn(state: FilterState, arm_m: Array, grid_scale: float) -> Array:
    """How a point (3,) of the base moves in the grid when the base turns."""
    return -to_grid(grid_scale)[:, None] * (state.rotation @ skew(arm_m))
