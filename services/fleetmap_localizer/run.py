"""A whole drive through the localizer."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from fleetmap.camera import Camera
from fleetmap.covariances import PoseCovariances
from fleetmap.drive import Frame
from fleetmap.errors import NoPoseError
from fleetmap.trajectory import Trajectory
from fleetmap_localizer.localizer import Localizer
from fleetmap_localizer.map_supply import MapSupply
from fleetmap_localizer.pose_estimate import PoseEstimate
from fleetmap_localizer.settings import LocalizerSettings


@dataclass(frozen=True)
class LocalizedDrive:
    """The poses of a drive and the map they refer to."""

    frame_count: int
    poses: tuple[PoseEstimate, ...]  # one at least

    @property
    def map_versions(self) -> tuple[tuple[str, str], ...]:
        """Maps and versions that poses refer to, in the order they came."""
        return tuple(dict.fromkeys((pose.map_id, pose.version) for pose in self.poses))

    @property
    def median_inliers(self) -> int:
        """Landmarks that agreed with a pose, in the median."""
        return int(np.median([pose.inlier_count for pose in self.poses]))

    def trajectory(self) -> Trajectory:
        """The poses as a trajectory."""
        return Trajectory(
            epsg=self.poses[0].epsg,
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
    supply: MapSupply,
    settings: LocalizerSettings | None = None,
) -> LocalizedDrive:
    """Localise every image of a drive in the maps that lie around it.

    Raises:
        NoPoseError: not one frame could be localised.
        CalibrationError: images of another size than the camera's calibration.
    """
    localizer = Localizer(camera, (), settings)
    poses: list[PoseEstimate] = []
    frame_count = 0
    for frame in frames:
        frame_count += 1
        localizer.use(supply.views())
        answer = localizer.localize(frame)
        supply.moved(answer)
        if isinstance(answer, PoseEstimate):
            poses.append(answer)
    if not poses:
        names = ", ".join(sorted({f"'{view.map_id}'" for view in supply.views()})[:3])
        raise NoPoseError(
            f"not one of {frame_count} images could be localised in {names or 'any map'}; "
            "was this road mapped, and is the camera's calibration right?"
        )
    return LocalizedDrive(frame_count, tuple(poses))
