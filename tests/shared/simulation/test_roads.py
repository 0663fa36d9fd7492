"""Circuits close, bend as cars can, climb, and are as long as asked for."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.simulation.blocks import lay_circuit
from fleetmap.simulation.roads import RoadPath, open_path


@pytest.fixture(params=[(1, 150.0), (2, 300.0), (3, 1500.0)], ids=["150 m", "300 m", "1500 m"])
def circuit(request: pytest.FixtureRequest) -> RoadPath:
    seed, length_m = request.param
    path, _ = lay_circuit(np.random.default_rng(seed), length_m, 0.08)
    assert path.length_m == pytest.approx(length_m, abs=1e-6)
    return path


def test_a_circuit_closes_in_place_height_heading_and_their_growth(circuit: RoadPath) -> None:
    lap, step = circuit.length_m, 1e-3
    for s in (0.0, 0.3 * lap):
        np.testing.assert_allclose(circuit.at(s + lap, 1.2), circuit.at(s, 1.2), atol=1e-6)
        whole_turns = (circuit.heading_rad(s + 2.0 * lap) - circuit.heading_rad(s)) / (2.0 * np.pi)
        assert whole_turns == pytest.approx(2.0 * circuit.turns, abs=1e-9)
        np.testing.assert_allclose(circuit.up(s + lap), circuit.up(s), atol=1e-9)
    before, after = circuit.at(lap - step), circuit.at(lap + step)
    np.testing.assert_allclose((before + after) / 2.0, circuit.at(0.0), atol=1e-6)
    assert abs(circuit.turns) == 1


def test_a_circuit_runs_where_it_heads_and_s_is_its_length(circuit: RoadPath) -> None:
    s = np.linspace(0.0, circuit.length_m, 20001)
    steps = np.diff(circuit.at(s)[:, :2], axis=0)
    heading = circuit.heading_rad((s[1:] + s[:-1]) / 2.0)
    sideways = steps[:, 1] * np.cos(heading) - steps[:, 0] * np.sin(heading)
    assert np.abs(sideways).max() < 1e-4 * (s[1] - s[0])
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), s[1] - s[0], rtol=1e-4)


def test_bends_are_tight_and_slopes_steep_but_drivable(circuit: RoadPath) -> None:
    s = np.linspace(0.0, circuit.length_m, 8001)
    curvature = np.diff(circuit.heading_rad(s)) / (s[1] - s[0])
    assert 1.0 / 12.0 < np.abs(curvature).max() < 1.0 / 7.9
    positions = circuit.at(s)
    slope = np.diff(positions[:, 2]) / (s[1] - s[0])
    assert 0.01 < np.abs(slope).max() < 0.09
    tangents = np.diff(positions, axis=0) / (s[1] - s[0])
    assert np.abs(np.einsum("ni,ni->n", tangents, circuit.up(s[1:]))).max() < 1e-3


def test_the_other_lane_is_beside_on_the_same_ground(circuit: RoadPath) -> None:
    s = np.linspace(0.0, circuit.length_m, 500)
    apart = circuit.at(s, 3.5) - circuit.at(s)
    np.testing.assert_allclose(np.linalg.norm(apart[:, :2], axis=1), 3.5, atol=1e-9)
    assert np.abs(np.einsum("ni,ni->n", apart, circuit.up(s))).max() < 0.02
    heading = circuit.heading_rad(s)
    assert (apart[:, 1] * np.cos(heading) - apart[:, 0] * np.sin(heading) > 3.49).all()


def test_long_circuits_bend_to_both_sides() -> None:
    path, _ = lay_circuit(np.random.default_rng(5), 1200.0, 0.08)
    turned = np.diff(path.heading_rad(np.linspace(0.0, path.length_m, 3000)))
    assert turned.min() < -0.01
    assert turned.max() > 0.01


def test_an_open_road_goes_straight_on_beyond_its_ends() -> None:
    terrain = lay_circuit(np.random.default_rng(1), 200.0, 0.08)[0].terrain
    road = open_path(terrain, 100.0)
    s = np.array([-20.0, 0.0, 50.0, 100.0, 130.0])
    steps = np.diff(road.at(s)[:, :2], axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), np.diff(s), rtol=1e-9)
    assert np.ptp(np.arctan2(steps[:, 1], steps[:, 0])) < 1e-9
