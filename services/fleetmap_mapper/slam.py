"""Monocular keyframe SLAM over frames in order, in a free-scale frame ``vis``.

The parts follow the usual division (Mur-Artal et al., "ORB-SLAM", T-RO 2015): two-view initialisation,
tracking against the local map, keyframes, triangulation, fusion, local bundle adjustment, relocalisation.
A recorded drive is known whole, so frames before the first map are posed as well, backwards in time.
"""

from __future__ import annotations

from collections.abc import Callable, Reversible
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, interpolate_pose, rotation_angle_rad
from fleetmap.vision.features import Features
from fleetmap_mapper.growing_map import GrowingMap, Ids, Keyframe
from fleetmap_mapper.initialisation import map_from_two_views, match_two_views
from fleetmap_mapper.local_mapping import adjust_keyframes, extend_map
from fleetmap_mapper.settings import MapperSettings
from fleetmap_mapper.stage_times import StageTimes
from fleetmap_mapper.tracking import Tracked, relocalise, track

_YOUNG_MAP_KEYFRAMES = 5  # losing track of a younger map means that its first two views misled
_RELOCALISE_AGAINST = 10


@dataclass(frozen=True)
class PosedFrame:
    """A frame with what was seen in it; its pose hangs on a keyframe, so it moves when the map is adjusted."""

    frame_index: int
    stamp_ns: int
    keyframe: Keyframe
    keyframe_from_cam: Pose
    landmarks: Ids  # (n,)
    pixels: NDArray[np.float64]  # (n, 2) undistorted
    sigmas_px: NDArray[np.float64]  # (n,)

    @property
    def vis_from_cam(self) -> Pose:
        """The pose as the map stands now."""
        return self.keyframe.vis_from_cam @ self.keyframe_from_cam


@dataclass(frozen=True)
class Unposed:
    """A frame that waits for a map to be posed in."""

    frame_index: int
    stamp_ns: int
    features: Features


@dataclass(frozen=True)
class Segment:
    """A stretch of the drive with a map of its own, in a ``vis`` frame of its own."""

    growing: GrowingMap
    posed: list[PosedFrame]  # in time order


OnKeyframe = Callable[[GrowingMap, Reversible[PosedFrame]], None]  # the posed frames are in time order


