"""Light alignment while mapping: keyframes are carried towards the fixes, evenly, and never without fixes."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Pose, umeyama_alignment
from fleetmap.vision.features import Features
from fleetmap_mapper.alignment import GnssAligner
from fleetmap_mapper.georeferencing import GnssTrack
from fleetmap_mapper.growing_map import GrowingMap
from fleetmap_mapper.settings import GnssGroup, MapperSettings, MappingGroup
from fleetmap_mapper.slam import PosedFrame


def covariances(count: int, sigma_m: float) -> np.ndarray:
    return np.tile(np.diag([1.0, 1.0, 4.0]) * sigma_m**2, (count, 1, 1))


# --- after a keyframe of a growing map


@pytest.fixture
def growing_with_path(make_world):
    world = make_world(keyframes=10, points=200, step_m=2.0)
    return world, *growing_along(world)


def growing_along(world):
    """A map whose scale is a fifth of the world's, and its keyframes as posed frames."""
    growing = GrowingMap(world.camera)
    for k, pose in enumerate(world.poses):
        rows = np.flatnonzero(world.keyframe_index == k)
        features = Features(
            world.pixels[rows],
            np.zeros(len(rows), np.uint8),
            np.zeros((len(rows), 32), np.uint8),
            np.zeros(len(rows), np.float32),
            1.2,
        )
        in_vis = Pose(pose.rotation, pose.translation_m / 5.0)
        growing.add_keyframe(k, k * 10**9, in_vis, features, world.point_index[rows])
    count = len(world.points)
    growing.reserve(count)
    growing.landmark_count = count
    growing.points[:count] = world.points / 5.0
    growing.alive[:count] = True
    growing.merged_into[:count] = np.arange(count)
    for k in range(len(world.poses)):
        growing.reference[growing.keyframes[k].landmark_of] = k
    posed = [
        PosedFrame(
            k.frame_index, k.stamp_ns, k, Pose.identity(), np.zeros(0, np.int32), np.zeros((0, 2)), np.zeros(0)
        )
        for k in growing.keyframes
    ]
    return growing, posed


def track_of(positions: np.ndarray, stamps_ns: np.ndarray) -> GnssTrack:
    return GnssTrack(
        UtmAnchor(32632, 0, 0, 0), stamps_ns, positions, covariances(len(positions), 0.01), np.zeros(3)
    )


@pytest.mark.parametrize("fixes", [1, 2])
def test_while_fixes_do_not_determine_s_nothing_moves(growing_with_path, fixes):
    world, growing, posed = growing_with_path
    before = [k.vis_from_cam for k in growing.keyframes], growing.points.copy()
    track = track_of(world.centres[:fixes], np.arange(fixes) * 10**9)
    GnssAligner(track, MapperSettings())(growing, posed)
    assert [k.vis_from_cam for k in growing.keyframes] == before[0]
    np.testing.assert_array_equal(growing.points, before[1])


def test_between_two_alignments_nothing_moves(growing_with_path):
    world, growing, posed = growing_with_path
    growing.keyframes.pop()
    before = [k.vis_from_cam for k in growing.keyframes]
    GnssAligner(track_of(world.centres * 1.1, np.arange(10) * 10**9), MapperSettings())(growing, posed[:9])
    assert [k.vis_from_cam for k in growing.keyframes] == before


def test_every_fifth_keyframe_the_map_is_carried_towards_its_fixes(growing_with_path):
    """The path has drifted up and down by 0.3 m; the fixes know better, and landmarks follow."""
    world, growing, posed = growing_with_path
    bend = 0.3 / 5.0 * np.sin(np.arange(10) * 2.0 * np.pi / 9.0)
    for keyframe, rise in zip(growing.keyframes, bend, strict=True):
        pose = keyframe.vis_from_cam
        keyframe.vis_from_cam = Pose(pose.rotation, pose.translation_m + np.array([0.0, 0.0, rise]))
    growing.points[: growing.landmark_count, 2] += bend[growing.reference[: growing.landmark_count]]

    def misfit_m() -> float:
        centres = np.array([k.vis_from_cam.translation_m for k in growing.keyframes])
        S = umeyama_alignment(centres, world.centres)
        return float(np.linalg.norm(S.transform(centres) - world.centres, axis=1).mean())

    before_m = misfit_m()
    GnssAligner(track_of(world.centres, np.arange(10) * 10**9), MapperSettings())(growing, posed)
    assert before_m > 0.1
    assert 0.0 < misfit_m() < 0.6 * before_m


