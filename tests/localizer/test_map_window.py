"""Where a vehicle may be, and the cells around it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.errors import InputError
from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import Pose
from fleetmap.manifest import PartRecord
from fleetmap_localizer.map_window import Area, Whereabouts, WindowSettings
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate

SETTINGS = WindowSettings()
START_NS = 1_700_000_000_000_000_000
EAST_M, NORTH_M = 691_200.0, 5_334_784.0  # a corner of a cell: 5400, 41678
CELLS = [
    PartRecord(kind="cell", sha256=f"{n:064x}", size_bytes=9, cell=(5395 + n, 41678), keyframes=1, landmarks=1)
    for n in range(20)
]


def pose(at_s: float, east_m: float, sigma_m: float = 0.01, kind: str = "measured") -> PoseEstimate:
    place = Pose(np.eye(3), np.array([EAST_M + east_m, NORTH_M + 64.0, 500.0]))
    covariance = np.diag([1e-6] * 3 + [sigma_m**2] * 3)
    return PoseEstimate(START_NS + round(at_s * 1e9), 32632, place, covariance, "road", "0" * 64, 50, kind)


def no_pose(at_s: float) -> NoPose:
    return NoPose(START_NS + round(at_s * 1e9), "a lorry")


def driven(speed_mps: float, seconds: float = 1.0) -> Whereabouts:
    """Where a vehicle is that has driven east at 10 images a second."""
    where = Whereabouts(SETTINGS)
    for number in range(round(10 * seconds) + 1):
        where = where.after(pose(0.1 * number, 0.1 * number * speed_mps))
    return where


def cells(area: Area | None) -> list[int]:
    """Numbers of the cells in an area, from west to east."""
    assert area is not None
    return sorted(record.cell[0] for record in area.cells_of(CELLS, 32632) if record.cell)


def test_without_a_prior_it_may_be_anywhere() -> None:
    where = Whereabouts.near(None, SETTINGS)
    assert where.is_searching
    assert where.look_area() is None
    assert where.fetch_area() is None
    assert where.after(no_pose(0.0)).after(no_pose(60.0)).look_area() is None


def test_a_cell_is_in_an_area_if_any_point_of_it_is() -> None:
    generator = np.random.default_rng(1)
    inside = np.stack(np.meshgrid(np.linspace(0, 128, 65), np.linspace(0, 128, 65)), axis=-1).reshape(-1, 2)
    counted = 0
    for _ in range(30):
        centres_m = np.array([EAST_M, NORTH_M]) + generator.uniform(-600, 1500, (2, 2))
        area = Area(32632, centres_m, float(generator.uniform(20, 700)))
        found = {record.sha256 for record in area.cells_of(CELLS, 32632)}
        for record in CELLS:
            points = 128.0 * np.array(record.cell) + inside
            away_m = np.linalg.norm(points[:, None] - centres_m, axis=2).min()
            if abs(away_m - area.radius_m) > 1.5:  # finer than the grid of points
                assert (record.sha256 in found) == (away_m < area.radius_m)
                counted += record.sha256 in found
    assert counted > 50


def test_the_nearest_cells_come_first() -> None:
    area = Area(32632, np.array([[EAST_M + 64.0, NORTH_M + 64.0]]), 400.0)
    away = [abs(record.cell[0] - 5400) for record in area.cells_of(CELLS, 32632) if record.cell]
    assert away == sorted(away) == [0, 1, 1, 2, 2, 3, 3]


def test_near_a_named_place_lie_the_cells_within_its_uncertainty() -> None:
    lat, lon, _ = UtmGrid(32632).to_geodetic(np.array([EAST_M + 64.0, NORTH_M + 64.0, 0.0]))
    where = Whereabouts.near((float(lat), float(lon)), SETTINGS)
    assert where.is_searching
    assert cells(where.look_area()) == list(range(5396, 5405))  # 450 m from the middle of the cell
    with pytest.raises(InputError, match="outside UTM"):
        Whereabouts.near((89.0, 8.0), SETTINGS)


def test_one_pose_is_not_believed_several_in_a_row_are() -> None:
    where = Whereabouts(SETTINGS).after(pose(0.0, 0.0)).after(pose(0.1, 0.5)).after(no_pose(0.2))
    where = where.after(pose(0.3, 1.5)).after(pose(0.4, 2.0))
    assert where.is_searching
    assert where.look_area() is None
    where = where.after(pose(0.5, 2.5))
    assert not where.is_searching
    assert cells(where.look_area()) == [5398, 5399, 5400, 5401]


def test_what_is_fetched_lies_ahead_of_what_is_looked_into_and_further_than_behind() -> None:
    where = driven(20.0)
    look, fetch = cells(where.look_area()), cells(where.fetch_area())
    assert set(look) < set(fetch)
    assert look == [5398, 5399, 5400, 5401]  # from 20 m: 130 m behind, 80 + 150 m ahead
    assert min(fetch) == 5397  # 280 m behind
    assert max(fetch) == 5405  # 20 s * 20 m/s + 300 m ahead


def test_a_vehicle_that_stands_has_the_same_around_it_on_all_sides() -> None:
    fetch = driven(0.0).fetch_area()
    assert fetch is not None
    assert np.ptp(fetch.centres_m, axis=0).max() < 1.0


def test_the_window_of_a_lost_vehicle_grows_around_where_it_was_but_not_for_ever() -> None:
    where = driven(0.0)
    radii = [where.after(no_pose(1.0 + seconds)).look_area().radius_m for seconds in (1, 2.9, 4, 13, 9999)]  # type: ignore[union-attr]
    assert radii[0] == radii[1] == pytest.approx(150.0, abs=0.1)
    assert radii[2] == pytest.approx(180.0, abs=0.1)
    assert radii[3] == pytest.approx(450.0, abs=0.1)
    assert radii[4] == pytest.approx(150.0 + SETTINGS.max_growth_m, abs=0.1)
    assert not where.after(no_pose(3.9)).is_searching
    lost = where.after(no_pose(5.0))
    assert lost.is_lost
    for number in range(3):
        assert lost.is_searching
        lost = lost.after(pose(5.1 + 0.1 * number, 100.0))
    assert not lost.is_searching


def test_a_predicted_pose_is_followed_with_its_uncertainty_but_vouches_for_nothing() -> None:
    followed = driven(10.0).after(pose(2.0, 20.0, sigma_m=30.0, kind="predicted"))
    area = followed.look_area()
    assert area is not None
    assert area.radius_m == pytest.approx(150.0 + 90.0, abs=0.1)
    assert area.centres_m[0, 0] == EAST_M + 20.0
    for at_s in (3.0, 4.0, 5.0):
        followed = followed.after(pose(at_s, 10.0 * at_s, kind="predicted"))
    assert followed.is_lost  # images say nothing: other maps may show more
    assert not followed.is_searching
    nowhere = Whereabouts(SETTINGS)
    for number in range(9):
        nowhere = nowhere.after(pose(0.1 * number, 0.0, kind="predicted"))
    assert nowhere.look_area() is None


def test_an_area_reaches_into_the_next_zone() -> None:
    """At 12 E zones 32 and 33 meet."""
    lat, lon = np.array([48.0]), np.array([12.0])
    here = UtmGrid(32632).from_geodetic(lat, lon, np.zeros(1))[:, :2]
    there = UtmGrid(32633).from_geodetic(lat, lon, np.zeros(1))[:, :2]
    east, north = np.floor(there[0] / 128.0).astype(int).tolist()
    record = replace_cell(CELLS[0], (east, north))
    area = Area(32632, here, 10.0)
    assert area.cells_of([record], 32633) == [record]
    assert area.cells_of([record], 32632) == []
    np.testing.assert_allclose(area.in_zone(32633), there, atol=1e-3)


def replace_cell(record: PartRecord, cell: tuple[int, int]) -> PartRecord:
    return record.model_copy(update={"cell": cell})


def test_small_steps_ask_for_nothing_new_large_ones_do() -> None:
    where = driven(10.0)
    assert where.after(pose(1.1, 11.0)).is_like(where)
    assert not where.after(pose(1.1, 31.0)).is_like(where)
    assert not where.is_like(Whereabouts(SETTINGS))
    assert not where.after(no_pose(9.0)).is_like(where)
    assert replace(where, in_a_row=77).is_like(where)
