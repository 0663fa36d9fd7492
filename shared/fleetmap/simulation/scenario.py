"""A drive in a few numbers: which world, which way through it, with what on board."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fleetmap.camera import Camera
from fleetmap.drive import START_NS
from fleetmap.errors import InputError
from fleetmap.geodesy import UtmGrid
from fleetmap.simulation.driving import image_stamps_ns, plan_motion, require_rate, require_speed
from fleetmap.simulation.look import look_of_drive
from fleetmap.simulation.receiver import Receiver
from fleetmap.simulation.simulated_drive import Sensors, SimulatedDrive, require_readout, simulate_drive
from fleetmap.simulation.world import LONGEST_M, World, build_world

KITTI_LIKE = Camera(1241, 376, 718.856, 718.856, 607.1928, 185.2157)
LONGEST_DRIVE_M = 50_000.0

_CIRCUITS = ("city", "facades", "open")
_CIRCUIT_M = 600.0
_SHORTEST_M = {"street": 10.0}
_SHORTEST_WORLD_M = 140.0
_CAMERA_HEIGHTS_M = (0.2, 6.0)
_WIDEST_LANE_M = 10.0
_ONE_DAY_NS, _DAYS = 86_400_000_000_000, 365


@dataclass(frozen=True)
class Scenario:
    """What a simulated drive depends on. Equal scenarios give equal drives, byte for byte."""

    world_seed: int = 1
    kind: str = "city"
    world_length_m: float | None = None  # None: see ``length_of_world_m``
    world_variant: int = 0  # other than 0: a street that could be taken for it
    site: tuple[float, float, float] = (
        48.77,
        11.43,
        420.0,
    )  # latitude, longitude in degrees, ellipsoidal height in m
    drive_seed: int = 1
    length_m: float = 300.0
    start_m: float = 0.0
    lane_m: float = 0.0
    speed_mps: float = 8.0
    rate_hz: float = 10.0
    moving_cars_per_km: float = 0.0
    camera: Camera = KITTI_LIKE
    camera_height_m: float = 1.65
    look: str = "day"
    readout_s: float = 0.0
    gnss: str | None = "rtk"
    gnss_interval_s: float = 1.0
    gnss_gap_s: tuple[float, float] | None = None
    gnss_clock_offset_s: float = 0.0
    gnss_outlier_ratio: float = 0.0
    antenna_in_cam_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sensors: Sensors = field(default_factory=Sensors)

    def length_of_world_m(self) -> float:
        """How long the road is that the world is built around; of one lap, where it is a circuit.

        A circuit has 600 m, and more only where the drive is longer (laps beyond 3.2 km): short drives of one seed
        share a world. An open road is as long as the drive needs.
        """
        if self.world_length_m is not None:
            return self.world_length_m
        if self.kind in _CIRCUITS:
            return float(np.clip(self.length_m, _CIRCUIT_M, LONGEST_M))
        return max(self.start_m + self.length_m, _SHORTEST_M.get(self.kind, _SHORTEST_WORLD_M))


def simulate_scenario(scenario: Scenario) -> SimulatedDrive:
    """Build the world, plan the way through it, and put the sensors on board.

    Raises:
        InputError: something in it makes no sense; the message says what.
    """
    _require_sense(scenario)
    lat_deg, lon_deg, height_m = scenario.site
    world = build_world(
        scenario.world_seed,
        kind=scenario.kind,
        length_m=scenario.length_of_world_m(),
        variant=scenario.world_variant,
        drive_seed=scenario.drive_seed,
        moving_cars_per_km=scenario.moving_cars_per_km,
        own_lane_m=scenario.lane_m,
        own_speed_mps=scenario.speed_mps,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        height_m=height_m,
    )
    motion = plan_motion(
        world,
        lane_offset_m=scenario.lane_m,
        speed_mps=scenario.speed_mps,
        camera_height_m=scenario.camera_height_m,
        start_m=scenario.start_m,
        end_m=_end_m(scenario, world),
        seed=scenario.drive_seed,
        start_ns=START_NS + scenario.drive_seed % _DAYS * _ONE_DAY_NS,
    )
    return simulate_drive(
        world,
        camera=scenario.camera,
        trajectory=motion.trajectory(image_stamps_ns(motion, scenario.rate_hz)),
        motion=motion,
        look=look_of_drive(scenario.look, scenario.drive_seed),
        gnss=scenario.gnss,
        gnss_interval_s=scenario.gnss_interval_s,
        gnss_gap_s=scenario.gnss_gap_s,
        gnss_clock_offset_s=scenario.gnss_clock_offset_s,
        gnss_outlier_ratio=scenario.gnss_outlier_ratio,
        antenna_in_cam_m=scenario.antenna_in_cam_m,
        camera_height_m=scenario.camera_height_m,
        sensors=scenario.sensors,
        readout_s=scenario.readout_s,
        seed=scenario.drive_seed,
    )


def _end_m(scenario: Scenario, world: World) -> float:
    """Where along the path the drive ends: an open road is left at its end."""
    end_m = scenario.start_m + scenario.length_m
    return end_m if world.is_closed else min(end_m, world.length_m)


def _require_sense(scenario: Scenario) -> None:
    """Raise InputError for what would come to light only after the world is built, or not at all."""
    require_speed(scenario.speed_mps)
    require_rate(scenario.rate_hz)
    require_readout(scenario.readout_s)
    UtmGrid.at(*scenario.site[:2])
    if scenario.gnss is not None:
        Receiver(
            scenario.gnss,
            scenario.gnss_interval_s,
            scenario.gnss_gap_s,
            scenario.gnss_clock_offset_s,
            scenario.gnss_outlier_ratio,
        )
    if not 0.0 < scenario.length_m <= LONGEST_DRIVE_M:
        raise InputError(f"a drive of {scenario.length_m:g} m makes no sense; give 1 to {LONGEST_DRIVE_M:.0f} m")
    if not 0.0 <= scenario.start_m <= LONGEST_DRIVE_M:
        raise InputError(f"a drive cannot start at {scenario.start_m:g} m; give 0 to {LONGEST_DRIVE_M:.0f} m")
    if scenario.kind not in _CIRCUITS and scenario.start_m >= scenario.length_of_world_m():
        raise InputError(
            f"a drive cannot start at {scenario.start_m:g} m: the road ends at {scenario.length_of_world_m():g} m"
        )
    if not abs(scenario.lane_m) <= _WIDEST_LANE_M:
        raise InputError(
            f"a lane {scenario.lane_m:g} m to the left is off the road; 0 is the own lane, 3.5 the other one"
        )
    lowest_m, highest_m = _CAMERA_HEIGHTS_M
    if not lowest_m <= scenario.camera_height_m <= highest_m:
        raise InputError(
            f"a camera {scenario.camera_height_m:g} m above the road; give {lowest_m:g} to {highest_m:g}"
        )
    if not 0.0 <= scenario.moving_cars_per_km <= 100.0:
        raise InputError(f"{scenario.moving_cars_per_km:g} moving cars per kilometre; give 0 to 100")
    if not -1000.0 <= scenario.site[2] <= 9000.0:
        raise InputError(f"a site {scenario.site[2]:g} m above the ellipsoid makes no sense; give -1000 to 9000 m")
