"""A whole drive through the localizer."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np

from fleetmap.camera import Camera
from fleetmap.covariances import PoseCovariances
from fleetmap.drive import Frame
from fleetmap.errors import NoPoseError, RunError
from fleetmap.trajectory import Trajectory
from fleetmap.vision.features import FeatureExtractor, FeatureSettings
from fleetmap_localizer.dead_reckoning import DeadReckoning
from fleetmap_localizer.feature_stream import with_features
from fleetmap_localizer.localizer import Localizer
from fleetmap_localizer.map_supply import MapSupply
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate
from fleetmap_localizer.pose_files.tum_file import trajectory_of
from fleetmap_localizer.query_image import QueryImage
from fleetmap_localizer.settings import LocalizerSettings

DROPPED = "dropped: the image before was still being worked on"


@dataclass(frozen=True)
class LocalizedDrive:
    """What came of the images of a drive."""

    answers: tuple[PoseEstimate | NoPose, ...]  # one an image, in time order
    map_ids: tuple[str, ...] = ()  # of all maps that were looked into
    ended_by: BaseException | None = None  # what ended the run before the drive was over

    @property
    def frame_count(self) -> int:
        """Images looked at, or dropped."""
        return len(self.answers)

    @property
    def poses(self) -> tuple[PoseEstimate, ...]:
        """The poses that were measured."""
        return self._of_kind("measured")

    @property
    def predicted(self) -> tuple[PoseEstimate, ...]:
        """The poses that were carried on by other sensors than the camera."""
        return self._of_kind("predicted")

    @property
    def map_versions(self) -> tuple[tuple[str, str], ...]:
        """Maps and versions that poses refer to, in the order they came."""
        return tuple(dict.fromkeys((pose.map_id, pose.version) for pose in self.poses))

    @property
    def median_inliers(self) -> int:
        """Landmarks that agreed with a measured pose, in the median."""
        return int(np.median([pose.inlier_count for pose in self.poses]))

    @property
    def reasons(self) -> Counter[str]:
        """Why images have no pose, and how many; what differs from image to image is left out."""
        absent = (answer.reason for answer in self.answers if isinstance(answer, NoPose))
        return Counter(re.sub(r" *\([^)]*\)", "", reason) for reason in absent)

    def trajectory(self, *, with_predicted: bool = False) -> Trajectory:
        """The poses, one at least, as a trajectory."""
        return trajectory_of(self._chosen(with_predicted))

    def covariances(self, *, with_predicted: bool = False) -> PoseCovariances:
        """The covariances of the same poses."""
        poses = self._chosen(with_predicted)
        return PoseCovariances(
            stamps_ns=np.array([pose.stamp_ns for pose in poses], dtype=np.int64),
            matrices=np.array([pose.covariance for pose in poses]),
        )

    def with_dropped(self, stamps_ns: Sequence[int]) -> LocalizedDrive:
        """The same, with images that nobody looked at."""
        dropped = [NoPose(stamp_ns, DROPPED) for stamp_ns in stamps_ns]
        return replace(self, answers=tuple(sorted([*self.answers, *dropped], key=lambda each: each.stamp_ns)))

    def _chosen(self, with_predicted: bool) -> Sequence[PoseEstimate]:
        if not with_predicted:
            return self.poses
        return [answer for answer in self.answers if isinstance(answer, PoseEstimate)]

    def _of_kind(self, kind: str) -> tuple[PoseEstimate, ...]:
        return tuple(each for each in self.answers if isinstance(each, PoseEstimate) and each.kind == kind)

    def require_pose(self) -> None:
        """Raise what ended the run early if there is no pose, or NoPoseError if it simply found none."""
        if self.poses:
            return
        if self.ended_by is not None:
            raise self.ended_by
        names = ", ".join(f"'{map_id}'" for map_id in self.map_ids[:3])
        why = "".join(f" ({reason})" for reason, _ in self.reasons.most_common(1))
        raise NoPoseError(
            f"not one of {self.frame_count} images could be localised in {names or 'any map'}{why}; "
            "was this road mapped, and is the camera's calibration right?"
        )


def localize_drive(
    frames: Iterable[Frame],
    camera: Camera,
    supply: MapSupply,
    settings: LocalizerSettings | None = None,
    *,
    independent: bool = False,
    reckoning: DeadReckoning | None = None,
    looks_ahead: bool = True,
) -> LocalizedDrive:
    """Localise every image of a drive in the maps that lie around it.

    What ends the run early, be it Ctrl-C or the server, is kept beside the answers so far.

    Args:
        frames: the images in time order.
        camera: that took them.
        supply: of maps.
        settings: of the localizer.
        independent: every image is a query on its own, of which not even the supply learns.
        reckoning: predicts poses where images give none.
        looks_ahead: features of the next images are found meanwhile; not for frames that come when they are due.

    Raises:
        DriveError: the recording is damaged.
        CalibrationError: images of another size than the camera's calibration.
        MapPackageError: the folder holds no map.
    """
    settings = settings or LocalizerSettings()
    localizer = Localizer(camera, (), settings)
    find = with_features if looks_ahead else _features_when_due
    answers: list[PoseEstimate | NoPose] = []
    map_ids: dict[str, None] = {}
    ended_by: BaseException | None = None
    try:
        supply.views()  # waits for the first map, so that no image that is due has to
        with closing(find(frames, camera, settings.features)) as images:
            for image in images:
                localizer.use(views := supply.views())
                map_ids.update((view.map_id, None) for view in views)
                if independent:
                    localizer.forget()
                answer = localizer.localize_image(image)
                answers.append(_with_prediction(answer, reckoning))
                if not independent:
                    supply.moved(answers[-1])
    except (RunError, KeyboardInterrupt) as error:
        ended_by = error
    return LocalizedDrive(tuple(answers), tuple(map_ids), ended_by)


def _features_when_due(
    frames: Iterable[Frame], camera: Camera, settings: FeatureSettings
) -> Generator[QueryImage, None, None]:
    extractor = FeatureExtractor(camera, settings)
    for frame in frames:
        yield QueryImage.of(frame, extractor)


def _with_prediction(answer: PoseEstimate | NoPose, reckoning: DeadReckoning | None) -> PoseEstimate | NoPose:
    """What the image gave; failing that, what other sensors say."""
    if reckoning is None:
        return answer
    if isinstance(answer, PoseEstimate):
        return reckoning.measured(answer)
    return reckoning.pose_at(answer.stamp_ns) or answer
