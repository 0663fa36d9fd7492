"""How much less sure the motion filter becomes with time: what its errors lose and gain a second."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap_localizer.filter_settings import DeadReckoningSettings, TurningSettings, WheelSettings
from fleetmap_localizer.filter_state import (
    ACCEL_BIAS,
    AXLE,
    GNSS_BIAS,
    GYRO_BIAS,
    ROTATION,
    SIZE,
    SLIP,
    VELOCITY,
    WHEEL_SCALE,
)

Array = NDArray[np.float64]


def inertial_rates(settings: DeadReckoningSettings, gnss_variances_m2: Array) -> tuple[Array, Array]:
    """With an IMU: by how much a second (SIZE,) each error wanes, and what variance (SIZE,) it gains."""
    decays, noises = _slow_rates(settings, gnss_variances_m2)
    imu = settings.imu
    noises[VELOCITY] = imu.accel_noise_m_s2_rthz**2
    noises[ROTATION] = imu.gyro_noise_rad_s_rthz**2
    noises[GYRO_BIAS] = imu.gyro_bias_walk_rad_s2_rthz**2
    noises[ACCEL_BIAS] = imu.accel_bias_walk_m_s3_rthz**2
    return decays, noises


def turning_rates(
    settings: DeadReckoningSettings, gnss_variances_m2: Array, speed_mps: float
) -> tuple[Array, Array]:
    """Without an IMU the same; the turn rate comes back to zero (Gauss-Markov, about the base's axes)."""
    decays, noises = _slow_rates(settings, gnss_variances_m2)
    turning = settings.turning
    sigmas = np.array([*(turning.tilt_rate_sigma_rad_s,) * 2, yaw_rate_sigma_rad_s(turning, speed_mps)])
    decays[GYRO_BIAS] = 1.0 / np.array([turning.tilt_time_s, turning.tilt_time_s, turning.yaw_time_s])
    noises[GYRO_BIAS] = 2.0 * sigmas**2 * decays[GYRO_BIAS]
    noises[VELOCITY] = turning.acceleration_m_s2_rthz**2
    return decays, noises


def yaw_rate_sigma_rad_s(turning: TurningSettings, speed_mps: float) -> float:
    """How fast a vehicle of some speed turns: tyres limit the fast one, steering the slow one."""
    return min(
        turning.lateral_sigma_m_s2 / max(speed_mps, 0.1),
        turning.curvature_sigma_1_m * speed_mps,
    )


def side_covariance(wheel: WheelSettings, speed_mps: float, since_s: float) -> Array:
    """Covariance (3, 3) of a vehicle's velocity forward, left and up as its wheels tell it.

    Errors that stay alike for a time tau, told every ``since_s``, are taken for white ones of the same spectral
    density at low frequencies, 2 sigma^2 tau.
    """
    side_mps = wheel.side_sigma_mps + wheel.side_sigma_share * speed_mps
    sigmas = np.array([wheel.speed_sigma_mps, side_mps, side_mps])
    times_s = np.array([wheel.speed_correlation_s, wheel.side_correlation_s, wheel.side_correlation_s])
    return np.diag(sigmas**2 * np.maximum(2.0 * times_s / since_s, 1.0))


def _slow_rates(settings: DeadReckoningSettings, gnss_variances_m2: Array) -> tuple[Array, Array]:
    decays, noises = np.zeros(SIZE), np.zeros(SIZE)
    noises[WHEEL_SCALE] = settings.wheel.scale_walk_rts**2
    noises[AXLE] = settings.wheel.axle_walk_m_rts**2
    noises[SLIP] = settings.wheel.slip_walk_rad_rts**2
    decays[GNSS_BIAS] = 1.0 / settings.gnss.correlation_s
    noises[GNSS_BIAS] = 2.0 * gnss_variances_m2 / settings.gnss.correlation_s
    return decays, noises
