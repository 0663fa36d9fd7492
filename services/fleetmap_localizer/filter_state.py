"""What the motion filter knows: a nominal state, and the covariance of its small error.

``base`` is where the filter lives: the IMU, or without one the vehicle's own frame. The error state is
J. Solà, "Quaternion kinematics for the error-state Kalman filter", 2017 (arXiv:1711.02508), table 3, with the
angular error in the base's frame, and more biases: of the gyroscope's axes, the wheels,
their course, the receiver.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap_localizer.filter_process import rotation_of

Array = NDArray[np.float64]

# Where each error stands in the error state.
POSITION, VELOCITY, ROTATION = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_BIAS, ACCEL_BIAS, GYRO_MIXING = slice(9, 12), slice(12, 15), slice(15, 24)
WHEEL_SCALE, SLIP, AXLE, GNSS_BIAS = slice(24, 25), slice(25, 27), slice(27, 28), slice(28, 31)
SIZE = 31


@dataclass(frozen=True)
class FilterState:
    """Nominal state and covariance of its error."""

    position_m: Array  # (3,) of the base: easting, northing (grid metres), ellipsoidal height
    velocity_m_s: Array  # (3,) along the grid's axes, in metres on the ground
    rotation: Array  # (3, 3) utm_from_base
    gyro_bias_rad_s: Array  # (3,); without an IMU: minus the turn rate
    accel_bias_m_s2: Array  # (3,)
    gyro_mixing: Array  # (3, 3) measured = (1 + mixing) true + bias, to first order
    wheel_scale: float  # measured = (1 + scale) true
    slip_rad: Array  # (2,) the course's angle to the left of and above the vehicle's x axis
    axle_m: float  # how far ahead of the vehicle's frame the point is that does not slide aside in bends
    gnss_bias_m: Array  # (3,) along the grid's axes, in metres on the ground
    covariance: Array  # (SIZE, SIZE) of the error state

    def carried(self, position_m: Array, velocity_m_s: Array, rotation: Array, covariance: Array) -> FilterState:
        """The state after a motion."""
        return FilterState(
            position_m, velocity_m_s, rotation, self.gyro_bias_rad_s, self.accel_bias_m_s2, self.gyro_mixing,
            self.wheel_scale, self.slip_rad, self.axle_m, self.gnss_bias_m, covariance,
        )  # fmt: skip

    def injected(self, error: Array, covariance: Array) -> FilterState:
        """The state after its error (SIZE,) has been observed; the covariance is that after the reset.

        Source: Solà, eq. 282 and 283.
        """
        return FilterState(
            position_m=self.position_m + error[POSITION],
            velocity_m_s=self.velocity_m_s + error[VELOCITY],
            rotation=self.rotation @ rotation_of(error[ROTATION]),
            gyro_bias_rad_s=self.gyro_bias_rad_s + error[GYRO_BIAS],
            accel_bias_m_s2=self.accel_bias_m_s2 + error[ACCEL_BIAS],
            gyro_mixing=self.gyro_mixing + error[GYRO_MIXING].reshape(3, 3),
            wheel_scale=self.wheel_scale + float(error[WHEEL_SCALE][0]),
            slip_rad=self.slip_rad + error[SLIP],
            axle_m=self.axle_m + float(error[AXLE][0]),
            gnss_bias_m=self.gnss_bias_m + error[GNSS_BIAS],
            covariance=covariance,
        )

    def with_more_pose_uncertainty(self, covariance: Array, to_tangent: Array) -> FilterState:
        """The state when its pose is less sure by a covariance (6, 6) in a tangent that errors go to.

        ``to_tangent`` (6, SIZE) is the tangent's derivative by the error state, such as ``camera_jacobian`` gives.
        """
        pose = np.r_[POSITION, ROTATION]
        from_tangent = np.linalg.inv(to_tangent[:, pose])
        wider = self.covariance.copy()
        wider[np.ix_(pose, pose)] += from_tangent @ covariance @ from_tangent.T
        return replace(self, covariance=wider)
