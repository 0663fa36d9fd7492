"""A pose that no vehicle could have had between its neighbours is told from hard braking and tight bends."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap_mapper.plausible_motion import implausible_images

STAMPS_NS = 1_700_000_000_000_000_000 + np.arange(60, dtype=np.int64) * 100_000_000
ALL = np.ones(60, bool)


def bend(noise_m: float = 0.02) -> np.ndarray:
    """Ten metres a second around a bend of 12 m, with the noise of honest poses: 8 m/s^2 sideways."""
    angle = np.arange(60) * 0.1 * 10.0 / 12.0
    centred = 12.0 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(60)])
    return centred + np.random.default_rng(0).normal(0.0, noise_m, (60, 3))


def test_an_honest_bend_is_plausible():
    assert not implausible_images(STAMPS_NS, bend(), ALL).any()


def test_hard_braking_is_plausible():
    speed = np.maximum(20.0 - 0.1 * 10.0 * np.arange(60), 0.0)
    path = np.column_stack([np.cumsum(0.1 * speed), np.zeros(60), np.zeros(60)])
    assert not implausible_images(STAMPS_NS, path, ALL).any()


@pytest.mark.parametrize("wrong", [[20], [20, 40], [20, 21]])
def test_images_that_jump_are_named_and_no_others(wrong):
    path = bend()
    path[wrong] += np.array([0.4, -0.4, 0.3])
    np.testing.assert_array_equal(np.flatnonzero(implausible_images(STAMPS_NS, path, ALL)), wrong)


def test_a_keyframe_is_part_of_the_map_and_stays():
    path = bend()
    path[20] += 1.0
    may_go = ALL.copy()
    may_go[20] = False
    assert not implausible_images(STAMPS_NS, path, may_go)[20]


def test_across_a_gap_a_vehicle_may_be_anywhere_in_reach():
    stamps_ns = STAMPS_NS.copy()
    stamps_ns[30:] += 2_000_000_000
    path = bend()
    path[30:] += [8.0, -3.0, 0.0]
    assert not implausible_images(stamps_ns, path, ALL).any()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_a_few_images_are_not_judged(count):
    assert not implausible_images(STAMPS_NS[:count], bend()[:count], ALL[:count]).any()
