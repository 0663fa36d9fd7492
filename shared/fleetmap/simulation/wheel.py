"""What a car's wheels say about its speed, and how they err."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fleetmap.drive import WheelSpeed
from fleetmap.geometry import Pose
from fleetmap.simulation.motion import Motion

WHEEL_RATE_HZ = 50.0

_STREAM = 3


@dataclass(frozen=True)
class WheelErrorModel:
    """Wear and pressure of the tyres change their radius; teeth are counted; the bus carries steps.

    Figures: tyre radii differ from the nominal one by up to a per cent over wear and pressure (C. Carlson,
    J. C. Gerdes and J. Powell, "Error sources when land vehicle dead reckoning with differential wheelspeeds",
    Navigation 51(1), 2004); steps of 0.01 km/h are common on vehicle buses.
    """

    scale_sigma: float = 0.005  # share, constant for a drive
    noise_sigma_mps: float = 0.02
    step_mps: float = 0.01 / 3.6


def wheel_speeds(
    motion: Motion,
    cam_from_vehicle: Pose,
    model: WheelErrorModel,
    *,
    rate_hz: float = WHEEL_RATE_HZ,
    seed: int = 0,
) -> Iterator[WheelSpeed]:
    """The speeds over ground of the rear axle's middle, in time order. Equal seeds give equal errors."""
    stamps_ns = motion.stamps_ns(rate_hz)
    speeds = motion.felt_by(cam_from_vehicle, motion.seconds(stamps_ns)).velocity_m_s[:, 0]
    generator = np.random.default_rng([seed, _STREAM])
    speeds = speeds * (1.0 + model.scale_sigma * generator.standard_normal())
    speeds += model.noise_sigma_mps * generator.standard_normal(len(speeds))
    if model.step_mps > 0.0:
        speeds = model.step_mps * np.rint(speeds / model.step_mps)
    return map(WheelSpeed, stamps_ns.tolist(), speeds.tolist())
