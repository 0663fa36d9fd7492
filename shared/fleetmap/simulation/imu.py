"""What an inertial measurement unit measures of a motion, and how it errs.

========== ================== ==================== ================== ==================== ====== =============
model      gyroscope noise    its bias walk        accelerometer      its bias walk        scale  misalignment
========== ================== ==================== ================== ==================== ====== =============
consumer   1.2e-4 rad/s/rtHz  1.9e-5 rad/s2/rtHz   1.8e-3 m/s2/rtHz   3.0e-3 m/s3/rtHz     1.5 %  10 mrad
industrial 1.7e-4 rad/s/rtHz  1.9e-5 rad/s2/rtHz   2.0e-3 m/s2/rtHz   3.0e-3 m/s3/rtHz     0.5 %  1 mrad
========== ================== ==================== ================== ==================== ====== =============

Sources. The model: O. Woodman, "An introduction to inertial navigation", UCAM-CL-TR-696, 2007, sections 3.2 and 4;
IEEE Std 952; in the form and the units of Kalibr ("IMU Noise Model"), with the constant bias after switching on,
the scale errors and the misalignment of J. Rehder et al., "Extending kalibr", ICRA 2016. Figures: consumer, the
data sheet of Bosch's BMI160, whose tolerances are read as two sigma; it names no bias walk. industrial, and all
bias walks: the ADIS16448 as the EuRoC data set publishes it (M. Burri et al., IJRR 2016) and its data sheet.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.drive import ImuSample
from fleetmap.geodesy import UtmAnchor, UtmGrid, normal_gravity_m_s2
from fleetmap.geometry import Pose
from fleetmap.simulation.motion import Motion

Array = NDArray[np.float64]

IMU_RATE_HZ = 200.0

_GYROSCOPE_STREAM, _ACCELEROMETER_STREAM = 1, 2


@dataclass(frozen=True)
class TriadErrorModel:
    """How three perpendicular sensors of one kind err; units are those of what they measure, per sqrt(Hz)."""

    noise_density: float  # white, per sqrt(Hz)
    bias_walk: float  # per second and sqrt(Hz)
    bias_sigma: float  # constant after switching on
    scale_sigma: float  # share
    misalignment_sigma: float  # share of one axis' value that another axis sees (rad)

    def measured(self, true: Array, rate_hz: float, generator: np.random.Generator) -> Array:
        """What the triad reports of true values (N, 3) that come at an even rate."""
        skew = self.misalignment_sigma * generator.standard_normal((3, 3))
        np.fill_diagonal(skew, self.scale_sigma * generator.standard_normal(3))
        turn_on = self.bias_sigma * generator.standard_normal(3)
        white = self.noise_density * np.sqrt(rate_hz) * generator.standard_normal(true.shape)
        steps = self.bias_walk / np.sqrt(rate_hz) * generator.standard_normal(true.shape)
        return np.asarray(true @ (np.eye(3) + skew).T + turn_on + np.cumsum(steps, axis=0) + white)


@dataclass(frozen=True)
class ImuErrorModel:
    """A gyroscope in rad/s and an accelerometer in m/s2."""

    gyroscope: TriadErrorModel
    accelerometer: TriadErrorModel


IMU_ERROR_MODELS = {
    "consumer": ImuErrorModel(
        TriadErrorModel(float(np.radians(0.007)), 1.9393e-5, float(np.radians(1.5)), 0.015, 0.01),
        TriadErrorModel(180e-6 * 9.80665, 3.0e-3, 20e-3 * 9.80665, 0.0025, 0.005),
    ),
    "industrial": ImuErrorModel(
        TriadErrorModel(1.6968e-4, 1.9393e-5, float(np.radians(0.5)), 0.005, 1e-3),
        TriadErrorModel(2.0e-3, 3.0e-3, 20e-3 * 9.80665, 0.005, 1e-3),
    ),
}


def imu_samples(
    motion: Motion, cam_from_imu: Pose, model: ImuErrorModel, *, rate_hz: float = IMU_RATE_HZ, seed: int = 0
) -> Iterator[ImuSample]:
    """The measurements of a drive in time order, in the frame of the IMU. Equal seeds give equal errors."""
    stamps_ns = motion.stamps_ns(rate_hz)
    felt = motion.felt_by(cam_from_imu, motion.seconds(stamps_ns))
    specific_force = felt.acceleration_m_s2 + gravity_m_s2(motion.anchor) * felt.up
    gyroscope, accelerometer = (
        np.random.default_rng([seed, stream]) for stream in (_GYROSCOPE_STREAM, _ACCELEROMETER_STREAM)
    )
    turns = model.gyroscope.measured(felt.angular_velocity_rad_s, rate_hz, gyroscope)
    forces = model.accelerometer.measured(specific_force, rate_hz, accelerometer)
    return map(ImuSample, stamps_ns.tolist(), turns, forces)


def gravity_m_s2(anchor: UtmAnchor) -> float:
    """Normal gravity at a site."""
    lat_deg, _, height_m = UtmGrid(anchor.epsg).to_geodetic(anchor.offset_m)
    return normal_gravity_m_s2(float(lat_deg), float(height_m))
