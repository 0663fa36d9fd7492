"""Cars: those that park along the kerbs on one day, and those that move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fleetmap.simulation import furniture
from fleetmap.simulation.palette import Palette
from fleetmap.simulation.path import Line
from fleetmap.simulation.plot import Kerb, under_roof
from fleetmap.simulation.roads import LANE_M
from fleetmap.simulation.surfaces import SurfaceBuilder, Surfaces, brightness_in, normals_of
from fleetmap.simulation.vehicles import park_car

Array = NDArray[np.float64]
Rng = np.random.Generator

CAR_PAINTS = 15
_SLOT_M, _OCCUPIED = 5.9, 0.55
_STREAMS = {"slot": 1, "change": 2, "new": 3, "traffic": 4}
_TABLE_STEP_M = 0.5


def park_cars(
    builder: SurfaceBuilder, palette: Palette, kerbs: Sequence[Kerb], seed: int, drive_seed: int, changed: float
) -> None:
    """Cars on the places of a drive's day: most as on every day, some others.

    Any two drives differ in a share of ``changed`` of the cars of either: 1 - (1 - p)^2 when each place is taken
    anew on a day with probability p.
    """
    paints = [palette.car(number) for number in range(CAR_PAINTS)]
    anew = 1.0 - np.sqrt(1.0 - changed)
    number = 0
    for kerb in kerbs:
        for s in np.arange(kerb.span_m[0] + _SLOT_M / 2.0, kerb.span_m[1] - _SLOT_M / 2.0, _SLOT_M):
            number += 1
            rng = np.random.default_rng([_STREAMS["slot"], seed, number])
            if np.random.default_rng([_STREAMS["change"], seed, number, drive_seed]).random() < anew:
                rng = np.random.default_rng([_STREAMS["new"], seed, number, drive_seed])
            if rng.random() < _OCCUPIED:
                where = float(s + rng.uniform(-0.2, 0.2))
                furniture.park_beside(rng, builder, paints, kerb.line, where, kerb.left_m)


class LaneLine(Line, Protocol):
    """A road whose lanes traffic follows."""

    def up(self, s_m: Array | float) -> Array:
        """Unit normals (..., 3) of the road."""


@dataclass(frozen=True)
class Lane:
    """A lane's distance along it against the path's s, so that cars keep their speed in bends and on hills."""

    left_m: float
    s_m: Array  # (K,)
    travelled_m: Array  # (K,)
    repeats: bool  # a circuit: s and the distance go on from lap to lap

    def s_at(self, travelled_m: Array) -> Array:
        """s (...) where a car is after a distance (...); on an open road it then starts again."""
        whole = self.travelled_m[-1]
        laps = np.floor(travelled_m / whole)
        s = np.interp(travelled_m - laps * whole, self.travelled_m, self.s_m)
        return np.asarray(s + laps * (self.s_m[-1] - self.s_m[0]) if self.repeats else s)


@dataclass(frozen=True)
class Traffic:
    """Moving cars, whose places are functions of time alone."""

    line: LaneLine
    lanes: tuple[Lane, ...]  # (C,) of each car
    starts_m: Array  # (C,) where each is in its lane at first
    speeds_mps: Array  # (C,) along the path; negative: against it
    cars: Surfaces  # each in the frame of its car: x forward, y left, z up
    car_numbers: NDArray[np.int64]  # (Q,) of each surface
    normals_in_car: Array  # (Q, 3)
    sun_in_map: Array  # (3,)
    tunnels_m: tuple[tuple[float, float], ...]

    def surfaces_at(self, seconds: float) -> Surfaces:
        """All moving cars, in the map frame."""
        travelled = self.starts_m + self.speeds_mps * seconds
        s = np.array([lane.s_at(d) for lane, d in zip(self.lanes, travelled, strict=True)])
        left = np.array([lane.left_m for lane in self.lanes])
        heading = self.line.heading_rad(s) + np.where(self.speeds_mps < 0.0, np.pi, 0.0)
        up = self.line.up(s)
        left_in_map = np.cross(up, np.stack([np.cos(heading), np.sin(heading), 0.0 * heading], axis=1))
        left_in_map /= np.linalg.norm(left_in_map, axis=1, keepdims=True)
        rotations = np.stack([np.cross(left_in_map, up), left_in_map, up], axis=2)[self.car_numbers]
        normals = np.einsum("qij,qj->qi", rotations, self.normals_in_car)
        brightness = brightness_in(self.sun_in_map, normals, self.cars.two_sided)
        brightness *= under_roof(s, self.tunnels_m)[self.car_numbers]
        return self.cars.posed(rotations, self.line.at(s, left)[self.car_numbers], brightness)


def send_traffic(
    rng: Rng,
    builder: SurfaceBuilder,
    palette: Palette,
    line: LaneLine,
    stretch_m: tuple[float, float],
    *,
    is_closed: bool,
    cars_per_km: float,
    own_lane_m: float,
    own_speed_mps: float,
    tunnels_m: tuple[tuple[float, float], ...] = (),
) -> Traffic | None:
    """Cars that come towards the recording vehicle in the other lane, and one that drives ahead of it.

    The one ahead keeps the recording vehicle's speed, nearer where traffic is denser; from 60 cars a kilometre on
    it is a van, whose rear is 6 m away and less. None when nothing moves.
    """
    oncoming = round(cars_per_km * (stretch_m[1] - stretch_m[0]) / 1000.0)
    if cars_per_km <= 0.0:
        return None
    own = _measure_lane(line, stretch_m, own_lane_m, is_closed)
    other = _measure_lane(line, stretch_m, LANE_M if own_lane_m <= LANE_M / 2.0 else 0.0, is_closed)
    ahead_m = float(np.interp(cars_per_km, [0.0, 60.0, 120.0], [24.0, 9.0, 7.0]))
    begin = float(np.interp(0.0, own.s_m, own.travelled_m))
    places = (np.arange(oncoming) + rng.uniform(0.1, 0.9, oncoming)) * other.travelled_m[-1] / max(oncoming, 1)
    numbers = [4 if cars_per_km >= 60.0 else 0, *rng.integers(0, CAR_PAINTS, oncoming).tolist()]
    parts, owners = [], []
    for car, number in enumerate(numbers):
        own_frame = SurfaceBuilder(builder.sun_in_map)
        park_car(own_frame, palette.car(number), np.eye(3), np.zeros(3), float(rng.uniform(0.95, 1.05)))
        parts.append(own_frame.surfaces())
        owners += [car] * len(parts[-1])
    cars = parts[0]
    for part in parts[1:]:
        cars = cars.joined(part)
    return Traffic(
        line,
        (own, *([other] * oncoming)),
        np.concatenate([[begin + ahead_m], places]),
        np.array([own_speed_mps, *([-float(rng.uniform(7.0, 12.0))] * oncoming)]),
        cars,
        np.array(owners),
        normals_of(cars.corners_in_map),
        builder.sun_in_map,
        tunnels_m,
    )


def _measure_lane(line: LaneLine, stretch_m: tuple[float, float], left_m: float, repeats: bool) -> Lane:
    s = np.linspace(*stretch_m, int(np.ceil((stretch_m[1] - stretch_m[0]) / _TABLE_STEP_M)) + 1)
    steps = np.linalg.norm(np.diff(line.at(s, left_m), axis=0), axis=1)
    return Lane(left_m, s, np.concatenate([[0.0], np.cumsum(steps)]), repeats)
