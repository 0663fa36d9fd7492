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
