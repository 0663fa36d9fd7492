"""Figures along the road, where each can be counted by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Sim3
from fleetmap.road_quality import RoadQuality
from fleetmap.trajectory import Trajectory
from fleetmap_mapper.georeferencing import GnssTrack, PathPoint
from fleetmap_mapper.placed_map import PlacedMap
from fleetmap_mapper.road_quality import measure_road

KEYFRAMES, STEP_M = 31, 2.0
STAMPS_NS = 1_700_000_000_000_000_000 + np.arange(KEYFRAMES, dtype=np.int64) * 200_000_000


@pytest.fixture
def straight(make_world: Any) -> tuple[PlacedMap, Trajectory]:
    """60 m straight on, a keyframe every 2 m, every image a keyframe."""
    world = make_world(keyframes=KEYFRAMES, points=900, step_m=STEP_M, radius_m=None)
    placed = PlacedMap(
        world.camera,
        Sim3.identity(),
        STAMPS_NS,
        world.poses,
        np.arange(len(world.points), dtype=np.int32),
        world.points,
        world.keyframe_index,
        world.point_index,
        np.zeros(len(world.pixels), np.int32),
        world.pixels,
        world.sigmas_px,
        np.ones(len(world.pixels)),
        np.zeros(len(world.pixels), np.bool_),
    )
    rotations = np.array([pose.rotation for pose in world.poses])
    return placed, Trajectory(32632, STAMPS_NS, world.centres, rotations)


def fixes_along(placed: PlacedMap, error_m: tuple[float, float, float]) -> tuple[list[PathPoint], GnssTrack]:
    rows = range(0, KEYFRAMES, 5)
    arm = np.array([0.3, -1.2, -0.8])
    antenna_m = np.array([placed.poses[k].transform(arm) for k in rows])
    covariances_m2 = np.tile(np.diag([0.1, 0.2, 0.4]) ** 2, (len(rows), 1, 1))
    track = GnssTrack(UtmAnchor(32632, 0, 0, 0), STAMPS_NS[rows], antenna_m - error_m, covariances_m2, arm)
    return [PathPoint(i, placed.poses[k]) for i, k in enumerate(rows)], track


def road_of(placed: PlacedMap, trajectory: Trajectory, **options: Any) -> RoadQuality:
    path, track = fixes_along(placed, options.pop("error_m", (0.0, 0.0, 0.0)))
    return measure_road(placed, trajectory, path, track, options.pop("gap_s", 0.5))


def test_places_count_in_metres_driven(straight):
    road = road_of(*straight)
    np.testing.assert_allclose(road.keyframes.along_m, np.arange(KEYFRAMES) * STEP_M, atol=1e-9)
    np.testing.assert_allclose(road.fixes.along_m, np.arange(0, KEYFRAMES, 5) * STEP_M, atol=1e-9)
    assert road.length_m == pytest.approx(60.0)
    np.testing.assert_allclose(road.edges_m, np.arange(0.0, 61.0, 10.0))
    assert len(road.gaps_m) == 0


def test_landmarks_per_metre_add_up_and_none_is_counted_twice(straight):
    placed, trajectory = straight
    road = road_of(placed, trajectory)
    assert (road.landmarks_per_m * np.diff(road.edges_m)).sum() == pytest.approx(len(placed.points_m), rel=1e-6)
    assert road.landmarks_per_m.min() > 5.0


def test_landmarks_count_where_they_are_seen_from(straight):
    placed, trajectory = straight
    there = placed.keyframe_index < 11  # up to 20 m
    placed = replace(
        placed,
        keyframe_index=placed.keyframe_index[there],
        point_index=placed.point_index[there],
        pixels=placed.pixels[there],
        corner_sigmas_px=placed.corner_sigmas_px[there],
        noise=placed.noise[there],
        is_aligned=placed.is_aligned[there],
        feature_index=placed.feature_index[there],
    )
    density = road_of(placed, trajectory).landmarks_per_m
    assert density[:2].min() > 5.0
    assert 0.0 < density[2] < 0.3 * density[1]  # the last one's share reaches a metre further
    assert density[3:].max() == 0.0


def test_residuals_are_the_map_minus_the_fix_in_metres_and_in_sigmas(straight):
    fixes = road_of(*straight, error_m=(0.1, -0.2, 0.4)).fixes
    np.testing.assert_allclose(fixes.residuals_m, np.tile([0.1, -0.2, 0.4], (len(fixes), 1)), atol=1e-6)
    np.testing.assert_allclose(fixes.sigmas, 1.0, atol=1e-6)
    np.testing.assert_allclose(fixes.claimed_sigmas_m, 0.2, atol=1e-6)


def test_reprojection_errors_and_landmarks_of_each_keyframe(straight):
    placed, trajectory = straight
    off = placed.keyframe_index == 7
    shifted = placed.pixels + np.where(off, 5.0 * placed.sigmas_px, 0.0)[:, None] * [1.0, 0.0]
    keyframes = road_of(replace(placed, pixels=shifted), trajectory).keyframes
    assert keyframes.landmarks[7] == off.sum()
    assert keyframes.landmarks.sum() == len(placed.pixels)
    assert 4.8 < keyframes.reprojection_rms_px[7] < 5.6
    assert 1.2 < np.delete(keyframes.reprojection_rms_px, 7).mean() < 1.6  # one sigma in each of two directions


def test_a_second_without_posed_images_is_a_gap_and_one_image_is_not(straight):
    placed, trajectory = straight
    posed = np.delete(np.arange(KEYFRAMES), [4, *range(10, 14)])
    patchy = Trajectory(32632, STAMPS_NS[posed], trajectory.positions_m[posed], trajectory.rotations[posed])
    road = road_of(placed, patchy)
    np.testing.assert_allclose(road.gaps_m, [[18.0, 28.0]])
    np.testing.assert_array_equal(road.gap_stamps_ns, STAMPS_NS[[9, 14]][None])
    assert len(road_of(placed, patchy, gap_s=1.5).gaps_m) == 0


def test_a_slow_camera_has_no_gaps(straight):
    """One image a second, all posed."""
    placed, trajectory = straight
    slow = replace(trajectory, stamps_ns=STAMPS_NS[0] + np.arange(KEYFRAMES, dtype=np.int64) * 10**9)
    path, track = fixes_along(placed, (0.0, 0.0, 0.0))
    assert len(measure_road(placed, slow, path, track, 0.5).gaps_m) == 0


def test_covariances_are_kept_and_unknown_where_there_are_none(straight):
    placed, trajectory = straight
    assert np.isnan(road_of(placed, trajectory).keyframes.horizontal_sigmas_m).all()
    covariance = np.array([[0.04, 0.02, 0.0], [0.02, 0.04, 0.0], [0.0, 0.0, 0.25]])
    in_cam = np.zeros((KEYFRAMES, 6, 6))
    in_cam[:, 3:, 3:] = [pose.rotation.T @ covariance @ pose.rotation for pose in placed.poses]
    known = replace(placed, pose_covariances=in_cam)
    keyframes = road_of(known, trajectory).keyframes
    np.testing.assert_allclose(keyframes.horizontal_sigmas_m, np.sqrt(0.06), rtol=1e-6)  # along the diagonal
    np.testing.assert_allclose(keyframes.vertical_sigmas_m, 0.5, rtol=1e-6)
