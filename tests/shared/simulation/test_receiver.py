"""A receiver reports where its antenna is, where it sees the sky, and by its own clock."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.drive import GnssFix
from fleetmap.errors import InputError
from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import Pose
from fleetmap.simulation.driving import image_stamps_ns, plan_motion
from fleetmap.simulation.receiver import Receiver
from fleetmap.simulation.street import Street
from fleetmap.simulation.world import Scene, World

_ANTENNA = Pose(np.eye(3), np.array([0.3, -0.8, -1.2]))


@pytest.fixture
def world(street: Street) -> World:
    scene = Scene(street.surfaces, street.atlas)
    return World(street.anchor, street.path, street.length_m, False, scene, tunnels_m=((20.0, 30.0),))


def _positions_m(world: World, fixes: list[GnssFix]) -> np.ndarray:
    lat, lon, height = (
        np.array([getattr(fix, name) for fix in fixes]) for name in ("lat_deg", "lon_deg", "height_m")
    )
    return UtmGrid(world.anchor.epsg).from_geodetic(lat, lon, height)


def test_a_clock_that_is_late_shifts_stamps_and_nothing_else(world: World) -> None:
    motion = plan_motion(world, seed=2)
    stamps_ns = image_stamps_ns(motion, 10.0)
    right = Receiver("rtk", 0.2).fixes(world, motion, stamps_ns, _ANTENNA, 5)
    late = Receiver("rtk", 0.2, clock_offset_s=0.12).fixes(world, motion, stamps_ns, _ANTENNA, 5)
    assert [b.stamp_ns - a.stamp_ns for a, b in zip(right, late, strict=True)] == [120_000_000] * len(right)
    np.testing.assert_array_equal(_positions_m(world, right), _positions_m(world, late))


def test_outliers_are_a_share_of_the_fixes_and_leave_the_others_alone(world: World) -> None:
    world = replace(world, tunnels_m=())
    motion = plan_motion(world, seed=2)
    stamps_ns = image_stamps_ns(motion, 10.0)
    right = Receiver("rtk", 0.1).fixes(world, motion, stamps_ns, _ANTENNA, 5)
    wild = Receiver("rtk", 0.1, outlier_ratio=0.2).fixes(world, motion, stamps_ns, _ANTENNA, 5)
    moved_m = np.linalg.norm(_positions_m(world, wild) - _positions_m(world, right), axis=1)
    assert (moved_m > 0.0).sum() == round(0.2 * len(right))
    assert 5.0 - 0.01 < moved_m[moved_m > 0.0].min() < moved_m.max() < 50.0 + 0.1


def test_fixes_between_two_far_apart_images_are_on_the_true_road(world: World) -> None:
    motion = plan_motion(replace(world, tunnels_m=()), seed=2)
    stamps_ns = image_stamps_ns(motion, 0.5)
    fixes = Receiver("rtk", 0.1).fixes(replace(world, tunnels_m=()), motion, stamps_ns, _ANTENNA, 5)
    truth = motion.trajectory(np.array([fix.stamp_ns for fix in fixes]))
    errors_m = _positions_m(world, fixes) - truth.positions_m - truth.rotations @ _ANTENNA.translation_m
    assert len(fixes) > 30
    assert 0.04 < errors_m.std() < 0.06


def test_there_are_no_fixes_in_a_tunnel_and_the_others_stay_the_same(world: World) -> None:
    motion = plan_motion(world, speed_mps=8.0, seed=2)
    stamps_ns = image_stamps_ns(motion, 10.0)
    all_around = Receiver("rtk", 0.1).fixes(replace(world, tunnels_m=()), motion, stamps_ns, _ANTENNA, 5)
    outside = Receiver("rtk", 0.1).fixes(world, motion, stamps_ns, _ANTENNA, 5)
    hidden = {fix.stamp_ns for fix in all_around} - {fix.stamp_ns for fix in outside}
    places_m = 8.0 * (np.array(sorted(hidden)) - motion.start_ns) * 1e-9
    assert 12.0 < places_m.min() < 19.0
    assert 31.0 < places_m.max() < 38.5
    by_stamp = {fix.stamp_ns: fix for fix in all_around}
    assert all(fix.lat_deg == by_stamp[fix.stamp_ns].lat_deg for fix in outside)


@pytest.mark.parametrize(
    ("receiver", "complaint"),
    [
        ({"model": "perfect"}, "no GNSS error model 'perfect'"),
        ({"clock_offset_s": float("nan")}, "clock"),
        ({"clock_offset_s": 3600.0}, "clock"),
        ({"outlier_ratio": -0.2}, "share of 0 to 1"),
    ],
)
def test_a_receiver_that_makes_no_sense_is_refused(receiver: dict[str, object], complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        Receiver(**receiver)  # type: ignore[arg-type]