def test_only_the_latest_keyframes_and_their_landmarks_move(make_world):
    world = make_world(keyframes=40, points=800, step_m=2.0)
    growing, posed = growing_along(world)
    centres = np.array([k.vis_from_cam.translation_m for k in growing.keyframes])
    points = growing.points.copy()
    bent = world.centres + 0.3 * np.sin(np.arange(40) / 3.0)[:, None] * np.array([0.0, 0.0, 1.0])
    settings = MapperSettings(gnss=GnssGroup(align_window=10), mapping=MappingGroup(window=4))
    GnssAligner(track_of(bent, np.arange(40) * 10**9), settings)(growing, posed)
    moved = np.linalg.norm([k.vis_from_cam.translation_m for k in growing.keyframes] - centres, axis=1)
    assert np.all(moved[:30] == 0.0)
    assert np.all(moved[32:] > 0.0)
    behind = np.setdiff1d(
        growing.landmarks_of(growing.keyframes[:20]), growing.landmarks_of(growing.keyframes[20:])
    )
    assert len(behind) > 20
    np.testing.assert_array_equal(growing.points[behind], points[behind])


def shrunk_after(world, growing, posed, first: int, scale: float) -> None:
    """From a keyframe on the map has lost scale, with its landmarks, as monocular vision does in a corner."""
    centre = growing.keyframes[first].vis_from_cam.translation_m.copy()
    for keyframe in growing.keyframes[first:]:
        pose = keyframe.vis_from_cam
        keyframe.vis_from_cam = Pose(pose.rotation, centre + scale * (pose.translation_m - centre))
    rows = np.flatnonzero(growing.reference[: growing.landmark_count] >= first)
    growing.points[rows] = centre + scale * (growing.points[rows] - centre)


def aligned(world, spoil=lambda positions: None, fixes=slice(None)):
    growing, posed = growing_along(world)
    shrunk_after(world, growing, posed, 20, 0.94)
    positions = world.centres.copy()
    spoil(positions)
    stamps_ns = np.arange(40) * 10**9
    settings = MapperSettings(mapping=MappingGroup(window=4))
    GnssAligner(track_of(positions[fixes], stamps_ns[fixes]), settings)(growing, posed)
    centres = np.array([p.vis_from_cam.translation_m for p in posed])
    S = umeyama_alignment(centres, world.centres)
    errors = np.linalg.norm(S.transform(centres) - world.centres, axis=1)
    steps = np.linalg.norm(np.diff(S.transform(centres), axis=0), axis=1)
    return float(errors.mean()), steps, growing, S


@pytest.fixture(scope="module")
def forty(make_world):
    return make_world(keyframes=40, points=800, step_m=2.0)


def test_lost_scale_is_given_back_and_landmarks_follow(forty):
    mean_m, steps, growing, S = aligned(forty)
    assert 0.0 < mean_m < 0.1
    np.testing.assert_allclose(steps, 2.0, atol=0.15)
    alive = growing.reference[: growing.landmark_count] >= 22
    placed = S.transform(growing.points[: growing.landmark_count][alive])
    assert np.median(np.linalg.norm(placed - forty.points[alive], axis=1)) < 0.4


def test_a_stretch_without_fixes_is_crossed_smoothly(forty):
    """Fixes fail from 24 to 48 m; scale was lost at 40 m. The corrections bend the path, they do not break it."""
    tunnel = np.r_[0:12, 24:40]
    mean_m, steps, _, _ = aligned(forty, fixes=tunnel)
    assert 0.0 < mean_m < 0.3
    assert np.abs(np.diff(steps)).max() < 0.2


def test_fixes_that_are_far_off_do_not_move_the_map(forty):
    def spoil(positions):
        positions[[3, 9, 16, 29, 36]] += [[9, 4, 2], [-20, 3, 1], [0, 30, 5], [-8, 1, 0], [12, -12, 3]]

    clean_m, *_ = aligned(forty)
    mean_m, *_ = aligned(forty, spoil)
    assert 0.0 < mean_m < 1.5 * clean_m + 0.02
