"""Parked cars change from drive to drive as told; moving cars keep to their lanes, their speeds and the ground."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.simulation.blocks import lay_circuit
from fleetmap.simulation.palette import Palette
from fleetmap.simulation.plot import GridLine, Kerb
from fleetmap.simulation.roads import RoadPath
from fleetmap.simulation.surfaces import SurfaceBuilder, Surfaces
from fleetmap.simulation.traffic import Traffic, park_cars, send_traffic

UP = np.array([0.0, 0.0, 1.0])
SURFACES_OF_A_CAR = 10
SPEED_MPS = 8.0


@pytest.fixture(scope="module")
def circuit() -> RoadPath:
    return lay_circuit(np.random.default_rng(4), 300.0, 0.06)[0]


def _parked(circuit: RoadPath, drive_seed: int, changed: float) -> set[bytes]:
    builder = SurfaceBuilder(UP)
    kerb = Kerb(GridLine(circuit.terrain, (0.0, 0.0), along_v=False), 5.0, (0.0, 6000.0))
    park_cars(builder, Palette(1, builder), [kerb], 1, drive_seed, changed)
    corners = builder.surfaces().corners_in_map
    return {car.tobytes() for car in corners.reshape(-1, SURFACES_OF_A_CAR, 4, 3)}


@pytest.mark.parametrize(("changed", "low", "high"), [(0.0, 0.0, 0.0), (0.3, 0.24, 0.36), (1.0, 1.0, 1.0)])
def test_any_two_drives_differ_in_a_share_of_the_parked_cars(
    circuit: RoadPath, changed: float, low: float, high: float
) -> None:
    first, second, third = (_parked(circuit, drive, changed) for drive in (0, 1, 2))
    assert 400 < len(first) < 700
    for one, other in ((first, second), (second, third)):
        assert low <= 1.0 - len(one & other) / len(one) <= high
    assert first == _parked(circuit, 0, changed)


def _traffic(circuit: RoadPath, own_lane_m: float = 0.0, cars_per_km: float = 20.0) -> Traffic:
    builder = SurfaceBuilder(UP)
    traffic = send_traffic(
        np.random.default_rng(1),
        builder,
        Palette(1, builder),
        circuit,
        (0.0, circuit.length_m),
        is_closed=True,
        cars_per_km=cars_per_km,
        own_lane_m=own_lane_m,
        own_speed_mps=SPEED_MPS,
    )
    assert traffic is not None
    return traffic


def _middles(surfaces: Surfaces) -> NDArray[np.float64]:
    return surfaces.corners_in_map.reshape(-1, 4 * SURFACES_OF_A_CAR, 3).mean(axis=1)


def _place(circuit: RoadPath, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """s and offset to the left (N,) of map points (N, 3), to a few centimetres."""
    s = np.arange(0.0, circuit.length_m, 0.05)
    line = circuit.at(s)
    nearest = np.array([np.linalg.norm(line[:, :2] - point[:2], axis=1).argmin() for point in points])
    heading, aside = circuit.heading_rad(s[nearest]), points - line[nearest]
    return s[nearest], aside[:, 1] * np.cos(heading) - aside[:, 0] * np.sin(heading)


@pytest.mark.parametrize(("own_lane_m", "other_lane_m"), [(0.0, 3.5), (3.5, 0.0)])
def test_oncoming_cars_keep_out_of_the_own_lane_and_one_drives_ahead(
    circuit: RoadPath, own_lane_m: float, other_lane_m: float
) -> None:
    traffic = _traffic(circuit, own_lane_m)
    for seconds in (0.0, 7.0, 61.0):
        left_m = _place(circuit, _middles(traffic.surfaces_at(seconds)))[1]
        assert len(left_m) == 7  # 300 m of 20 oncoming cars a kilometre, and the one ahead
        assert left_m[0] == pytest.approx(own_lane_m, abs=0.3)  # a car's middle cuts a bend a little
        np.testing.assert_allclose(left_m[1:], other_lane_m, atol=0.3)


def test_cars_keep_their_speed_and_the_one_ahead_its_distance_for_many_laps(circuit: RoadPath) -> None:
    traffic = _traffic(circuit)
    before, after = (_middles(traffic.surfaces_at(t)) for t in (3.0, 3.1))
    speeds = np.linalg.norm(after - before, axis=1) / 0.1
    assert speeds[0] == pytest.approx(SPEED_MPS, rel=0.08)
    assert ((speeds[1:] > 6.0) & (speeds[1:] < 13.5)).all()
    lane = traffic.lanes[0]
    for laps in (1, 10):
        seconds = laps * lane.travelled_m[-1] / SPEED_MPS
        np.testing.assert_allclose(
            _middles(traffic.surfaces_at(seconds))[0], _middles(traffic.surfaces_at(0.0))[0], atol=1e-6
        )
    ahead_m = _place(circuit, _middles(traffic.surfaces_at(0.0))[:1])[0]
    assert 10.0 < ahead_m < 30.0


def test_cars_stand_on_the_ground_facing_where_they_go(circuit: RoadPath) -> None:
    traffic = _traffic(circuit)
    now, later = traffic.surfaces_at(5.0), traffic.surfaces_at(5.05)
    feet = now.corners_in_map.reshape(-1, SURFACES_OF_A_CAR, 4, 3)[:, :4, 2:].mean(axis=(1, 2))
    s, left = _place(circuit, feet)
    np.testing.assert_allclose(feet[:, 2] - circuit.at(s, left)[:, 2], 0.02, atol=0.03)
    heading = circuit.heading_rad(s) + np.where(traffic.speeds_mps < 0.0, np.pi, 0.0)
    moved = _middles(later) - _middles(now)
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    assert (moved[:, 0] * np.cos(heading) + moved[:, 1] * np.sin(heading) > 0.95).all()


def test_without_moving_cars_there_is_no_traffic(circuit: RoadPath) -> None:
    builder = SurfaceBuilder(UP)
    arguments = {"is_closed": True, "cars_per_km": 0.0, "own_lane_m": 0.0, "own_speed_mps": 8.0}
    palette = Palette(1, builder)
    assert send_traffic(np.random.default_rng(1), builder, palette, circuit, (0.0, 300.0), **arguments) is None
