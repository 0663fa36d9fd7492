"""The bookkeeping between keyframes and landmarks holds, whatever is added, fused and forgotten."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, so3_exp
from fleetmap.vision.features import Features
from fleetmap_mapper.growing_map import GrowingMap, Keyframe

CAMERA = Camera(640, 400, 430.0, 435.0, 322.0, 197.0)
FEATURES = 40


def features(seed: int, count: int = FEATURES) -> Features:
    rng = np.random.default_rng(seed)
    return Features(
        rng.uniform(0.0, 400.0, (count, 2)),
        rng.integers(0, 8, count).astype(np.uint8),
        rng.integers(0, 256, (count, 32), dtype=np.uint8),
        np.zeros(count, np.float32),
        1.2,
    )


def add_keyframe(growing: GrowingMap) -> Keyframe:
    index = len(growing.keyframes)
    pose = Pose(so3_exp(np.array([0.0, 0.05 * index, 0.0])), np.array([0.3 * index, 0.0, 0.0]))
    return growing.add_keyframe(3 * index, index * 10**8, pose, features(index), np.full(FEATURES, -1, np.int32))


def add_landmarks(growing: GrowingMap, first: Keyframe, second: Keyframe, count: int) -> np.ndarray:
    """Landmarks on the first features of two keyframes that hold none yet."""
    a, b = (np.flatnonzero(k.landmark_of < 0)[:count] for k in (first, second))
    count = min(len(a), len(b))
    points = np.random.default_rng(growing.landmark_count).uniform(5.0, 20.0, (count, 3))
    return growing.add_landmarks(points, first, a[:count], second, b[:count])


def observers(growing: GrowingMap, landmark: int) -> set[int]:
    return {k.index for k in growing.keyframes if landmark in k.landmark_of}


@pytest.fixture
def growing() -> GrowingMap:
    made = GrowingMap(CAMERA)
    keyframes = [add_keyframe(made) for _ in range(4)]
    for first, second in ((0, 1), (1, 2), (2, 3)):
        add_landmarks(made, keyframes[first], keyframes[second], 6)
    return made


def test_new_landmarks_are_seen_by_both_and_carried_by_the_newer(growing):
    ids = growing.landmarks_of([growing.keyframes[0]])
    assert ids.tolist() == [0, 1, 2, 3, 4, 5]
    assert observers(growing, 3) == {0, 1}
    assert set(growing.reference[ids]) == {1}
    ray = growing.keyframes[1].vis_from_cam.translation_m - growing.points[3]
    assert growing.distances[3] == pytest.approx(np.linalg.norm(ray))
    feature = int(np.flatnonzero(growing.keyframes[1].landmark_of == 3)[0])
    np.testing.assert_array_equal(growing.descriptors[3], growing.keyframes[1].features.descriptors[feature])
    np.testing.assert_allclose(np.linalg.norm(growing.normals[ids], axis=1), 1.0, atol=1e-12)


def test_a_fused_landmark_has_the_observations_of_both(growing):
    found, visible = growing.found[[0, 7]].sum(), growing.visible[[0, 7]].sum()
    growing.merge(np.array([7]), np.array([0]))
    assert observers(growing, 0) == {0, 1, 2}
    assert observers(growing, 7) == set()
    assert growing.resolve(np.array([7, 0, 8], np.int32)).tolist() == [0, 0, 8]
    assert (growing.found[0], growing.visible[0]) == (found, visible)


def test_an_image_keeps_one_feature_of_a_landmark_fused_with_its_neighbour(growing):
    growing.merge(np.array([1]), np.array([0]))  # both seen by keyframes 0 and 1
    for keyframe in growing.keyframes[:2]:
        assert np.count_nonzero(keyframe.landmark_of == 0) == 1


def test_chains_and_circles_of_fusions_end_in_one_landmark(growing):
    growing.merge(np.array([0, 6, 12, 0]), np.array([6, 12, 0, 12]))
    survivors = set(growing.resolve(np.array([0, 6, 12], np.int32)).tolist())
    assert len(survivors) == 1
    assert observers(growing, survivors.pop()) == {0, 1, 2, 3}


def test_what_is_forgotten_is_nowhere(growing):
    growing.kill(np.array([0, 1, 9], np.int32))
    assert growing.resolve(np.array([0, 1, 2, 9], np.int32)).tolist() == [-1, -1, 2, -1]
    assert growing.landmarks_of(growing.keyframes).tolist() == sorted(set(range(18)) - {0, 1, 9})
    assert growing.observations[[0, 1, 9]].tolist() == [0, 0, 0]


def test_an_observation_taken_out_is_counted_out(growing):
    growing.take_touched()
    growing.forget(growing.keyframes[1], np.flatnonzero(growing.keyframes[1].landmark_of == 8))
    assert observers(growing, 8) == {2}
    assert growing.observations[[7, 8]].tolist() == [2, 1]
    assert growing.take_touched().tolist() == [8]
    assert growing.take_touched().tolist() == []


def test_covisible_keyframes_come_most_shared_first(growing):
    wanted = np.array([0, 1, 2, 6, 12], np.int32)
    assert [(k.index, n) for k, n in growing.covisible(wanted)] == [(1, 4), (0, 3), (2, 2), (3, 1)]
    assert growing.covisible(np.array([], np.int32)) == []


def test_keyframes_out_of_sight_are_not_looked_at():
    """What a keyframe costs must not grow with the length of the drive."""
    growing = GrowingMap(CAMERA)
    add_keyframe(growing)
    for _ in range(200):
        older, newer = growing.keyframes[-1], add_keyframe(growing)
        add_landmarks(growing, older, newer, 10)
    growing.take_touched()
    for keyframe in growing.keyframes[:190]:
        keyframe.landmark_of = None
    recent = growing.landmarks_of(growing.keyframes[-3:])
    assert recent.tolist() == list(range(1970, 2000))
    assert [k.index for k, _ in growing.covisible(recent)] == [199, 198, 200, 197]
    growing.merge(recent[20:22], recent[10:12])
    growing.kill(recent[:5])
    growing.refresh(recent[5:], growing.keyframes[-4:])
    assert growing.take_touched().tolist() == recent[10:12].tolist()


@given(st.lists(st.integers(1, 900), min_size=1, max_size=5))
def test_room_grows_without_losing_anything(sizes):
    growing = GrowingMap(CAMERA)
    total = 0
    for size in sizes:
        a, b = (
            growing.add_keyframe(
                0, 0, Pose.identity(), features(len(growing.keyframes), size), np.full(size, -1, np.int32)
            )
            for _ in range(2)
        )
        points = np.full((size, 3), float(total + 1))
        rows = np.arange(size)
        growing.add_landmarks(points, a, rows, b, rows)
        total += size
        assert growing.points[total - 1, 0] == total - size + 1
    assert growing.landmark_count == total
    assert growing.points[0, 0] == 1.0
    assert growing.alive[:total].all()
    assert not growing.alive[total:].any()
    np.testing.assert_array_equal(growing.merged_into[:total], np.arange(total))


class MapStories(RuleBasedStateMachine):
    """Any story of keyframes, landmarks, fusions and deaths, beside a plain model of who saw what."""

    @initialize()
    def begin(self) -> None:
        self.growing = GrowingMap(CAMERA)
        for _ in range(2):
            add_keyframe(self.growing)
        self.seen: dict[int, set[int]] = {}
        self.became: dict[int, int] = {}

    @rule()
    def a_keyframe_comes(self) -> None:
        add_keyframe(self.growing)

    @rule(data=st.data(), count=st.integers(1, 5))
    def two_keyframes_see_something_new(self, data: st.DataObject, count: int) -> None:
        every = st.integers(0, len(self.growing.keyframes) - 1)
        pair = data.draw(st.lists(every, min_size=2, max_size=2, unique=True))
        first, second = (self.growing.keyframes[k] for k in sorted(pair))
        for landmark in add_landmarks(self.growing, first, second, count).tolist():
            self.seen[landmark] = {first.index, second.index}

    @rule(data=st.data())
    def landmarks_turn_out_to_be_one(self, data: st.DataObject) -> None:
        living = sorted(self.seen)
        if len(living) < 2:
            return
        pairs = data.draw(st.lists(st.tuples(*[st.sampled_from(living)] * 2), min_size=1, max_size=4))
        lost, kept = (np.array(side, np.int32) for side in zip(*pairs, strict=True))
        self.growing.merge(lost, kept)
        for a, b in pairs:
            a, b = self._end(a), self._end(b)
            if a != b:
                self.seen[b] |= self.seen.pop(a)
                self.became[a] = b

    @rule(data=st.data())
    def some_are_forgotten(self, data: st.DataObject) -> None:
        if not self.seen:
            return
        dead = data.draw(st.lists(st.sampled_from(sorted(self.seen)), max_size=3, unique=True))
        self.growing.kill(np.array(dead, np.int32))
        for landmark in dead:
            del self.seen[landmark]

    @invariant()
    def keyframes_hold_each_living_landmark_once_and_no_other(self) -> None:
        held = [Counter(k.landmarks().tolist()) for k in self.growing.keyframes]
        assert all(count == 1 for one in held for count in one.values())
        assert {i: {k for k, one in enumerate(held) if i in one} for one in held for i in one} == self.seen

    @invariant()
    def every_landmark_that_ever_was_resolves_to_what_it_became(self) -> None:
        ids = np.arange(self.growing.landmark_count, dtype=np.int32)
        ends = [self._end(int(i)) for i in ids]
        expected = [end if end in self.seen else -1 for end in ends]
        assert self.growing.resolve(ids).tolist() == expected

    @invariant()
    def counts_agree(self) -> None:
        counts = self.growing.observations[: self.growing.landmark_count]
        assert counts.tolist() == [len(self.seen.get(i, ())) for i in range(len(counts))]
        shared = self.growing.covisible(np.array(sorted(self.seen), np.int32))
        assert {k.index: n for k, n in shared} == dict(Counter(k for ks in self.seen.values() for k in ks))

    @invariant()
    def every_observer_is_in_the_range_its_landmark_knows(self) -> None:
        for landmark, keyframes in self.seen.items():
            assert self.growing.oldest[landmark] <= min(keyframes, default=0)
            assert self.growing.newest[landmark] >= max(keyframes, default=0)

    def _end(self, landmark: int) -> int:
        while landmark in self.became:
            landmark = self.became[landmark]
        return landmark


TestMapStories = MapStories.TestCase
TestMapStories.settings = settings(max_examples=100, stateful_step_count=20, deadline=None)
