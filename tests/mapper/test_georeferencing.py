"""Where ``vis`` lies in UTM: a known Sim(3) is found from noisy fixes, and what cannot be found is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fleetmap.drive import GnssFix
from fleetmap.errors import DriveError
from fleetmap.geodesy import UtmAnchor, UtmGrid
from fleetmap.geometry import Pose, Sim3, rotation_angle_rad, so3_exp, umeyama_alignment
from fleetmap_mapper.georeferencing import GnssTrack, PathPoint, gnss_track, path_at_fixes
from fleetmap_mapper.placement import georeference

ANCHOR = UtmAnchor(32632, 678_000, 5_404_000, 420)
VIS_FROM_MAP = Sim3(0.21, so3_exp(np.array([1.1, -0.7, 0.4])), np.array([3.0, -2.0, 7.0]))
ARM = np.array([0.4, -1.1, -0.9])
LEVEL_DEG = 0.5
T0_NS = 1_700_000_000_000_000_000


def along(world: Any, sigma_m: float, arm: np.ndarray = ARM, seed: int = 0) -> tuple[list[PathPoint], GnssTrack]:
    """A camera path in ``vis`` with one noisy fix per camera."""
    rng = np.random.default_rng(seed)
    antennas = np.array([pose.transform(arm) for pose in world.poses])
    count = len(antennas)
    track = GnssTrack(
        ANCHOR,
        T0_NS + np.arange(count) * 10**9,
        antennas + rng.normal(0.0, sigma_m, (count, 3)),
        np.tile(np.eye(3) * sigma_m**2, (count, 1, 1)),
        arm,
    )
    path = [PathPoint(fix, VIS_FROM_MAP.transform_pose(pose)) for fix, pose in enumerate(world.poses)]
    return path, track


def camera_centres(path: list[PathPoint]) -> np.ndarray:
    return np.array([point.pose.translation_m for point in path])


def errors(map_from_vis: Sim3, world: Any) -> tuple[float, float]:
    """Mean position error in metres, rotation error in degrees."""
    placed = [(map_from_vis @ VIS_FROM_MAP).transform_pose(pose) for pose in world.poses]
    shifts = np.array([p.translation_m for p in placed]) - world.centres
    turn = placed[0].rotation @ world.poses[0].rotation.T
    return float(np.linalg.norm(shifts, axis=1).mean()), float(np.degrees(rotation_angle_rad(turn)))


@pytest.fixture(scope="module")
def bend(make_world):
    return make_world(keyframes=40, points=10, step_m=2.0, radius_m=30.0)


@pytest.fixture(scope="module")
def straight(make_world):
    return make_world(keyframes=40, points=10, step_m=2.0, radius_m=None)


@pytest.mark.parametrize("arm", [np.zeros(3), ARM], ids=["antenna at the camera", "lever arm"])
def test_a_known_similarity_is_found_from_noisy_fixes(bend, arm):
    position_m, rotation_deg = errors(georeference(*along(bend, 0.05, arm), LEVEL_DEG), bend)
    assert 0.001 < position_m < 0.04  # 5 cm per axis, averaged over forty fixes for seven unknowns
    assert 0.0001 < rotation_deg < 0.3


def test_without_noise_it_is_found_exactly(bend):
    path, track = along(bend, 0.05)
    exact = replace(track, positions_m=np.array([pose.transform(ARM) for pose in bend.poses]))
    S = georeference(path, exact, LEVEL_DEG)
    position_m, rotation_deg = errors(S, bend)
    assert position_m < 1e-4
    assert rotation_deg < 1e-3
    assert S.scale == pytest.approx(1.0 / VIS_FROM_MAP.scale, rel=1e-5)


def test_a_lever_arm_that_is_forgotten_shows(bend):
    path, track = along(bend, 0.05)
    position_m, _ = errors(georeference(path, replace(track, antenna_in_cam_m=np.zeros(3)), LEVEL_DEG), bend)
    assert position_m > 0.5


def test_fixes_that_are_far_off_are_resisted(bend):
    path, track = along(bend, 0.05)
    positions = track.positions_m.copy()
    positions[[4, 17, 30]] += [[6.0, 2.0, -3.0], [-4.0, 8.0, 5.0], [3.0, 3.0, 9.0]]
    position_m, rotation_deg = errors(georeference(path, replace(track, positions_m=positions), LEVEL_DEG), bend)
    assert 0.001 < position_m < 0.1
    assert rotation_deg < 0.5


def test_good_fixes_count_for_more_than_poor_ones(bend):
    path, track = along(bend, 0.02)
    rng = np.random.default_rng(4)
    poor = np.arange(0, 40, 2)
    positions, covariances = track.positions_m.copy(), track.covariances_m2.copy()
    positions[poor] += rng.normal(0.0, 3.0, (len(poor), 3))
    covariances[poor] = np.eye(3) * 9.0
    told = replace(track, positions_m=positions, covariances_m2=covariances)
    position_m, _ = errors(georeference(path, told, LEVEL_DEG), bend)
    assert 0.0 < position_m < 0.05


def test_on_a_straight_road_the_camera_is_taken_to_be_level(straight):
    for seed in range(12):  # upright each time: upside down, the fixes on a line would fit as well
        path, track = along(straight, 0.05, np.zeros(3), seed)
        position_m, rotation_deg = errors(georeference(path, track, LEVEL_DEG), straight)
        assert 0.001 < position_m < 0.05
        assert rotation_deg < 0.3
        _, by_positions_deg = errors(umeyama_alignment(camera_centres(path), track.positions_m), straight)
        assert by_positions_deg > 1.0  # they do not see the roll


def test_a_bend_outweighs_the_level_prior(make_world):
    banked = make_world(keyframes=60, points=10, step_m=2.0, radius_m=25.0, roll_rad=np.radians(2.0))
    _, rotation_deg = errors(georeference(*along(banked, 0.03), LEVEL_DEG), banked)
    assert rotation_deg < 0.3


def test_too_few_fixes_are_refused_in_one_line(bend):
    path, track = along(bend, 0.05)
    with pytest.raises(DriveError, match=r"^only 2 of 40 GNSS fixes lie between posed images; 3 are needed$"):
        georeference(path[:2], track, LEVEL_DEG)
    with pytest.raises(DriveError, match=r"^only 0 of 40 GNSS fixes"):
        georeference([], track, LEVEL_DEG)


def test_a_drive_too_short_for_its_receiver_is_refused_in_one_line(bend):
    path, track = along(bend, 1.5)
    with pytest.raises(
        DriveError, match=r"^the fixes span only \d+\.\d m at 1\.50 m accuracy; .*at least 15 m\)$"
    ):
        georeference(path[:5], track, LEVEL_DEG)


# --- fixes as the recording has them


def fix_at(utm: np.ndarray, stamp_ns: int = T0_NS, covariance: np.ndarray | None = None) -> GnssFix:
    lat, lon, height = UtmGrid(32632).to_geodetic(utm)
    return GnssFix(
        stamp_ns, float(lat), float(lon), float(height), np.eye(3) if covariance is None else covariance
    )


def test_fixes_become_map_points_about_an_anchor_of_whole_metres():
    utm = np.array([[678_123.75, 5_404_987.25, 431.5], [678_140.25, 5_404_990.5, 432.0]])
    track = gnss_track([fix_at(p, T0_NS + i) for i, p in enumerate(utm)], ARM)
    assert track.anchor == UtmAnchor(32632, 678_123, 5_404_987, 431)
    np.testing.assert_allclose(track.anchor.utm_from_map(track.positions_m), utm, atol=1e-6)
    assert len(track) == 2


def test_covariances_turn_with_the_grid():
    """Here grid north stands 1.8 degrees off true north, and uncertainty stands with the truth."""
    utm = np.array([678_600.0, 5_404_900.0, 430.0])
    sigmas = np.array([1.0, 0.1, 2.0])
    fix = fix_at(utm, covariance=np.diag(sigmas**2))
    covariance = gnss_track([fix], ARM).covariances_m2[0]
    values, vectors = np.linalg.eigh(covariance)
    np.testing.assert_allclose(np.sqrt(values), np.sort(sigmas), rtol=1e-9)
    true_east_in_grid = (
        UtmGrid(32632).from_geodetic(np.array(fix.lat_deg), np.array(fix.lon_deg + 1e-4), np.array(430.0)) - utm
    )
    true_east_in_grid /= np.linalg.norm(true_east_in_grid)
    assert abs(np.degrees(np.arctan2(true_east_in_grid[1], true_east_in_grid[0]))) > 1.5
    assert abs(vectors[:, 1] @ true_east_in_grid) == pytest.approx(1.0, abs=1e-6)


def test_a_drive_over_a_zones_border_stays_in_the_zone_of_its_first_fix():
    west, east = (GnssFix(T0_NS + i, 48.0, lon, 400.0, np.eye(3)) for i, lon in enumerate((11.9999, 12.0001)))
    for first, second, epsg in ((west, east, 32632), (replace(east, stamp_ns=T0_NS), west, 32633)):
        track = gnss_track([first, second], ARM)
        assert track.anchor.epsg == epsg
        assert np.linalg.norm(track.positions_m[1] - track.positions_m[0]) == pytest.approx(14.9, abs=0.1)


def test_a_recording_without_fixes_is_refused_in_one_line():
    with pytest.raises(DriveError, match=r"^the recording has no usable GNSS fix .*; a map needs them"):
        gnss_track([], ARM)


# --- the camera at the fixes' own times

MS = 1_000_000


def track_at(*times_ms: int) -> GnssTrack:
    stamps = T0_NS + np.array(times_ms, dtype=np.int64) * MS
    count = len(times_ms)
    return GnssTrack(ANCHOR, stamps, np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1)), np.zeros(3))


def poses_at(*times_ms: int) -> tuple[np.ndarray, list[Pose]]:
    """A camera at 10 m/s that turns by 0.2 rad/s about its own y axis."""
    stamps = T0_NS + np.array(times_ms, dtype=np.int64) * MS
    seconds = np.array(times_ms) * 1e-3
    return stamps, [Pose(so3_exp(np.array([0.0, 0.2 * t, 0.0])), np.array([10.0 * t, 0.0, 0.0])) for t in seconds]


def test_a_fix_is_held_against_the_camera_at_its_own_time():
    points = path_at_fixes(*poses_at(0, 100, 200), track_at(0, 37, 100, 163, 200))
    assert [point.fix for point in points] == [0, 1, 2, 3, 4]
    for point, seconds in zip(points, (0.0, 0.037, 0.1, 0.163, 0.2), strict=True):
        np.testing.assert_allclose(point.pose.translation_m, [10.0 * seconds, 0.0, 0.0], atol=1e-6)
        np.testing.assert_allclose(point.pose.rotation, so3_exp(np.array([0.0, 0.2 * seconds, 0.0])), atol=1e-9)


def test_fixes_outside_the_posed_images_are_left_out():
    assert path_at_fixes(*poses_at(100, 200), track_at(0, 99, 201, 900)) == []
    assert path_at_fixes(*poses_at(), track_at(0)) == []


@pytest.mark.parametrize(("gap_ms", "used"), [(499, True), (500, True), (501, False), (5000, False)])
def test_a_fix_between_images_more_than_half_a_second_apart_is_left_out(gap_ms, used):
    points = path_at_fixes(*poses_at(0, 100, 100 + gap_ms, 200 + gap_ms), track_at(50, 150, 150 + gap_ms))
    assert [point.fix for point in points] == ([0, 1, 2] if used else [0, 2])


def test_a_fix_at_an_image_counts_also_beside_a_gap():
    assert [p.fix for p in path_at_fixes(*poses_at(0, 3000), track_at(0, 1500, 3000))] == [0, 2]
