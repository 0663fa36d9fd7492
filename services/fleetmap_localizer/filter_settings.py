"""What the motion filter assumes of vehicles and their sensors. Nothing here is tuned on a recording."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

_DEG = float(np.radians(1.0))


@dataclass(frozen=True)
class ImuSettings:
    """How an inertial measurement unit errs: at least as much as the MEMS units that vehicles carry.

    Densities are three times the data sheets' (Bosch BMI160, Analog Devices ADIS16448), for what vibration adds.
    """

    gyro_noise_rad_s_rthz: float = 5.0e-4
    gyro_bias_walk_rad_s2_rthz: float = 3.0e-5
    gyro_bias_sigma_rad_s: float = 2.0 * _DEG  # constant after switching on
    gyro_mixing_sigma: float = 0.015  # scale errors, and how much of one axis another axis sees
    accel_noise_m_s2_rthz: float = 6.0e-3
    accel_bias_walk_m_s3_rthz: float = 3.0e-3
    accel_bias_sigma_m_s2: float = 0.3  # 30 mg; with what a tilted mounting adds
    longest_pause_s: float = 0.1  # between samples; nothing is known of the motion across a longer one


@dataclass(frozen=True)
class WheelSettings:
    """How wheel speeds err, and how far a vehicle rolls where its wheels point."""

    scale_sigma: float = 0.02  # wear and pressure of tyres
    scale_walk_rts: float = 5.0e-4  # per root of a second: warming up, load
    speed_sigma_mps: float = 0.05  # steps of the bus, teeth
    speed_correlation_s: float = 0.1
    least_interval_s: float = 0.04  # of more speeds than that, some are left out: their errors are alike anyway
    # Across the wheels: what springs and ruts do, a constant and a share of the speed. Neighbouring errors are
    # alike for the given time, so that fifty of them a second do not count as fifty.
    side_sigma_mps: float = 0.03
    side_sigma_share: float = 0.006
    side_correlation_s: float = 1.0
    slip_sigma_rad: float = 2.0 * _DEG  # the course against the vehicle's x axis: mounting, tyres
    slip_sigma_unknown_rad: float = 10.0 * _DEG  # where the recording does not say how the camera looks
    slip_walk_rad_rts: float = 0.1 * _DEG
    # Where the rolling axle is, ahead of the vehicle's frame, which may be at the centre of mass or anywhere; the
    # tyres' slip in bends moves it too, by some centimetres for each m2/s2 of speed squared.
    axle_sigma_m: float = 1.5
    axle_walk_m_rts: float = 0.05


@dataclass(frozen=True)
class TurningSettings:
    """How vehicles move when no IMU tells: speed and turn rate stay, but for what drivers and roads do."""

    acceleration_m_s2_rthz: float = 3.0  # 1.5 m/s2, held for 2 s
    lateral_sigma_m_s2: float = 1.0  # turn rate = lateral acceleration / speed, ...
    curvature_sigma_1_m: float = 0.06  # ... but no more than the steering allows
    yaw_time_s: float = 2.0  # after which a turn is likely over
    tilt_rate_sigma_rad_s: float = 0.03
    tilt_time_s: float = 0.5
    longest_step_s: float = 0.05


@dataclass(frozen=True)
class GnssSettings:
    """How fixes err: what a receiver reports as its sigma wanders slowly, and as much again is new each time."""

    correlation_s: float = 100.0
    side_speed_mps: float = 3.0  # what is faster rolls where it points, and its heading shows in its course


@dataclass(frozen=True)
class DeadReckoningSettings:
    """All groups, and when a prediction is worth telling."""

    imu: ImuSettings = field(default_factory=ImuSettings)
    wheel: WheelSettings = field(default_factory=WheelSettings)
    turning: TurningSettings = field(default_factory=TurningSettings)
    gnss: GnssSettings = field(default_factory=GnssSettings)
    # Of a measured pose's variance, the share that neighbouring poses have in common, such as the map's own
    # error: no number of poses averages it away.
    common_share: float = 0.5
    common_time_s: float = 5.0  # after which a vehicle is on another part of the map
    gate_probability: float = 0.9999  # of a measurement that the filter expects
    patience: int = 3  # measured poses in a row that contradict the filter before it gives in
    longest_start_s: float = 1.0  # between the two poses it starts from
    start_acceleration_m_s2: float = 3.0  # between them
    start_angular_acceleration_rad_s2: float = 0.5
    fastest_mps: float = 80.0
    longest_silence_s: float = 2.0  # without IMU: since a wheel or a fix was last heard
    max_position_sigma_m: float = 10.0  # along the worst axis; beyond, nothing is told
    max_rotation_sigma_deg: float = 10.0
