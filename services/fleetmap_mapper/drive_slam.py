"""A whole drive through SLAM: features are found ahead; where tracking is lost for good, a new segment begins."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.errors import DriveError
from fleetmap.read_ahead import read_ahead
from fleetmap.vision.features import FeatureExtractor, FeatureSettings
from fleetmap_mapper.image_mask import ImageMask
from fleetmap_mapper.settings import MapperSettings
from fleetmap_mapper.slam import OnKeyframe, Segment, Slam, Unposed
from fleetmap_mapper.stage_times import StageTimes

_FRAMES_AHEAD = 8


def run_slam(
    frames: Iterable[Frame],
    camera: Camera,
    settings: MapperSettings,
    on_keyframe: OnKeyframe | None = None,
    times: StageTimes | None = None,
    mask: ImageMask | None = None,
) -> list[Segment]:
    """Feed a whole drive through SLAM; where tracking is lost for good, a new segment begins.

    Raises:
        DriveError: no two images of the drive ever made a map.
    """
    times = times or StageTimes()
    current, successor = Slam(camera, settings, on_keyframe, times), None
    segments = []
    for unposed in _features_ahead(frames, camera, settings, times, mask):
        current.register_frame(unposed)
        if len(current.lost) < settings.tracking.patience_frames:
            successor = None
            continue
        if successor is None:
            successor = Slam(camera, settings, on_keyframe, times)
            for earlier in current.lost[:-1]:
                successor.register_frame(earlier)
        successor.register_frame(unposed)
        if successor.is_established:
            segments.append(Segment(current.growing, current.finish()))
            current, successor = successor, None
    segments.append(Segment(current.growing, current.finish()))
    segments = [segment for segment in segments if segment.posed]
    if not segments:
        raise DriveError(
            "no map could be started: the images show too little texture, or the camera never moved; "
            "look at them, and at their exposure"
        )
    return segments


def _features_ahead(
    frames: Iterable[Frame], camera: Camera, settings: MapperSettings, times: StageTimes, mask: ImageMask | None
) -> Iterator[Unposed]:
    """The frames' features in order, found by another thread while earlier frames are being tracked."""
    coming = read_ahead(_with_features(frames, camera, settings, times, mask), _FRAMES_AHEAD)
    while True:
        with times.stage("waiting for features"):
            unposed = next(coming, None)
        if unposed is None:
            return
        yield unposed


def _with_features(
    frames: Iterable[Frame], camera: Camera, settings: MapperSettings, times: StageTimes, mask: ImageMask | None
) -> Iterator[Unposed]:
    extractor = FeatureExtractor(camera, FeatureSettings(count=settings.features.count))
    iterator = iter(frames)
    for index in itertools.count():
        with times.stage("reading"):
            frame = next(iterator, None)
        if frame is None:
            return
        with times.stage("finding features"):
            features = extractor.extract(frame.image)
            if mask is not None:
                features = mask.kept(features, camera)
        yield Unposed(index, frame.stamp_ns, features)
