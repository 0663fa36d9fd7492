"""The map while it is being made: keyframes and landmarks in the free-scale frame ``vis``.

Who saw what is kept once, in each keyframe's ``landmark_of``. Landmarks live in parallel arrays that grow by
doubling; a dead landmark keeps its row and is skipped. Each knows the range of keyframes that may hold it, so
that no step has to look at the whole drive.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap.vision.features import Features
from fleetmap_mapper.bookkeeping import (
    add_views,
    count_marked,
    distinct_living,
    follow_fusions,
    fuse_pairs,
    marked_features,
)

Array = NDArray[np.float64]
Ids = NDArray[np.int32]

SCALE_FACTOR = 1.2
_LANDMARK_ARRAYS = (
    "points",
    "normals",
    "descriptors",
    "octaves",
    "distances",
    "reference",
    "visible",
    "found",
    "alive",
    "merged_into",
    "observations",
    "oldest",
    "newest",
    "_marks",
)


@dataclass
class Keyframe:
    """One image of the map; pose and associations change while mapping."""

    index: int
    frame_index: int
    stamp_ns: int
    vis_from_cam: Pose
    features: Features
    landmark_of: Ids  # (N,) landmark of each feature, -1 for none
    noise: Array  # (N,) factor on each feature's sigma
    is_aligned: NDArray[np.bool_]  # (N,) whether its pixel comes from aligning patches, or is a corner's

    def landmarks(self) -> Ids:
        """Ids of the landmarks seen here."""
        return self.landmark_of[self.landmark_of >= 0]


class GrowingMap:
    """Keyframes and landmarks, and the bookkeeping between them."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.keyframes: list[Keyframe] = []
        self.track_correlation = 0.0  # of errors from one observation of a landmark to the next
        self.landmark_count = 0
        self.points: Array = np.zeros((1024, 3))
        self.normals: Array = np.zeros((1024, 3))  # mean unit vector from landmark to observers
        self.descriptors: NDArray[np.uint8] = np.zeros((1024, 32), np.uint8)  # of the latest observation
        self.octaves: NDArray[np.int64] = np.zeros(1024, np.int64)  # of the latest observation
        self.distances: Array = np.zeros(1024)  # from the latest observer
        self.reference: NDArray[np.int64] = np.zeros(1024, np.int64)  # keyframe that carries the landmark
        self.visible: NDArray[np.int64] = np.zeros(1024, np.int64)  # frames that should have seen it
        self.found: NDArray[np.int64] = np.zeros(1024, np.int64)  # frames that did
        self.alive: NDArray[np.bool_] = np.zeros(1024, np.bool_)
        self.merged_into: NDArray[np.int64] = np.zeros(1024, np.int64)  # itself unless fused with another
        self.observations: NDArray[np.int64] = np.zeros(1024, np.int64)  # keyframes that see it
        self.oldest: NDArray[np.int64] = np.zeros(1024, np.int64)  # no keyframe before this one has seen it
        self.newest: NDArray[np.int64] = np.zeros(1024, np.int64)  # and none after this one
        self._marks: Ids = np.zeros(1024, np.int32)  # all zero between calls
        self._touched: list[Ids] = []

    def add_keyframe(
        self, frame_index: int, stamp_ns: int, vis_from_cam: Pose, features: Features, landmark_of: Ids
    ) -> Keyframe:
        """Append a keyframe that sees some landmarks already."""
        nothing = np.full(len(features), -1, np.int32)
        keyframe = Keyframe(
            len(self.keyframes),
            frame_index,
            stamp_ns,
            vis_from_cam,
            features,
            nothing,
            np.ones(len(features)),
            np.zeros(len(features), np.bool_),
        )
        self.keyframes.append(keyframe)
        rows = np.flatnonzero(landmark_of >= 0)
        self.observe(keyframe, rows, landmark_of[rows].astype(np.int32))
        return keyframe

    def add_landmarks(
        self, points: Array, first: Keyframe, first_feature: Ids, second: Keyframe, second_feature: Ids
    ) -> Ids:
        """Append landmarks (n, 3) seen by two keyframes; ``second`` is the newer and becomes their reference."""
        ids = np.arange(self.landmark_count, self.landmark_count + len(points), dtype=np.int32)
        self.reserve(self.landmark_count + len(points))
        self.landmark_count += len(points)
        self.points[ids] = points
        self.alive[ids] = True
        self.merged_into[ids] = ids
        self.reference[ids] = self.oldest[ids] = self.newest[ids] = second.index
        self.visible[ids] = self.found[ids] = 1
        self.observe(first, first_feature, ids)
        self.observe(second, second_feature, ids)
        self.touch(ids)
        self.refresh(ids, [first, second])
        return ids

    def observe(self, keyframe: Keyframe, features: NDArray[np.integer], landmarks: Ids) -> None:
        """Enter that features (n,) of a keyframe, which hold nothing yet, show landmarks (n,), each once."""
        keyframe.landmark_of[features] = landmarks
        self.observations[landmarks] += 1
        self.oldest[landmarks] = np.minimum(self.oldest[landmarks], keyframe.index)
        self.newest[landmarks] = np.maximum(self.newest[landmarks], keyframe.index)

    def forget(self, keyframe: Keyframe, features: NDArray[np.integer]) -> None:
        """Take observations (n,) out of a keyframe."""
        landmarks = keyframe.landmark_of[features]
        keyframe.landmark_of[features] = -1
        self.observations[landmarks] -= 1
        self.touch(landmarks)

    def count_sighting(self, expected: Ids, found: Ids) -> None:
        """A frame should have seen some landmarks, and found some."""
        self.visible[expected] += 1
        self.found[found] += 1
        self.touch(expected)

    def touch(self, ids: Ids) -> None:
        """Put landmarks on the list of those that may have become doubtful."""
        self._touched.append(ids)

    def take_touched(self) -> Ids:
        """The living landmarks on that list, each once; it is empty afterwards."""
        touched = np.concatenate(self._touched) if self._touched else np.zeros(0, np.int32)
        self._touched = []
        return distinct_living(touched, self.alive)

    def refresh(self, ids: Ids, observers: list[Keyframe]) -> None:
        """Renew what is derived from the observations of some landmarks: normal, descriptor, octave, distance."""
        sums = np.zeros((len(ids), 3))
        with self._marked(ids):
            for keyframe in sorted(observers, key=lambda k: k.index):
                add_views(
                    keyframe.landmark_of,
                    keyframe.features.descriptors,
                    keyframe.features.octaves,
                    keyframe.vis_from_cam.translation_m,
                    self._marks,
                    self.points,
                    sums,
                    self.descriptors,
                    self.octaves,
                    self.distances,
                )
        seen = np.abs(sums).sum(axis=1) > 0
        self.normals[ids[seen]] = sums[seen] / np.linalg.norm(sums[seen], axis=1)[:, None]

    def kill(self, ids: Ids) -> None:
        """Forget landmarks."""
        self.alive[ids] = False
        self.observations[ids] = 0
        with self._marked(ids):
            for keyframe in self._holders(ids):
                keyframe.landmark_of[marked_features(keyframe.landmark_of, self._marks)] = -1

    def merge(self, lost: Ids, kept: Ids) -> None:
        """Fuse pairs of landmarks: every observation of ``lost[n]`` becomes one of ``kept[n]``."""
        tallies = self.found, self.visible, self.observations
        gone = np.sort(fuse_pairs(lost, kept, self.merged_into, tallies, self.oldest, self.newest))
        successors = self.merged_into[gone].astype(np.int32)
        self.alive[gone] = False
        self.observations[gone] = 0
        self.touch(successors)
        with self._marked(gone):
            self._marks[successors] = -np.arange(1, len(successors) + 1)
            for keyframe in self._holders(gone):
                follow_fusions(keyframe.landmark_of, self._marks, successors, self.observations)
            self._marks[successors] = 0

    def resolve(self, ids: Ids) -> Ids:
        """What became of landmarks that were fused since; -1 for those that died."""
        current = ids.astype(np.int64)
        while True:
            following = self.merged_into[current]
            if np.array_equal(following, current):
                return np.where(self.alive[current], current, -1).astype(np.int32)
            current = following

    def covisible(self, landmark_ids: Ids) -> list[tuple[Keyframe, int]]:
        """Keyframes that see any of the landmarks, with how many, most first (newest first at a tie)."""
        with self._marked(landmark_ids):
            counts = [(k, count_marked(k.landmark_of, self._marks)) for k in self._holders(landmark_ids)]
        return sorted((c for c in counts if c[1] > 0), key=lambda c: (-c[1], -c[0].index))

    def landmarks_of(self, keyframes: Sequence[Keyframe]) -> Ids:
        """Ids of all living landmarks that the keyframes see."""
        seen = np.concatenate([k.landmark_of for k in keyframes]) if keyframes else np.zeros(0, np.int32)
        return distinct_living(seen, self.alive)

    def not_seen_by(self, keyframe: Keyframe, landmarks: Ids) -> Ids:
        """Those of some landmarks that a keyframe does not see."""
        seen = keyframe.landmarks()
        with self._marked(seen):
            unseen: Ids = landmarks[self._marks[landmarks] == 0]
        return unseen

    def observations_of(self, landmarks: Ids, keyframes: list[Keyframe]) -> list[tuple[NDArray[np.int64], Ids]]:
        """For every keyframe the features (n,) that show some of the landmarks, and which of them (n,)."""
        with self._marked(landmarks):
            rows = [marked_features(k.landmark_of, self._marks) for k in keyframes]
            return [(r, self._marks[k.landmark_of[r]] - 1) for r, k in zip(rows, keyframes, strict=True)]

    def reserve(self, count: int) -> None:
        """Make room for so many landmarks."""
        missing = count - len(self.points)
        if missing <= 0:
            return
        more = max(missing, len(self.points))
        for name in _LANDMARK_ARRAYS:
            array = getattr(self, name)
            setattr(self, name, np.concatenate([array, np.zeros((more, *array.shape[1:]), array.dtype)]))

    @contextmanager
    def _marked(self, ids: Ids) -> Iterator[None]:
        """For compiled loops: ``_marks`` tells the place of each landmark in ``ids``, plus one."""
        self._marks[ids] = np.arange(1, len(ids) + 1)
        try:
            yield
        finally:
            self._marks[ids] = 0

    def _holders(self, ids: Ids) -> list[Keyframe]:
        """The keyframes among which are all that hold any of the landmarks."""
        if len(ids) == 0:
            return []
        return self.keyframes[self.oldest[ids].min() : self.newest[ids].max() + 1]
