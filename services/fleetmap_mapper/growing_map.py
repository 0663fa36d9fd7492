"""The map while it is being made: keyframes and landmarks in the free-scale frame ``vis``.

Who saw what is kept once, in each keyframe's ``landmark_of``. Landmarks live in parallel arrays that grow by
doubling; a dead landmark keeps its row and is skipped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap.vision.features import Features

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

    def landmarks(self) -> Ids:
        """Ids of the landmarks seen here."""
        return self.landmark_of[self.landmark_of >= 0]


class GrowingMap:
    """Keyframes and landmarks, and the bookkeeping between them."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.keyframes: list[Keyframe] = []
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

    def add_keyframe(
        self, frame_index: int, stamp_ns: int, vis_from_cam: Pose, features: Features, landmark_of: Ids
    ) -> Keyframe:
        """Append a keyframe."""
        keyframe = Keyframe(
            len(self.keyframes), frame_index, stamp_ns, vis_from_cam, features, landmark_of.astype(np.int32)
        )
        self.keyframes.append(keyframe)
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
        self.reference[ids] = second.index
        self.visible[ids] = self.found[ids] = 1
        first.landmark_of[first_feature] = ids
        second.landmark_of[second_feature] = ids
        self.refresh(ids, [first, second])
        return ids

    def refresh(self, ids: Ids, observers: list[Keyframe]) -> None:
        """Renew what is derived from the observations of some landmarks: normal, descriptor, octave, distance."""
        wanted = np.zeros(self.landmark_count, np.bool_)
        wanted[ids] = True
        sums = np.zeros((self.landmark_count, 3))
        for keyframe in sorted(observers, key=lambda k: k.index):
            features = np.flatnonzero(keyframe.landmark_of >= 0)
            seen = keyframe.landmark_of[features]
            features, seen = features[wanted[seen]], seen[wanted[seen]]
            rays = keyframe.vis_from_cam.translation_m - self.points[seen]
            lengths = np.linalg.norm(rays, axis=1)
            sums[seen] += rays / lengths[:, None]
            self.descriptors[seen] = keyframe.features.descriptors[features]
            self.octaves[seen] = keyframe.features.octaves[features]
            self.distances[seen] = lengths
        seen_at_all = wanted & (np.abs(sums).sum(axis=1) > 0)
        self.normals[: self.landmark_count][seen_at_all] = (
            sums[seen_at_all] / np.linalg.norm(sums[seen_at_all], axis=1)[:, None]
        )

    def kill(self, ids: Ids) -> None:
        """Forget landmarks."""
        self.alive[ids] = False
        for keyframe in self.keyframes:
            dead = (keyframe.landmark_of >= 0) & ~self.alive[np.maximum(keyframe.landmark_of, 0)]
            keyframe.landmark_of[dead] = -1

    def merge(self, lost: Ids, kept: Ids) -> None:
        """Fuse pairs of landmarks: every observation of ``lost[n]`` becomes one of ``kept[n]``."""
        target = np.arange(self.landmark_count, dtype=np.int32)
        for a, b in zip(lost.tolist(), kept.tolist(), strict=True):
            a, b = _end(target, a), _end(target, b)
            if a != b:
                target[a] = b
                self.found[b] += self.found[a]
                self.visible[b] += self.visible[a]
        gone = np.flatnonzero(target != np.arange(self.landmark_count))
        target[gone] = [_end(target, int(i)) for i in gone]
        self.merged_into[gone] = target[gone]
        self.alive[gone] = False
        is_target = np.zeros(self.landmark_count + 1, np.bool_)  # the last entry stands for "no landmark"
        is_target[target[gone]] = True
        following = np.append(target, np.int32(-1))
        for keyframe in self.keyframes:
            renamed = following[keyframe.landmark_of]
            if np.any(renamed != keyframe.landmark_of):
                keyframe.landmark_of = renamed
                _drop_repeats(keyframe.landmark_of, np.flatnonzero(is_target[renamed]))

    def resolve(self, ids: Ids) -> Ids:
        """What became of landmarks that were fused since; -1 for those that died."""
        current = ids.astype(np.int64)
        while True:
            following = self.merged_into[current]
            if np.array_equal(following, current):
                return np.where(self.alive[current], current, -1).astype(np.int32)
            current = following

    def covisible(self, landmark_ids: Ids, among: list[Keyframe] | None = None) -> list[tuple[Keyframe, int]]:
        """Keyframes that see any of the landmarks, with how many, most first (newest first at a tie)."""
        mark = np.zeros(self.landmark_count + 1, np.bool_)  # the last entry stands for "no landmark"
        mark[landmark_ids] = True
        keyframes = self.keyframes if among is None else among
        counts = [(k, int(np.count_nonzero(mark[k.landmark_of]))) for k in keyframes]
        return sorted((c for c in counts if c[1] > 0), key=lambda c: (-c[1], -c[0].index))

    def landmarks_of(self, keyframes: list[Keyframe]) -> Ids:
        """Ids of all living landmarks that the keyframes see."""
        mark = np.zeros(self.landmark_count, np.bool_)
        for keyframe in keyframes:
            mark[keyframe.landmarks()] = True
        return np.flatnonzero(mark & self.alive[: self.landmark_count]).astype(np.int32)

    def observation_counts(self) -> NDArray[np.int64]:
        """Number of keyframes that see each landmark."""
        counts = np.zeros(self.landmark_count, np.int64)
        for keyframe in self.keyframes:
            counts[keyframe.landmarks()] += 1
        return counts

    def reserve(self, count: int) -> None:
        """Make room for so many landmarks."""
        missing = count - len(self.points)
        if missing <= 0:
            return
        more = max(missing, len(self.points))
        for name in _LANDMARK_ARRAYS:
            array = getattr(self, name)
            setattr(self, name, np.concatenate([array, np.zeros((more, *array.shape[1:]), array.dtype)]))


def _end(target: Ids, index: int) -> int:
    while target[index] != index:
        index = int(target[index])
    return index


def _drop_repeats(landmark_of: Ids, rows: NDArray[np.intp]) -> None:
    """After a fusion an image may hold one landmark twice, in some of these rows: keep the first feature."""
    _, first = np.unique(landmark_of[rows], return_index=True)
    repeated = np.ones(len(rows), np.bool_)
    repeated[first] = False
    landmark_of[rows[repeated]] = -1
