"""From an image and a map to a UTM pose, or to none."""

from __future__ import annotations

import numpy as np

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.geometry import Pose
from fleetmap.vision.absolute_pose import (
    AbsolutePose,
    AbsolutePoseSettings,
    estimate_absolute_pose,
    refine_absolute_pose,
)
from fleetmap.vision.features import FeatureExtractor, Features
from fleetmap.vision.matching import match_by_projection, match_descriptors
from fleetmap.vision.place_recognition import PlaceIndex
from fleetmap.visual_map import LocalizationMap
from fleetmap_localizer.gate import Fit, best_unrivalled, is_same_place, is_trustworthy
from fleetmap_localizer.local_map import Indices, LocalMap
from fleetmap_localizer.motion import Motion
from fleetmap_localizer.pose_estimate import PoseEstimate
from fleetmap_localizer.settings import LocalizerSettings


class Localizer:
    """Follows one camera through one map. The map is only looked at, never changed."""

    def __init__(
        self,
        content: LocalizationMap,
        map_camera: Camera,
        camera: Camera,
        settings: LocalizerSettings | None = None,
    ) -> None:
        """Prepare for images of ``camera``; ``map_camera`` is the one that drove the survey."""
        self._settings = settings or LocalizerSettings()
        self._content, self._camera = content, camera
        self._extractor = FeatureExtractor(camera, self._settings.features)
        self._places = PlaceIndex(
            content.landmarks.descriptors,
            content.seen_by_keyframe,
            content.seen_landmark,
            len(content.keyframes),
            self._settings.place_index,
        )
        self._local_map = LocalMap(
            content,
            float(np.sqrt(map_camera.fx_px * map_camera.fy_px)),
            camera,
            self._settings.features.levels,
            self._settings.features.scale_factor,
            self._settings.local_map,
        )
        self._motion: Motion | None = None

    def localize(self, frame: Frame) -> PoseEstimate | None:
        """The camera's UTM pose at one image, or None where it cannot be told for sure.

        Raises:
            CalibrationError: the image does not have the calibrated size.
        """
        return self.localize_features(self._extractor.extract(frame.image), frame.stamp_ns)

    def localize_features(self, features: Features, stamp_ns: int) -> PoseEstimate | None:
        """The same for an image whose features are known already, as when several maps are asked."""
        motion = self._recent_motion(stamp_ns)
        answer = tracked = None if motion is None else self._track(features, stamp_ns, motion)
        if motion is None or tracked is None or motion.is_fresh or self._lost_support(tracked, motion):
            answer = _stronger(tracked, self._relocalize(features, stamp_ns, motion))
        if answer and tracked and not is_same_place(answer.map_from_cam, tracked.map_from_cam):
            motion = None  # it was the track that had been deceived
        self._remember(stamp_ns, answer, motion)
        if answer is None:
            return None
        return PoseEstimate(
            stamp_ns=stamp_ns,
            utm_from_cam=Pose(
                answer.map_from_cam.rotation, self._content.anchor.utm_from_map(answer.map_from_cam.translation_m)
            ),
            covariance=answer.covariance,
            inlier_count=answer.inlier_count,
        )

    def _track(self, features: Features, stamp_ns: int, motion: Motion) -> AbsolutePose | None:
        """Search around where the vehicle should be by now."""
        settings = self._settings.tracking
        predicted = motion.predict(stamp_ns)
        best = None
        for radii_px in settings.radii_px:
            fit = self._fit(features, predicted, radii_px)
            if fit is not None and self._continues(motion, stamp_ns, fit):
                best = _stronger(best, fit.answer)
            if best is not None and not self._lost_support(best, motion):
                break
        return best

    def _continues(self, motion: Motion, stamp_ns: int, fit: Fit) -> bool:
        """Whether a pose near the prediction is its continuation.

        Where most of the support is gone the view may be of something else: as much is asked as from nothing.
        """
        settings = self._settings.tracking
        vouched = fit.answer.inlier_count >= settings.min_vouched_support * motion.inlier_count
        gate = settings.gate if vouched else self._settings.relocalization.gate
        return is_trustworthy(fit, self._camera, gate) and motion.can_reach(
            stamp_ns, fit.answer.map_from_cam, settings
        )

    def _lost_support(self, answer: AbsolutePose, motion: Motion) -> bool:
        """Whether far fewer landmarks agree than on the image before.

        In wide windows some landmarks always find a partner, and those may agree on a wrong pose.
        """
        kept = self._settings.tracking.min_kept_support
        return answer.inlier_count < kept * motion.inlier_count

    def _relocalize(self, features: Features, stamp_ns: int, motion: Motion | None) -> AbsolutePose | None:
        """Search from nothing: like places, landmarks matched by descriptor alone, then by projection."""
        settings = self._settings.relocalization
        fits: list[Fit] = []
        for landmarks in self._candidate_places(features):
            initial = self._pose_among(features, landmarks)
            if initial is None or any(is_same_place(initial, fit.answer.map_from_cam) for fit in fits):
                continue
            fit = self._fit(features, initial, settings.radii_px)
            if fit is not None:
                fits.append(fit)
        best = best_unrivalled(fits, settings.max_rival)
        if best is None or not is_trustworthy(best, self._camera, settings.gate):
            return None
        if motion and not self._fits_in(motion, stamp_ns, best.answer):
            return None
        return best.answer

    def _fits_in(self, motion: Motion, stamp_ns: int, answer: AbsolutePose) -> bool:
        """Whether the vehicle can have got there, or far more speaks for this place than for the one before."""
        settings = self._settings.tracking
        overruled = answer.inlier_count > settings.overruling_support * motion.inlier_count
        return overruled or motion.can_reach(stamp_ns, answer.map_from_cam, settings)

    def _candidate_places(self, features: Features) -> list[Indices]:
        """Landmarks of the likeliest places, best first; no keyframe stands for two of them."""
        settings = self._settings.relocalization
        scores = self._places.scores(features.descriptors)
        places: list[Indices] = []
        while len(places) < settings.candidates and scores.max(initial=0.0) > 0.0:
            best = int(np.argmax(scores))
            neighbours = self._local_map.covisible(best, settings.min_shared_landmarks, settings.neighbours)
            group = np.append(neighbours, best)
            places.append(self._local_map.landmarks_of(group, settings.max_landmarks))
            scores[group] = 0.0
        return places

    def _pose_among(self, features: Features, landmarks: Indices) -> Pose | None:
        """The pose that the matches with these landmarks agree on, by RANSAC."""
        settings = self._settings.relocalization
        group = self._content.landmarks
        pairs = match_descriptors(
            features.descriptors, group.descriptors[landmarks], settings.max_distance, settings.ratio
        )
        if len(pairs) < settings.min_matches:
            return None
        seen, matched = pairs[:, 0], landmarks[pairs[:, 1]]
        answer = estimate_absolute_pose(
            features.pixels[seen],
            group.points_m[matched],
            features.sigmas_px[seen],
            self._camera,
            AbsolutePoseSettings(settings.min_ransac_inliers, settings.ransac_error_px),
        )
        return None if answer is None else answer.map_from_cam

    def _fit(self, features: Features, guess: Pose, radii_px: tuple[float, ...]) -> Fit | None:
        """Match landmarks around a guess by projection and refine, in ever smaller windows."""
        around = self._local_map.landmarks_around(guess)
        fit = None
        for radius_px in radii_px:
            fit = self._fit_once(features, guess, around, radius_px)
            if fit is None:
                return None
            guess = fit.answer.map_from_cam
        return fit

    def _fit_once(self, features: Features, guess: Pose, around: Indices, radius_px: float) -> Fit | None:
        settings = self._settings.tracking
        group = self._content.landmarks
        predictions = self._local_map.predict(around, guess)
        found = match_by_projection(
            predictions.pixels,
            np.asarray(radius_px * features.scale_factor**predictions.octaves, dtype=np.float64),
            predictions.octaves - 1,
            predictions.octaves + 1,
            group.descriptors[predictions.landmarks],
            features,
            settings.max_distance,
            settings.ratio,
        )
        seen, landmarks = found[found >= 0], predictions.landmarks[found >= 0]
        pixels = features.pixels[seen]
        answer = refine_absolute_pose(
            pixels, group.points_m[landmarks], features.sigmas_px[seen], self._camera, guess
        )
        return None if answer is None else Fit(answer, pixels, predictions.pixels, features.pixels)

    def _recent_motion(self, stamp_ns: int) -> Motion | None:
        """The track so far, unless it ended too long ago, or time has not gone on."""
        if self._motion is None:
            return None
        elapsed_s = (stamp_ns - self._motion.stamp_ns) * 1e-9
        return self._motion if 0.0 < elapsed_s <= self._settings.tracking.max_gap_s else None

    def _remember(self, stamp_ns: int, answer: AbsolutePose | None, motion: Motion | None) -> None:
        if answer is None:
            return
        pose, inliers = answer.map_from_cam, answer.inlier_count
        if motion and motion.can_reach(stamp_ns, pose, self._settings.tracking):
            self._motion = motion.follow(stamp_ns, pose, inliers)
        else:
            self._motion = Motion(stamp_ns, pose, inliers)


def _stronger(first: AbsolutePose | None, second: AbsolutePose | None) -> AbsolutePose | None:
    """The answer with more inliers; the first where they have equally many."""
    if first is None or second is None:
        return first or second
    return second if second.inlier_count > first.inlier_count else first
