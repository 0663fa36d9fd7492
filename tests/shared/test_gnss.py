"""The error models are what they say, and fixes stand where and when they should."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pyproj import Geod

from fleetmap.errors import InputError
from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import so3_exp
from fleetmap.gnss import (
    CONSUMER,
    GNSS_ERROR_MODELS,
    RTK,
    antenna_positions_m,
    fix_stamps_ns,
    sample_fixes,
    sample_outliers_enu_m,
)
from fleetmap.trajectory import Trajectory

T0_NS = 1_700_000_000_000_000_000
EXACT = replace(RTK, white_sigma_m=0.0)


def cubic_drive(frames: int = 101, epsg: int = 32632) -> Trajectory:
    """Positions on one cubic polynomial, which a cubic spline through them must reproduce exactly; 10 Hz."""
    seconds = np.arange(frames) * 0.1
    turn = np.stack([np.zeros(frames), np.zeros(frames), 0.05 * seconds], axis=1)
    return Trajectory(epsg, T0_NS + np.arange(frames) * 100_000_000, polynomial(seconds), so3_exp(turn))


def polynomial(seconds):
    s = np.asarray(seconds)
    return np.stack(
        [455_000 + 8 * s - 0.3 * s**2 + 0.02 * s**3, 5_425_000 + 2 * s + 0.1 * s**3, 115 + 0.01 * s**2], axis=-1
    )


def straight_drive(seconds: float, epsg: int = 32632) -> Trajectory:
    count = int(seconds) + 1
    positions = np.array([700_000.0, 5_425_000.0, 115.0]) + np.arange(count)[:, None] * [3.0, 4.0, 0.0]
    return Trajectory(epsg, T0_NS + np.arange(count) * 1_000_000_000, positions, np.tile(np.eye(3), (count, 1, 1)))


def enu_errors(reference, fixes):
    """Errors of the fixes in true east, north (by the geodesic on the ellipsoid) and up."""
    stamps_ns = np.array([fix.stamp_ns for fix in fixes])
    truth = antenna_positions_m(reference, stamps_ns, (0.0, 0.0, 0.0))
    lat, lon, height = UtmGrid(reference.epsg).to_geodetic(truth)
    azimuth_deg, _, metres = Geod(ellps="WGS84").inv(
        lon, lat, [fix.lon_deg for fix in fixes], [fix.lat_deg for fix in fixes]
    )
    azimuth = np.radians(azimuth_deg)
    up = np.array([fix.height_m for fix in fixes]) - height
    return np.stack([metres * np.sin(azimuth), metres * np.cos(azimuth), up], axis=1)


class TestStamps:
    images = T0_NS + np.arange(11) * 100_000_000  # one second

    def test_the_first_comes_37_ms_after_the_first_image_and_the_last_1_ms_before_the_last(self):
        stamps = fix_stamps_ns(self.images, 0.3)
        assert (stamps - T0_NS).tolist() == [37_000_000, 337_000_000, 637_000_000, 937_000_000, 999_000_000]

    def test_a_fix_that_falls_on_the_last_one_is_not_doubled(self):
        images = np.array([T0_NS, T0_NS + 1_038_000_000])
        assert (fix_stamps_ns(images, 0.5) - T0_NS).tolist() == [37_000_000, 537_000_000, 1_037_000_000]

    def test_ten_hertz_over_an_hour_does_not_drift(self):
        stamps = fix_stamps_ns(np.array([T0_NS, T0_NS + 3_600_000_000_000]), 0.1)
        assert len(stamps) == 36_001
        assert np.all(np.diff(stamps[:-1]) == 100_000_000)

    @pytest.mark.parametrize("interval_s", [0.0, -1.0, float("nan"), float("inf"), 1e-9])
    def test_an_interval_that_makes_no_sense_is_refused(self, interval_s):
        with pytest.raises(InputError, match="interval"):
            fix_stamps_ns(self.images, interval_s)

    def test_one_image_is_too_few(self):
        with pytest.raises(InputError, match="at least 2"):
            fix_stamps_ns(self.images[:1], 0.1)


def test_without_noise_fixes_lie_exactly_on_the_cubic():
    reference = cubic_drive()
    fixes = sample_fixes(reference, EXACT, interval_s=0.07)
    seconds = np.array([(fix.stamp_ns - T0_NS) * 1e-9 for fix in fixes])
    points = UtmGrid(32632).from_geodetic(
        *(np.array([getattr(fix, name) for fix in fixes]) for name in ("lat_deg", "lon_deg", "height_m"))
    )
    assert points == pytest.approx(polynomial(seconds), abs=1e-6)


def test_the_antenna_turns_with_the_camera_also_between_images():
    reference = cubic_drive()
    stamps = np.array([T0_NS + 1_234_567_890])
    arm = np.array([1.0, 2.0, 3.0])
    (antenna,) = antenna_positions_m(reference, stamps, (1.0, 2.0, 3.0))
    turn = so3_exp(np.array([0.0, 0.0, 0.05 * 1.234567890]))
    assert antenna == pytest.approx(polynomial(1.234567890) + turn @ arm, abs=1e-6)


def test_rtk_is_five_centimetres_white_along_true_axes():
    reference = straight_drive(2000.0)
    errors = enu_errors(reference, sample_fixes(reference, RTK, interval_s=1.0, seed=1))
    assert errors.std(axis=0) == pytest.approx([0.05] * 3, rel=0.08)
    assert np.abs(errors.mean(axis=0)).max() < 4 * 0.05 / np.sqrt(len(errors))
    correlation = np.mean(errors[1:] * errors[:-1], axis=0) / errors.var(axis=0)
    assert np.abs(correlation).max() < 0.1


def test_consumer_is_a_slow_bias_under_a_little_white_noise():
    reference = straight_drive(100_000.0)
    stamps = reference.stamps_ns
    errors = CONSUMER.sample_errors_enu_m(stamps, np.random.default_rng(2))
    # 1000 time constants: the standard deviation is known to about 3 %.
    assert errors.std(axis=0) == pytest.approx(np.hypot([1.0, 1.0, 1.5], 0.1), rel=0.12)
    bias_variance = np.array([1.0, 1.0, 2.25])
    for lag_s in (50, 100, 200):
        covariance = np.mean(errors[lag_s:] * errors[:-lag_s], axis=0)
        assert covariance / bias_variance == pytest.approx([np.exp(-lag_s / 100.0)] * 3, abs=0.12)
    white_variance = np.var(np.diff(errors, axis=0), axis=0) / 2 - bias_variance * (1 - np.exp(-0.01))
    assert np.sqrt(white_variance) == pytest.approx([0.1] * 3, rel=0.1)


def test_the_bias_starts_anywhere_in_its_distribution():
    starts = np.array(
        [
            CONSUMER.sample_errors_enu_m(np.array([T0_NS, T0_NS + 1]), np.random.default_rng(seed))[0]
            for seed in range(800)
        ]
    )
    assert starts.std(axis=0) == pytest.approx(np.hypot([1.0, 1.0, 1.5], 0.1), rel=0.1)


def test_the_bias_forgets_by_elapsed_time_not_by_number_of_fixes():
    sparse = np.arange(20_000, dtype=np.int64) * 100_000_000_000
    errors = CONSUMER.sample_errors_enu_m(sparse, np.random.default_rng(3))
    correlation = np.mean(errors[1:] * errors[:-1], axis=0) / [1.0, 1.0, 2.25]
    assert correlation == pytest.approx([np.exp(-1.0)] * 3, abs=0.05)


def test_the_errors_are_along_true_north_far_from_the_zones_meridian():
    """At 700 km easting grid north is 2 degrees off; a bias of 1 km shows the difference (35 m)."""
    biased = replace(RTK, white_sigma_m=0.0, bias_sigma_m=(0.0, 1000.0, 0.0), bias_time_constant_s=1e12)
    reference = straight_drive(3.0)
    errors = enu_errors(reference, sample_fixes(reference, biased, interval_s=1.0, seed=5))
    north = np.abs(errors[0, 1])
    assert north > 100.0
    assert np.abs(errors[:, 0]).max() < 2e-3 * north
    assert errors[:, 1] == pytest.approx(errors[0, 1], rel=1e-3)


@pytest.mark.parametrize(("name", "sigma_m"), [("rtk", 0.05), ("consumer", 1.5)])
def test_each_model_reports_its_sigma(name, sigma_m):
    fixes = sample_fixes(cubic_drive(), GNSS_ERROR_MODELS[name])
    for fix in fixes:
        assert fix.covariance_enu_m2 == pytest.approx(np.eye(3) * sigma_m**2)


def positions(fixes):
    return {fix.stamp_ns: (fix.lat_deg, fix.lon_deg, fix.height_m) for fix in fixes}


def test_the_same_seed_repeats_and_another_differs():
    first, again, other = (positions(sample_fixes(cubic_drive(), CONSUMER, seed=seed)) for seed in (7, 7, 8))
    assert first == again
    assert all(first[stamp] != other[stamp] for stamp in first)


def test_a_gap_removes_its_fixes_and_leaves_the_others_as_they_were():
    whole = positions(sample_fixes(cubic_drive(), CONSUMER, interval_s=1.0, seed=7))
    gap = positions(sample_fixes(cubic_drive(), CONSUMER, interval_s=1.0, seed=7, gap_s=(2.0, 5.0)))
    removed = sorted((stamp - T0_NS) // 1_000_000 for stamp in whole.keys() - gap.keys())
    assert removed == [2037, 3037, 4037, 5037, 6037]
    assert all(whole[stamp] == gap[stamp] for stamp in gap)


class TestOutliers:
    def test_a_fifth_of_the_fixes_is_far_off_and_says_that_it_is_good(self):
        reference = straight_drive(1000.0)
        fixes = sample_fixes(reference, RTK, interval_s=1.0, outlier_ratio=0.2, seed=1)
        distances_m = np.linalg.norm(enu_errors(reference, fixes), axis=1)
        far = distances_m > 1.0
        assert far.sum() == round(0.2 * len(fixes))
        assert 4.7 < distances_m[far].min() < 7.0
        assert 48.0 < distances_m[far].max() < 50.3
        assert distances_m[far].mean() == pytest.approx(27.5, abs=3.0)
        assert all(fix.covariance_enu_m2 == pytest.approx(np.eye(3) * 0.05**2) for fix in fixes)

    def test_the_other_fixes_stay_as_they_are_without_outliers_and_fewer_are_among_more(self):
        clean, few, many = (
            positions(sample_fixes(cubic_drive(), CONSUMER, outlier_ratio=ratio, seed=7))
            for ratio in (0.0, 0.1, 0.3)
        )
        moved_by_few, moved_by_many = ({s for s in clean if clean[s] != other[s]} for other in (few, many))
        assert (len(moved_by_few), len(moved_by_many)) == (round(0.1 * len(clean)), round(0.3 * len(clean)))
        assert moved_by_few < moved_by_many
        assert all(few[stamp] == many[stamp] for stamp in moved_by_few)

    def test_they_lie_in_all_directions_alike(self):
        outliers = sample_outliers_enu_m(4000, 1.0, seed=3)
        directions = outliers / np.linalg.norm(outliers, axis=1, keepdims=True)
        assert np.abs(directions.mean(axis=0)).max() < 0.04
        assert (directions**2).mean(axis=0) == pytest.approx([1 / 3] * 3, abs=0.02)

    def test_another_seed_chooses_others(self):
        first, again, other = (sample_outliers_enu_m(100, 0.2, seed) for seed in (1, 1, 2))
        np.testing.assert_array_equal(first, again)
        assert 5 < ((first != 0) & (other == 0)).any(axis=1).sum() <= 20

    @pytest.mark.parametrize("ratio", [-0.1, 1.1, float("nan")])
    def test_what_is_no_share_is_refused(self, ratio):
        with pytest.raises(InputError, match="share of 0 to 1"):
            sample_fixes(cubic_drive(), RTK, outlier_ratio=ratio)
