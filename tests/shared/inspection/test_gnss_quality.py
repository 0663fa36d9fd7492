"""What fixes are worth, on tracks whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.inspection.gnss_quality import GnssTrack, measure_gnss, spaced

SECOND_NS = 1_000_000_000


def straight(*, rate_hz=10.0, seconds=60.0, speed_mps=8.0, sigma_m=0.05, noise_m=0.0, stands_s=0.0):
    times_s = np.arange(0.0, seconds, 1.0 / rate_hz)
    way = speed_mps * np.maximum(times_s - stands_s, 0.0)
    positions = np.column_stack([0.6 * way, 0.8 * way, np.zeros(len(way))])
    positions[:, :2] += np.random.default_rng(0).normal(0.0, noise_m, (len(way), 2))
    return GnssTrack((times_s * 1e9).astype(np.int64), positions, np.full(len(way), sigma_m))


@pytest.mark.parametrize(("sigma_m", "kind"), [(0.02, "RTK"), (0.3, "float or differential"), (1.5, "single")])
def test_the_reported_sigma_tells_the_kind_of_receiver(sigma_m, kind):
    assert measure_gnss(straight(sigma_m=sigma_m), np.zeros(0, np.int64)).kind == kind


@pytest.mark.parametrize("noise_m", [0.03, 0.3])
def test_dense_fixes_show_their_noise(noise_m):
    quality = measure_gnss(straight(noise_m=noise_m), np.zeros(0, np.int64))
    assert quality.scatter_m == pytest.approx(noise_m, rel=0.15)


def test_sparse_fixes_do_not_show_their_noise():
    assert measure_gnss(straight(rate_hz=1.0, noise_m=0.3), np.zeros(0, np.int64)).scatter_m is None


def test_jumps_are_found_and_only_they():
    track = straight(noise_m=0.05)
    assert measure_gnss(track, np.zeros(0, np.int64)).jump_count == 0
    track.positions_m[[100, 300], 0] += 3.0
    quality = measure_gnss(track, np.zeros(0, np.int64))
    assert 2 <= quality.jump_count <= 6  # neighbours of a wild fix look wild as well
    assert quality.largest_jump_m == pytest.approx(3.0, abs=0.3)


def test_a_hard_turn_is_no_jump():
    times_s = np.arange(0.0, 20.0, 1.0)
    angle = 0.6 * times_s  # 8 m/s on a radius of 13 m: 4.8 m/s^2
    positions = np.column_stack([13.3 * np.cos(angle), 13.3 * np.sin(angle), np.zeros(20)])
    track = GnssTrack((times_s * 1e9).astype(np.int64), positions, np.full(20, 0.05))
    assert measure_gnss(track, np.zeros(0, np.int64)).jump_count == 0


def test_speed_and_standing_share():
    quality = measure_gnss(straight(stands_s=20.0, noise_m=0.02), np.zeros(0, np.int64))
    assert quality.speed_mps == pytest.approx(8.0, rel=0.02)
    assert quality.standing_share == pytest.approx(1.0 / 3.0, abs=0.03)


def test_images_before_the_first_and_after_the_last_fix_are_not_covered():
    images_ns = np.arange(-10, 85, dtype=np.int64) * SECOND_NS
    quality = measure_gnss(straight(), images_ns)
    assert quality.is_same_time
    assert quality.uncovered_start_s == pytest.approx(10.0)
    assert quality.uncovered_end_s == pytest.approx(24.1)
    assert quality.covered_share == pytest.approx(59.9 / 94.0)


def test_fixes_of_another_day_cover_nothing():
    images_ns = (86_400 + np.arange(60, dtype=np.int64)) * SECOND_NS
    quality = measure_gnss(straight(), images_ns)
    assert (quality.is_same_time, quality.covered_share) == (False, 0.0)


def test_the_way_is_that_driven():
    way_m = straight(noise_m=0.05).way_m(np.array([10, 20], dtype=np.int64) * SECOND_NS)
    assert way_m[1] - way_m[0] == pytest.approx(80.0, rel=0.01)


def test_spaced_times_keep_both_ends():
    assert spaced(np.arange(0.0, 3.3, 0.5), 1.0).tolist() == [0, 2, 4, 6]
    assert spaced(np.array([0.0, 0.2]), 1.0).tolist() == [0, 1]
    assert spaced(np.array([0.0]), 1.0).tolist() == [0]