class Slam:
    """The state of one run; feed it frames in order, then call ``finish``."""

    def __init__(
        self,
        camera: Camera,
        settings: MapperSettings,
        on_keyframe: OnKeyframe | None = None,
        times: StageTimes | None = None,
    ) -> None:
        self.growing = GrowingMap(camera)
        self.posed: dict[int, PosedFrame] = {}
        self.lost: list[Unposed] = []  # frames since tracking was lost
        self._settings = settings
        self._on_keyframe = on_keyframe
        self._times = times or StageTimes()
        self._waiting: list[Unposed] = []
        self._young: list[Unposed] = []  # frames posed in a map that may still prove wrong
        self._first: Unposed | None = None
        self._last: PosedFrame | None = None
        self._before_last: PosedFrame | None = None
        self._tracked_at_keyframe = 0

    @property
    def is_established(self) -> bool:
        """Whether the map has outgrown the suspicion that its first two views misled."""
        return len(self.growing.keyframes) >= _YOUNG_MAP_KEYFRAMES

    def register_frame(self, frame: Unposed) -> None:
        """Pose one frame; while there is no map, try to make one."""
        if not self.growing.keyframes:
            self._initialise(frame)
            return
        with self._times.stage("tracking"):
            tracked = self._track(frame)
        if tracked is None:
            self._waiting.append(frame)
            self.lost.append(frame)
            if not self.is_established:
                self._start_again(frame)
            return
        self.lost.clear()
        if self._is_keyframe(tracked):
            self._insert_keyframe(frame, tracked)
        else:
            self._remember(frame, tracked, self.growing.keyframes[-1])

    def finish(self) -> list[PosedFrame]:
        """Pose the frames that were left waiting; returns all posed frames in time order."""
        self._pose_waiting_frames()
        return [self.posed[index] for index in sorted(self.posed)]

    def _initialise(self, frame: Unposed) -> None:
        self._waiting.append(frame)
        if self._first is None or len(self._first.features) < self._settings.initialisation.min_matches:
            self._first = frame
            return
        pairs = match_two_views(self._first.features, frame.features)
        if len(pairs) < self._settings.initialisation.min_matches:
            self._first = frame
            return
        start = map_from_two_views(
            self.growing.camera, self._first.features, frame.features, pairs, self._settings
        )
        if start is None:
            return
        first, second = self._first, frame
        a = self._add_keyframe(first, Pose.identity(), _none(first.features))
        b = self._add_keyframe(second, start.first_from_second, _none(second.features))
        self.growing.add_landmarks(start.points, a, start.first_features, b, start.second_features)
        adjust_keyframes(self.growing, [a, b], iterations=20)
        for unposed, keyframe in ((first, a), (second, b)):
            rows = np.flatnonzero(keyframe.landmark_of >= 0)
            tracked = Tracked(keyframe.vis_from_cam, keyframe.landmark_of[rows], rows.astype(np.int32))
            self._remember(unposed, tracked, keyframe)
        self._waiting = [w for w in self._waiting if w.frame_index not in (first.frame_index, second.frame_index)]
        self._tracked_at_keyframe = len(b.landmarks())

    def _track(self, frame: Unposed) -> Tracked | None:
        assert self._last is not None
        known = self.growing.resolve(self._last.landmarks)
        covisible = self.growing.covisible(known[known >= 0])
        near = [k for k, _ in covisible[: self._settings.tracking.local_keyframes]]
        local = self.growing.landmarks_of(near)
        tracked = track(
            self.growing, frame.features, self._predict(frame.stamp_ns), local, self._settings.tracking
        )
        if tracked is None:
            recent = self.growing.keyframes[: -_RELOCALISE_AGAINST - 1 : -1]
            tracked = relocalise(
                self.growing, frame.features, recent, self._settings.tracking, self._settings.seed
            )
        return tracked

    def _predict(self, stamp_ns: int) -> Pose:
        """Constant velocity from the last two posed frames."""
        assert self._last is not None
        if self._before_last is None:
            return self._last.vis_from_cam
        motion = self._before_last.vis_from_cam.inverse() @ self._last.vis_from_cam
        fraction = (stamp_ns - self._last.stamp_ns) / (self._last.stamp_ns - self._before_last.stamp_ns)
        return self._last.vis_from_cam @ interpolate_pose(Pose.identity(), motion, fraction)

    def _remember(self, frame: Unposed, tracked: Tracked, keyframe: Keyframe) -> None:
        posed = PosedFrame(
            frame.frame_index,
            frame.stamp_ns,
            keyframe,
            keyframe.vis_from_cam.inverse() @ tracked.vis_from_cam,
            tracked.landmarks,
            frame.features.pixels[tracked.features],
            frame.features.sigmas_px[tracked.features],
        )
        self.posed[frame.frame_index] = posed
        self._before_last, self._last = self._last, posed
        if self.is_established:
            self._young.clear()
        else:
            self._young.append(frame)

    def _is_keyframe(self, tracked: Tracked) -> bool:
        settings, last = self._settings.keyframes, self.growing.keyframes[-1]
        if len(tracked.landmarks) < settings.min_tracked_ratio * self._tracked_at_keyframe:
            return True
        motion = last.vis_from_cam.inverse() @ tracked.vis_from_cam
        if np.degrees(rotation_angle_rad(motion.rotation)) > settings.max_rotation_deg:
            return True
        points_in_cam = tracked.vis_from_cam.inverse().transform(self.growing.points[tracked.landmarks])
        depth = float(np.median(points_in_cam[:, 2]))
        return float(np.linalg.norm(motion.translation_m)) > settings.max_translation_to_depth * depth

    def _insert_keyframe(self, frame: Unposed, tracked: Tracked) -> None:
        landmark_of = _none(frame.features)
        landmark_of[tracked.features] = tracked.landmarks
        keyframe = self._add_keyframe(frame, tracked.vis_from_cam, landmark_of)
        self._remember(frame, tracked, keyframe)
        extend_map(self.growing, keyframe, self._settings, self._times)
        self._tracked_at_keyframe = len(tracked.landmarks)
        if self._on_keyframe is not None:
            with self._times.stage("aligning"):
                self._on_keyframe(self.growing, self.posed.values())

    def _add_keyframe(self, frame: Unposed, vis_from_cam: Pose, landmark_of: Ids) -> Keyframe:
        return self.growing.add_keyframe(
            frame.frame_index, frame.stamp_ns, vis_from_cam, frame.features, landmark_of
        )

    def _start_again(self, frame: Unposed) -> None:
        """Give up a map that was lost as soon as it was made; its frames wait for a better one."""
        self._waiting = sorted(
            {w.frame_index: w for w in [*self._waiting, *self._young]}.values(), key=lambda w: w.frame_index
        )
        self.growing = GrowingMap(self.growing.camera)
        self.posed.clear()
        self._young.clear()
        self.lost.clear()
        self._first, self._last, self._before_last = frame, None, None

    def _pose_waiting_frames(self) -> None:
        """Backwards from the first map, and again for gaps: each from its nearest posed neighbour in time."""
        waiting = {w.frame_index: w for w in self._waiting}
        for step, order in ((1, sorted(waiting, reverse=True)), (-1, sorted(waiting))):
            for index in order:
                neighbour = self.posed.get(index + step)
                if index in self.posed or neighbour is None:
                    continue
                self._last, self._before_last = neighbour, self.posed.get(index + 2 * step)
                tracked = self._track(waiting[index])
                if tracked is not None:
                    self._remember(waiting[index], tracked, neighbour.keyframe)


def _none(features: Features) -> Ids:
    return np.full(len(features), -1, np.int32)
