"""Segments of one drive, each with a map and a frame of its own, become one map in the map frame."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, Sim3, so3_exp
from fleetmap.vision.features import Features
from fleetmap_mapper.growing_map import GrowingMap
from fleetmap_mapper.segments import join_segments
from fleetmap_mapper.slam import PosedFrame, Segment

CAMERA = Camera(640, 400, 430.0, 435.0, 322.0, 197.0)
FIRST_S = Sim3(2.0, so3_exp(np.array([0.1, -0.4, 0.2])), np.array([5.0, 6.0, 7.0]))
SECOND_S = Sim3(0.5, so3_exp(np.array([-0.3, 0.2, 0.9])), np.array([-50.0, 3.0, 1.0]))


def segment(first_frame: int, points: int, seed: int) -> Segment:
    """Two keyframes, the landmarks both see, and a posed frame after each of them that sees three and four."""
    rng = np.random.default_rng(seed)
    growing = GrowingMap(CAMERA)
    for k in range(2):
        features = Features(
            rng.uniform(0.0, 400.0, (points, 2)),
            np.zeros(points, np.uint8),
            rng.integers(0, 256, (points, 32), dtype=np.uint8),
            np.zeros(points, np.float32),
            1.2,
        )
        pose = Pose(so3_exp(rng.normal(0.0, 0.1, 3)), rng.normal(0.0, 2.0, 3))
        index = first_frame + 2 * k
        growing.add_keyframe(index, index * 10**8, pose, features, np.full(points, -1, np.int32))
    a, b = growing.keyframes
    rows = np.arange(points)
    growing.add_landmarks(rng.uniform(5.0, 20.0, (points, 3)), a, rows, b, rows)
    posed = []
    for number, keyframe in enumerate(growing.keyframes):
        seen = np.arange(3 + number, dtype=np.int32)
        index = keyframe.frame_index + 1
        motion = Pose(so3_exp(np.array([0.0, 0.02, 0.0])), np.array([0.1, 0.0, 0.4]))
        pixels = rng.uniform(0.0, 400.0, (len(seen), 2))
        posed.append(PosedFrame(index, index * 10**8, keyframe, motion, seen, pixels, np.ones(len(seen))))
    return Segment(growing, posed)


@pytest.fixture
def two() -> list[Segment]:
    return [segment(0, 6, 1), segment(10, 9, 2)]


def test_poses_and_points_are_where_their_own_s_puts_them(two):
    joined = join_segments(two, [FIRST_S, SECOND_S])
    assert [k.index for k in joined.growing.keyframes] == [0, 1, 2, 3]
    assert [k.frame_index for k in joined.growing.keyframes] == [0, 2, 10, 12]
    assert joined.growing.landmark_count == 6 + 9
    for number, S in ((0, FIRST_S), (1, SECOND_S)):
        first_keyframe, first_landmark = 2 * number, 6 * number
        old = two[number].growing
        for k, keyframe in enumerate(old.keyframes):
            moved, wanted = joined.growing.keyframes[first_keyframe + k], S.transform_pose(keyframe.vis_from_cam)
            np.testing.assert_allclose(moved.vis_from_cam.translation_m, wanted.translation_m)
            np.testing.assert_allclose(moved.vis_from_cam.rotation, wanted.rotation)
            np.testing.assert_array_equal(moved.landmark_of, keyframe.landmark_of + first_landmark)
        rows = slice(first_landmark, first_landmark + old.landmark_count)
        np.testing.assert_allclose(joined.growing.points[rows], S.transform(old.points[: old.landmark_count]))
        np.testing.assert_array_equal(joined.growing.reference[rows], first_keyframe + 1)
        frame, was = joined.posed[2 * number], two[number].posed[0]
        wanted = S.transform_pose(was.vis_from_cam)
        np.testing.assert_allclose(frame.vis_from_cam.translation_m, wanted.translation_m)
        np.testing.assert_allclose(frame.vis_from_cam.rotation, wanted.rotation)


def test_what_is_derived_agrees_with_deriving_it_anew(two):
    joined = join_segments(two, [FIRST_S, SECOND_S]).growing
    kept = {name: getattr(joined, name)[:15].copy() for name in ("normals", "distances", "descriptors", "octaves")}
    joined.refresh(np.arange(15, dtype=np.int32), joined.keyframes)
    for name, before in kept.items():
        np.testing.assert_allclose(getattr(joined, name)[:15], before, atol=1e-12)


def test_fused_and_dead_landmarks_stay_so(two):
    second = two[1].growing
    second.merge(np.array([0]), np.array([4]))
    second.kill(np.array([1], np.int32))
    joined = join_segments(two, [FIRST_S, SECOND_S])
    assert joined.growing.resolve(np.array([6, 7, 8, 10], np.int32)).tolist() == [10, -1, 8, 10]
    assert joined.posed[2].landmarks.tolist() == [10, 8]  # saw 0, 1 and 2 of its segment
    assert len(joined.posed[2].pixels) == len(joined.posed[2].sigmas_px) == 2


def test_an_image_posed_in_both_stays_where_more_is_seen(two):
    rival = segment(2, 9, 3)  # its images 3 and 5 see three and four landmarks; image 3 of the first sees four
    joined = join_segments([two[0], rival], [FIRST_S, SECOND_S])
    assert [(f.frame_index, len(f.landmarks)) for f in joined.posed] == [(1, 3), (3, 4), (5, 4)]
    assert joined.posed[1].keyframe.index == 1
    assert joined.posed[2].keyframe.index == 3


def test_the_segments_are_left_as_they_were(two):
    before = [(s.growing.points.copy(), s.growing.keyframes[0].vis_from_cam, s.posed[0].landmarks) for s in two]
    join_segments(two, [FIRST_S, SECOND_S])
    for s, (points, pose, landmarks) in zip(two, before, strict=True):
        np.testing.assert_array_equal(s.growing.points, points)
        assert s.growing.keyframes[0].vis_from_cam is pose
        assert s.posed[0].landmarks is landmarks
