"""What a scenario decides by itself: how long its world is, where the drive ends, which day it is."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fleetmap.camera import Camera
from fleetmap.drive import START_NS
from fleetmap.simulation.scenario import Scenario, simulate_scenario

_TINY = Camera(8, 8, 6.0, 6.0, 3.5, 3.5)


@pytest.mark.parametrize(
    ("scenario", "length_m"),
    [
        (Scenario(length_m=100.0), 600.0),
        (Scenario(length_m=600.0, start_m=300.0), 600.0),
        (Scenario(length_m=900.0), 900.0),
        (Scenario(length_m=20_000.0), 3200.0),
        (Scenario(length_m=100.0, world_length_m=250.0), 250.0),
        (Scenario(kind="tunnel", length_m=400.0, start_m=50.0), 450.0),
        (Scenario(kind="straight", length_m=30.0), 140.0),
        (Scenario(kind="street", length_m=30.0), 30.0),
    ],
)
def test_short_drives_share_a_circuit_and_open_roads_are_as_long_as_needed(
    scenario: Scenario, length_m: float
) -> None:
    assert scenario.length_of_world_m() == length_m


def test_a_drive_leaves_an_open_road_at_its_end_and_goes_on_around_a_circuit() -> None:
    road = Scenario(kind="straight", world_length_m=150.0, start_m=100.0, length_m=200.0, camera=_TINY, gnss=None)
    assert simulate_scenario(road).motion.duration_s == pytest.approx(50.0 / 8.0, rel=0.02)
    circuit = simulate_scenario(replace(road, kind="open"))
    assert circuit.world.is_closed
    assert circuit.motion.duration_s > 200.0 / 8.0


def test_a_tunnel_hides_the_sky_and_each_drive_has_its_own_day() -> None:
    scenario = Scenario(kind="tunnel", length_m=200.0, drive_seed=3, gnss_interval_s=0.2, camera=_TINY)
    drive = simulate_scenario(scenario)
    assert drive.motion.start_ns == START_NS + 3 * 86_400_000_000_000
    ((start_m, end_m),) = drive.world.tunnels_m
    places_m = [8.0 * (fix.stamp_ns - drive.motion.start_ns) * 1e-9 for fix in drive.gnss_fixes()]
    assert sum(place < start_m for place in places_m) > 10
    assert sum(place > end_m for place in places_m) > 10
    assert not [place for place in places_m if start_m < place < end_m]
