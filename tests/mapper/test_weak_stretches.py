"""A weak stretch is found where it is, for the reason it is weak, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geodesy import UtmAnchor, UtmGrid
from fleetmap.road_quality import FixQuality, KeyframeQuality, RoadQuality
from fleetmap_mapper.settings import QualityGroup
from fleetmap_mapper.weak_stretches import find_weak_stretches, visual_ties

ANCHOR = UtmAnchor(32632, 457_000, 5_428_000, 116)
LENGTH_M, START_NS = 300.0, 1_700_000_000_000_000_000
ALONG_M = np.linspace(0.0, LENGTH_M, 151)  # a keyframe every 2 m at 10 m/s, eastwards
STAMPS_NS = START_NS + np.round(ALONG_M * 1e8).astype(np.int64)
TIES = np.full(150, 200)
LIMITS = QualityGroup()


def sound_road() -> RoadQuality:
    count = len(ALONG_M)
    fixes_m = np.arange(5.0, LENGTH_M, 10.0)
    return RoadQuality(
        KeyframeQuality(
            STAMPS_NS,
            ALONG_M,
            np.stack([ALONG_M, np.zeros(count), np.zeros(count)], axis=1),
            np.tile(np.eye(3, dtype=np.float32) * 0.05**2, (count, 1, 1)),
            np.full(count, 0.9, np.float32),
            np.full(count, 500, np.int32),
        ),
        FixQuality(
            START_NS + np.round(fixes_m * 1e8).astype(np.int64),
            fixes_m,
            np.full((len(fixes_m), 3), 0.03, np.float32),
            np.full(len(fixes_m), 0.8, np.float32),
            np.full(len(fixes_m), 0.05, np.float32),
        ),
        np.linspace(0.0, LENGTH_M, 31),
        np.full(30, 80.0, np.float32),
        np.empty((0, 2), np.int64),
        np.empty((0, 2)),
    )


def spoilt(kind: str, from_m: float, to_m: float) -> tuple[RoadQuality, np.ndarray]:
    """The sound road with one thing wrong on one stretch."""
    road, ties = sound_road(), TIES.copy()
    here = (from_m <= ALONG_M) & (to_m >= ALONG_M)
    keyframes, fixes = road.keyframes, road.fixes
    if kind == "position":
        keyframes.covariances_m2[here] *= 30.0**2
    elif kind == "reprojection":
        keyframes.reprojection_rms_px[here] = 3.5
    elif kind == "seen":
        keyframes.landmarks[here] = 12
    elif kind == "landmarks":
        road.landmarks_per_m[(road.edges_m[:-1] >= from_m) & (road.edges_m[1:] <= to_m)] = 1.5
    elif kind == "gnss":
        fixes.sigmas[(fixes.along_m > from_m) & (fixes.along_m < to_m)] = 9.0
    elif kind == "ties":
        ties[np.searchsorted(ALONG_M, from_m)] = 3
    else:
        gap_m = np.array([[from_m, to_m]])
        road = replace(road, gaps_m=gap_m, gap_stamps_ns=START_NS + np.round(gap_m * 1e8).astype(np.int64))
    return road, ties


def test_a_sound_road_has_none():
    assert find_weak_stretches(sound_road(), TIES, LIMITS, ANCHOR, is_tied_to_fixes=True) == ()


@pytest.mark.parametrize(
    ("kind", "from_m", "to_m", "worst", "text"),
    [
        ("position", 100.0, 140.0, 1.5, "position uncertain by 1.50 m (limit 1 m)"),
        ("reprojection", 100.0, 140.0, 3.5, "reprojection errors of 3.50 px (limit 2 px)"),
        ("seen", 100.0, 140.0, 12.0, "an image sees 12 landmarks (limit 40)"),
        ("landmarks", 100.0, 140.0, 1.5, "1.5 landmarks per metre (limit 5)"),
        ("gnss", 100.0, 150.0, 9.0, "fixes missed by 9.0 sigma (limit 4)"),
        ("gap", 100.0, 140.0, 4.0, "no image posed for 4.0 s (limit 0.5 s)"),
        ("ties", 100.0, 102.0, 3.0, "3 landmarks tie the road before to the road after (limit 20)"),
    ],
)
def test_it_is_found_where_it_is_and_nowhere_else(kind, from_m, to_m, worst, text):
    road, ties = spoilt(kind, from_m, to_m)
    (found,) = find_weak_stretches(road, ties, LIMITS, ANCHOR, is_tied_to_fixes=True)
    assert (found.from_m, found.to_m) == (pytest.approx(from_m, abs=2.0), pytest.approx(to_m, abs=2.0))
    (reason,) = found.reasons
    assert (reason.kind, reason.worst, reason.text) == (kind, pytest.approx(worst), text)
    assert found.start_ns == pytest.approx(START_NS + found.from_m * 1e8, abs=1e3)
    assert found.end_ns == pytest.approx(START_NS + found.to_m * 1e8, abs=1e3)
    for at_m, lonlat in ((found.from_m, found.start_lonlat), (found.to_m, found.end_lonlat)):
        lat_deg, lon_deg, _ = UtmGrid(32632).to_geodetic(ANCHOR.utm_from_map(np.array([at_m, 0.0, 0.0])))
        assert lonlat == (pytest.approx(float(lon_deg), abs=2e-7), pytest.approx(float(lat_deg), abs=2e-7))


@pytest.mark.parametrize(
    ("kind", "limit"),
    [
        ("position", {"weak_position_sigma_m": 2.0}),
        ("reprojection", {"weak_reprojection_rms_px": 4.0}),
        ("seen", {"weak_landmarks_per_image": 10}),
        ("landmarks", {"weak_landmarks_per_m": 1.0}),
        ("gnss", {"weak_gnss_sigmas": 10.0}),
        ("gap", {"weak_gap_s": 5.0}),
        ("ties", {"weak_ties": 2}),
    ],
)
def test_every_limit_is_a_setting(kind, limit):
    road, ties = spoilt(kind, 100.0, 140.0)
    assert len(find_weak_stretches(road, ties, LIMITS, ANCHOR, is_tied_to_fixes=True)) == 1
    assert find_weak_stretches(road, ties, QualityGroup(**limit), ANCHOR, is_tied_to_fixes=True) == ()


def test_reasons_for_one_place_are_told_together_and_far_places_apart():
    road, ties = spoilt("seen", 100.0, 140.0)
    road.keyframes.reprojection_rms_px[(ALONG_M >= 144.0) & (ALONG_M <= 150.0)] = 2.5  # 4 m after
    road.keyframes.reprojection_rms_px[(ALONG_M >= 200.0) & (ALONG_M <= 210.0)] = 2.8
    first, second = find_weak_stretches(road, ties, LIMITS, ANCHOR, is_tied_to_fixes=True)
    assert [reason.kind for reason in first.reasons] == ["reprojection", "seen"]
    assert (first.from_m, first.to_m, second.from_m, second.to_m) == (99.0, 151.0, 199.0, 211.0)
    assert [reason.worst for reason in first.reasons] == [2.5, 12.0]


def test_one_fix_far_off_is_the_receivers_fault():
    road, ties = spoilt("gnss", 100.0, 110.0)
    assert road.fixes.sigmas.max() == 9.0
    assert find_weak_stretches(road, ties, LIMITS, ANCHOR, is_tied_to_fixes=True) == ()


def test_plain_slam_is_not_judged_by_its_fixes():
    road, ties = spoilt("gnss", 100.0, 200.0)
    assert find_weak_stretches(road, ties, LIMITS, ANCHOR, is_tied_to_fixes=False) == ()


def test_a_minute_of_standing_still_leaves_no_weak_road():
    road, ties = spoilt("gap", 100.0, 100.2)
    road = replace(road, gap_stamps_ns=road.gap_stamps_ns + np.array([0, 60 * 10**9]))
    assert find_weak_stretches(road, ties, LIMITS, ANCHOR, is_tied_to_fixes=True) == ()


def test_what_is_unknown_is_not_called_weak():
    road = sound_road()
    road.keyframes.covariances_m2[:] = np.nan
    none = np.empty(0, np.float32)
    no_fixes = FixQuality(np.empty(0, np.int64), np.empty(0), np.empty((0, 3), np.float32), none, none)
    road = replace(road, fixes=no_fixes)
    assert find_weak_stretches(road, TIES, LIMITS, ANCHOR, is_tied_to_fixes=True) == ()


def test_ties_are_landmarks_seen_from_both_sides_within_ten_keyframes():
    """Landmark 0 is seen by keyframes 0 to 2, landmark 1 by 1 and 4, landmark 2 by 0 and, a round later, 20."""
    keyframe = np.array([0, 0, 1, 1, 2, 4, 20], np.int32)
    point = np.array([0, 2, 0, 1, 0, 1, 2], np.int32)
    ties = visual_ties(keyframe, point, 21)
    assert ties.tolist() == [1, 2, 1, 1, *[0] * 16]


def test_segments_that_share_no_landmark_are_not_tied(make_world):
    world = make_world(keyframes=20, points=600, step_m=1.0)
    ties = visual_ties(world.keyframe_index, world.point_index, 20)
    assert ties.min() > 50
    split = world.point_index + np.where(world.keyframe_index < 10, 0, len(world.points)).astype(np.int32)
    apart = visual_ties(world.keyframe_index, split, 20)
    assert apart[9] == 0
    assert np.delete(apart, 9).min() > 20
