from __future__ import annotations

import numpy as np
import pytest

from fleetmap.drive import GnssFix
from fleetmap.errors import TrajectoryError
from fleetmap.geodesy import UtmGrid
from fleetmap.trajectory import Trajectory
from fleetmap.yardstick import evaluate_gnss_spline

START_NS = 1_700_000_000_000_000_000
GRID = UtmGrid(32632)
CORNER_M = np.array([455_300.0, 5_425_500.0, 120.0])


def cubic_road(stamps_ns: np.ndarray) -> np.ndarray:
    """A road that is a cubic polynomial of time, which a not-a-knot spline passes exactly."""
    t = (stamps_ns - START_NS) / 1e9
    return CORNER_M + np.stack([7.0 * t, 0.9 * t**2 - 0.02 * t**3, 0.1 * t], axis=1)


def reference(count: int = 301) -> Trajectory:
    stamps_ns = START_NS + np.arange(count, dtype=np.int64) * 100_000_000
    return Trajectory(32632, stamps_ns, cubic_road(stamps_ns), np.tile(np.eye(3), (count, 1, 1)))


def fixes(stamps_ns: np.ndarray, shift_m: np.ndarray | float = 0.0) -> list[GnssFix]:
    geodetic = GRID.to_geodetic(cubic_road(stamps_ns) + shift_m)
    return [
        GnssFix(int(stamp), float(lat), float(lon), float(height), np.eye(3) * 0.0025)
        for stamp, lat, lon, height in zip(stamps_ns, *geodetic, strict=True)
    ]


def every(interval_ns: int, first_ns: int = 37_000_000, length_ns: int = 30_000_000_000) -> np.ndarray:
    return START_NS + np.arange(first_ns, length_ns, interval_ns, dtype=np.int64)


def test_a_cubic_road_is_passed_exactly_even_by_sparse_fixes() -> None:
    errors = evaluate_gnss_spline(fixes(every(5_000_000_000)), reference())
    assert errors.position_m.max < 1e-5
    assert errors.rotation is None
    assert "rotation_deg" not in errors.to_json()


def test_fix_noise_and_bias_pass_into_the_spline() -> None:
    stamps_ns = every(100_000_000)
    noise = np.random.default_rng(3).normal(0.0, 0.05, (len(stamps_ns), 3))
    errors = evaluate_gnss_spline(fixes(stamps_ns, noise + np.array([1.0, 0.0, 0.0])), reference())
    assert errors.position_m.mean == pytest.approx(1.0, abs=0.03)
    assert 0.03 < errors.position_m.std < 0.06


def test_only_reference_poses_between_first_and_last_fix_are_judged() -> None:
    errors = evaluate_gnss_spline(fixes(every(1_000_000_000, 10_000_000_000, 20_500_000_000)), reference())
    assert (errors.matched, errors.comparable) == (101, 301)
    assert errors.stamps_ns[0] == START_NS + 10_000_000_000
    assert errors.stamps_ns[-1] == START_NS + 20_000_000_000


def test_of_two_fixes_at_one_time_the_first_counts_and_order_does_not_matter() -> None:
    stamps_ns = every(1_000_000_000)
    ordered, wrong = fixes(stamps_ns), fixes(stamps_ns, 5.0)
    errors = evaluate_gnss_spline([*reversed(ordered), wrong[3]], reference())
    assert errors.position_m.max < 1e-5


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_fixes_make_no_spline(count: int) -> None:
    with pytest.raises(TrajectoryError, match=f"holds {count}"):
        evaluate_gnss_spline(fixes(every(1_000_000_000)[:count]), reference())


def test_a_recording_of_another_day_is_refused() -> None:
    late = [GnssFix(f.stamp_ns + 10**15, f.lat_deg, f.lon_deg, f.height_m, f.covariance_enu_m2)
            for f in fixes(every(1_000_000_000))]  # fmt: skip
    with pytest.raises(TrajectoryError, match="belong together"):
        evaluate_gnss_spline(late, reference())
