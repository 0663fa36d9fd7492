"""From images and maps to UTM poses, or to none."""

from __future__ import annotations

from collections.abc import Sequence

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.vision.features import FeatureExtractor
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.motion import Motion
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate
from fleetmap_localizer.pose_uncertainty import pose_covariance
from fleetmap_localizer.query_image import QueryImage
from fleetmap_localizer.relocalization import Located, is_same, relocalize
from fleetmap_localizer.settings import LocalizerSettings
from fleetmap_localizer.tracking import can_reach, has_lost_support, track

_NO_CONTINUATION = "the likeliest place is one that the vehicle cannot have got to"


class Localizer:
    """Follows one camera through maps. They are only looked at, never changed, and no pose mixes two of them."""

    def __init__(
        self, camera: Camera, views: Sequence[MapView] = (), settings: LocalizerSettings | None = None
    ) -> None:
        """Prepare for images of ``camera``; the views were made for it."""
        self._settings = settings or LocalizerSettings()
        self._camera, self._views = camera, tuple(views)
        self._extractor = FeatureExtractor(camera, self._settings.features)
        self._motion: Motion | None = None

    def use(self, views: Sequence[MapView]) -> None:
        """Look into other views from the next image on; a track goes on in one that knows its place."""
        self._views = tuple(views)

    def forget(self) -> None:
        """Make the next image a query on its own."""
        self._motion = None

    def localize(self, frame: Frame) -> PoseEstimate | NoPose:
        """The camera's UTM pose at one image, or why it cannot be told for sure.

        Raises:
            CalibrationError: the image does not have the calibrated size.
        """
        return self.localize_image(QueryImage.of(frame, self._extractor))

    def localize_image(self, image: QueryImage) -> PoseEstimate | NoPose:
        """The same for an image whose features are known already."""
        stamp_ns = image.stamp_ns
        motion = self._recent_motion(stamp_ns)
        tracked = None if motion is None else self._track(image, motion)
        answer: Located | str | None = tracked
        if motion is None or tracked is None or motion.is_fresh or self._lost_support(tracked, motion):
            answer = _stronger(tracked, self._relocalize(image, motion))
        if answer is None or isinstance(answer, str):
            return NoPose(stamp_ns, answer or _NO_CONTINUATION)
        if tracked and not is_same(answer, tracked):
            motion = None  # it was the track that had been deceived
        self._remember(stamp_ns, answer, motion)
        return PoseEstimate(
            stamp_ns=stamp_ns,
            epsg=answer.view.anchor.epsg,
            utm_from_cam=answer.utm_from_cam(),
            covariance=pose_covariance(answer),
            map_id=answer.view.map_id,
            version=answer.view.version,
            inlier_count=answer.inlier_count,
        )

    def _track(self, image: QueryImage, motion: Motion) -> Located | None:
        """Go on in the map of the pose before; where it does not show the place any more, in another."""
        for view in sorted(self._views, key=motion.distance_to):
            fit = track(view, self._camera, image, motion, self._settings)
            if fit is not None:
                return Located(view, fit)
        return None

    def _relocalize(self, image: QueryImage, motion: Motion | None) -> Located | str:
        """Search everywhere; against the motion only what has far more to speak for it than the place before."""
        found = relocalize(self._views, self._camera, image, self._settings)
        if isinstance(found, str) or motion is None:
            return found
        overruled = found.inlier_count > self._settings.tracking.overruling_support * motion.inlier_count
        if overruled or can_reach(found.view, motion, image.stamp_ns, found.fit, self._settings):
            return found
        return _NO_CONTINUATION

    def _lost_support(self, tracked: Located, motion: Motion) -> bool:
        return has_lost_support(tracked.fit, motion, self._settings)

    def _recent_motion(self, stamp_ns: int) -> Motion | None:
        """The track so far, unless it ended too long ago, or time has not gone on."""
        if self._motion is None:
            return None
        elapsed_s = (stamp_ns - self._motion.stamp_ns) * 1e-9
        return self._motion if 0.0 < elapsed_s <= self._settings.tracking.max_gap_s else None

    def _remember(self, stamp_ns: int, answer: Located, motion: Motion | None) -> None:
        view, pose, inliers = answer.view, answer.utm_from_cam(), answer.inlier_count
        is_continued = motion is not None and motion.epsg == view.anchor.epsg
        if motion and is_continued and motion.can_reach(stamp_ns, pose.translation_m, self._settings.tracking):
            self._motion = motion.follow(stamp_ns, pose, inliers, view.map_id, view.version)
        else:
            self._motion = Motion(stamp_ns, pose, inliers, view.anchor.epsg, view.map_id, view.version)


def _stronger(tracked: Located | None, found: Located | str) -> Located | str:
    """The answer with more inliers; the tracked one where they have equally many."""
    if tracked is None:
        return found
    if isinstance(found, str) or found.inlier_count <= tracked.inlier_count:
        return tracked
    return found
