"""A whole drive through the localizer."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from fleetmap.camera import Camera
from fleetmap.covariances import PoseCovariances
from fleetmap.drive import Frame
from fleetmap.errors import NoPoseError
from fleetmap.trajectory import Trajectory
from fleetmap.vision.features import FeatureExtractor, Features
from fleetmap_localizer.localizer import Localizer
from fleetmap_localizer.map_source import LocalizableMap
from fleetmap_localizer.pose_estimate import PoseEstimate
from fleetmap_localizer.settings import LocalizerSettings


@dataclass(frozen=True)
class LocalizedDrive:
    """The poses of a drive and the map they refer to."""

    map_id: str
    version: str
    epsg: int
    frame_count: int
    poses: tuple[PoseEstimate, ...]

    @property
    def median_inliers(self) -> int:
        """Landmarks that agreed with a pose, in the median."""
        return int(np.median([pose.inlier_count for pose in self.poses]))

    def trajectory(self) -> Trajectory:
        """The poses as a trajectory."""
        return Trajectory(
            epsg=self.epsg,
            stamps_ns=np.array([pose.stamp_ns for pose in self.poses], dtype=np.int64),
            positions_m=np.array([pose.utm_from_cam.translation_m for pose in self.poses]),
            rotations=np.array([pose.utm_from_cam.rotation for pose in self.poses]),
        )

    def covariances(self) -> PoseCovariances:
        """The covariances of the poses, relative to the map."""
        return PoseCovariances(
            stamps_ns=np.array([pose.stamp_ns for pose in self.poses], dtype=np.int64),
            matrices=np.array([pose.covariance for pose in self.poses]),
        )


def localize_drive(
    frames: Iterable[Frame],
    camera: Camera,
    maps: Iterable[LocalizableMap],
    settings: LocalizerSettings | None = None,
) -> LocalizedDrive:
    """Localise every image of a drive in the first of the maps that knows its place.

    The maps are asked for one after the other, and only while none of those before gives a pose.

    Raises:
        NoPoseError: not one frame could be localised.
        CalibrationError: images of another size than the camera's calibration.
    """
    settings = settings or LocalizerSettings()
    extractor = FeatureExtractor(camera, settings.features)
    candidates = _Candidates(maps, camera, settings)
    chosen: _Candidate | None = None
    poses: list[PoseEstimate] = []
    frame_count = 0
    for frame in frames:
        frame_count += 1
        features = extractor.extract(frame.image)
        if chosen is None:
            pose, chosen = candidates.first_to_localize(features, frame.stamp_ns)
        else:
            pose = chosen.localizer.localize_features(features, frame.stamp_ns)
        if pose is not None:
            poses.append(pose)
    if chosen is None:
        raise NoPoseError(
            f"not one of {frame_count} images could be localised in {candidates.described()}; "
            "was this road mapped, and is the camera's calibration right?"
        )
    return LocalizedDrive(
        chosen.map.map_id, chosen.map.version, chosen.map.content.anchor.epsg, frame_count, tuple(poses)
    )


@dataclass(frozen=True)
class _Candidate:
    """A map and the localizer that looks into it."""

    map: LocalizableMap
    localizer: Localizer


class _Candidates:
    """Maps in the order they came, each fetched and prepared when it is first asked."""

    def __init__(self, maps: Iterable[LocalizableMap], camera: Camera, settings: LocalizerSettings) -> None:
        self._coming = iter(maps)
        self._ready: list[_Candidate] = []
        self._camera, self._settings = camera, settings

    def first_to_localize(
        self, features: Features, stamp_ns: int
    ) -> tuple[PoseEstimate, _Candidate] | tuple[None, None]:
        for candidate in self._all():
            pose = candidate.localizer.localize_features(features, stamp_ns)
            if pose is not None:
                return pose, candidate
        return None, None

    def described(self) -> str:
        names = [f"'{candidate.map.map_id}'" for candidate in self._ready]
        if len(names) > 3:
            return f"any of {len(names)} maps"
        return f"map {', '.join(names)}" if names else "any map"

    def _all(self) -> Iterator[_Candidate]:
        yield from list(self._ready)
        for item in self._coming:
            localizer = Localizer(item.content, item.camera, self._camera, self._settings)
            self._ready.append(_Candidate(item, localizer))
            yield self._ready[-1]
