"""A map that should not be published says why."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Sim3
from fleetmap.manifest import Quality
from fleetmap.trajectory import Trajectory
from fleetmap_mapper.georeferencing import GnssTrack, PathPoint
from fleetmap_mapper.placed_map import PlacedMap
from fleetmap_mapper.quality import assess
from fleetmap_mapper.road_quality import measure_road
from fleetmap_mapper.settings import GnssGroup, MapperSettings, QualityGroup

KEYFRAMES = 20
ANCHOR = UtmAnchor(32632, 457_000, 5_428_000, 116)


def with_limits(**limits: float) -> MapperSettings:
    return MapperSettings(quality=QualityGroup(**limits))


@pytest.fixture
def judge(make_world: Any) -> Callable[..., Quality]:
    """The quality of a map of a small world; arguments spoil it."""
    world = make_world(keyframes=KEYFRAMES, points=1200, step_m=2.0)

    def judged(
        frames_total: int = KEYFRAMES,
        gap_s: float = 0.0,
        pixel_shift: float = 0.0,
        fix_shift_m: float = 0.0,
        outlying_fixes: int = 0,
        sigma_m: float = 0.05,
        settings: MapperSettings | None = None,
    ) -> Quality:
        pixels = world.pixels + pixel_shift * world.sigmas_px[:, None] * [1.0, 0.0]
        placed = PlacedMap(
            world.camera,
            Sim3.identity(),
            np.arange(KEYFRAMES) * 10**9,
            world.poses,
            np.arange(len(world.points), dtype=np.int32),
            world.points,
            world.keyframe_index,
            world.point_index,
            np.zeros(len(pixels), np.int32),
            pixels,
            world.sigmas_px,
            np.ones(len(pixels)),
            np.zeros(len(pixels), np.bool_),
            pose_covariances=np.tile(np.diag([1e-6] * 3 + [sigma_m**2] * 3), (KEYFRAMES, 1, 1)),
        )
        stamps = np.arange(KEYFRAMES) * 10**9
        stamps[KEYFRAMES // 2 :] += int(gap_s * 1e9)
        trajectory = Trajectory(32632, stamps, world.centres, np.array([p.rotation for p in world.poses]))
        noise = np.random.default_rng(0).normal(0.0, 0.05, (KEYFRAMES, 3))
        positions = world.centres + noise + [fix_shift_m, 0.0, 0.0]
        positions[:outlying_fixes] += 50.0
        covariances = np.tile(np.eye(3) * 0.05**2, (KEYFRAMES, 1, 1))
        track = GnssTrack(ANCHOR, stamps, positions, covariances, np.zeros(3))
        path = [PathPoint(i, pose) for i, pose in enumerate(world.poses)]
        settings = settings or MapperSettings()
        placed = replace(placed, keyframe_stamps_ns=stamps)
        road = measure_road(placed, trajectory, path, track, settings.quality.weak_gap_s)
        return assess(placed, road, len(trajectory), frames_total, ANCHOR, settings)

    return judged


def test_a_sound_map_is_fit_to_publish(judge):
    quality = judge()
    assert quality.publishable
    assert quality.warnings == ()
    assert 1.2 < quality.reprojection_rms_px < 1.6  # one sigma in each of two directions
    assert 0.05 < quality.gnss_residual_rms_m < 0.13
    assert quality.length_m == pytest.approx(2.0 * (KEYFRAMES - 1))
    assert (quality.frames_posed, quality.gnss_fixes, quality.keyframes) == (KEYFRAMES, KEYFRAMES, KEYFRAMES)


@pytest.mark.parametrize(
    ("spoilt", "warning"),
    [
        ({"frames_total": 22}, "only 20 of 22 images could be posed"),
        ({"gap_s": 7.0}, "no image is posed for 8.0 s in mid-drive"),
        ({"pixel_shift": 3.0}, "reprojection errors of 3.3"),
        ({"fix_shift_m": 1.0}, "the map misses its GNSS fixes by "),
        (
            {"sigma_m": 2.5, "settings": with_limits(max_weak_ratio=1.0)},
            "its position is uncertain: 5 % of the keyframes by more than 2.50 m",
        ),
        ({"sigma_m": 1.5}, "38 m of 38 m are weak, in 1 stretches (limit 50 %)"),
        ({"settings": with_limits(min_landmarks_per_m=100.0)}, "only 27.7 landmarks per metre (limit 100)"),
    ],
)
def test_what_is_wrong_is_said(judge, spoilt, warning):
    quality = judge(**spoilt)
    assert not quality.publishable
    assert len(quality.warnings) == 1
    assert quality.warnings[0].startswith(warning)


def test_a_few_fixes_far_off_are_the_receivers_fault_and_not_the_maps(judge):
    quality = judge(outlying_fixes=5)
    assert quality.publishable
    assert quality.gnss_residual_rms_m > 10.0


def test_plain_slam_is_not_judged_by_its_fixes(judge):
    assert judge(fix_shift_m=1.0, settings=MapperSettings(gnss=GnssGroup(mode="none"))).publishable


def test_each_limit_is_a_setting(judge):
    patient = with_limits(
        min_posed_ratio=0.5, max_unposed_gap_s=60.0, max_reprojection_rms_px=9.0, max_weak_ratio=1.0
    )
    assert judge(frames_total=30, gap_s=20.0, pixel_shift=3.0, settings=patient).publishable
    strict = with_limits(max_reprojection_rms_px=1.0, max_gnss_residual_sigmas=0.1)
    assert len(judge(settings=strict).warnings) == 2


def test_a_mapped_drive_errs_about_as_much_as_it_says(mapped, survey):
    """NEES of the keyframes' positions against the truth: 3 on average, for keyframes that err alike."""
    keyframes = mapped.road_quality.keyframes
    rows = np.searchsorted(survey.truth.stamps_ns // 1000, keyframes.stamps_ns // 1000)
    errors_m = mapped.visual_map.anchor.utm_from_map(keyframes.positions_m) - survey.truth.positions_m[rows]
    information = np.linalg.inv(keyframes.covariances_m2.astype(np.float64))
    assert 0.5 < np.einsum("ki,kij,kj->k", errors_m, information, errors_m).mean() < 10.0
    assert 0.01 < mapped.quality.position_sigma_m < 0.06
    assert mapped.quality.weak_stretches == ()
    assert mapped.quality.landmarks_per_m == pytest.approx(mapped.quality.landmarks / 60.0, rel=0.01)
