"""Searching from nothing: like places of all maps, landmarks matched by descriptor alone, then by projection."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap.vision.absolute_pose import AbsolutePoseSettings, estimate_absolute_pose
from fleetmap.vision.features import Features
from fleetmap.vision.matching import match_descriptors
from fleetmap.vision.place_recognition import PlaceSearch
from fleetmap_localizer.fitting import fit_around
from fleetmap_localizer.gate import Fit, is_same_place, is_trustworthy
from fleetmap_localizer.local_map import Indices
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.settings import LocalizerSettings, RelocalizationSettings


@dataclass(frozen=True)
class Located:
    """A pose, and the view of a map that it refers to."""

    view: MapView
    fit: Fit

    @property
    def inlier_count(self) -> int:
        """Landmarks that agree with the pose."""
        return self.fit.answer.inlier_count

    @property
    def share(self) -> float:
        """Of the landmarks that should be in view, those that agree; does not depend on the map's density."""
        return self.inlier_count / max(len(self.fit.predicted_px), 1)

    def utm_from_cam(self) -> Pose:
        """The camera's pose as easting, northing, ellipsoidal height."""
        pose = self.fit.answer.map_from_cam
        return Pose(pose.rotation, self.view.anchor.utm_from_map(pose.translation_m))


def relocalize(
    views: Sequence[MapView], camera: Camera, features: Features, settings: LocalizerSettings
) -> Located | str:
    """The one place in all maps that explains an image; or why there is none, in words for people."""
    options = settings.relocalization
    search = PlaceSearch([view.places for view in views], features.descriptors, settings.place_index)
    found: list[Located] = []
    firmest = 0.0  # score of what is found so far
    for score, number, landmarks in _candidate_places(views, search, options):
        if score < options.min_rival_score * firmest:
            break
        view = views[number]
        initial = _pose_among(view, camera, features, landmarks, options)
        if initial is None or any(_is_found(each, view, initial) for each in found):
            continue
        fit = fit_around(view, camera, features, initial, options.radii_px, settings.fitting)
        if fit is not None:
            found.append(Located(view, fit))
            search.explain(number, fit.landmarks[fit.answer.inliers])
            if is_trustworthy(fit, camera, options.gate):
                firmest = max(firmest, score)
    if not found:
        return "the image shows no place that the map knows"
    best = max(found, key=lambda each: each.inlier_count)
    if any(_is_rival(each, best, camera, options) for each in found):
        return "the image could be of two places, which look too much alike"
    if not is_trustworthy(best.fit, camera, options.gate):
        return f"too little of the image agrees with the likeliest place ({best.inlier_count} landmarks)"
    return best


def is_same(first: Located, second: Located) -> bool:
    """Whether two answers say the same, be they of one map or of two."""
    if first.view.anchor.epsg != second.view.anchor.epsg:
        return False
    return is_same_place(first.utm_from_cam(), second.utm_from_cam())


def _is_found(one: Located, view: MapView, map_from_cam: Pose) -> bool:
    return one.view is view and is_same_place(map_from_cam, one.fit.answer.map_from_cam)


def _is_rival(one: Located, best: Located, camera: Camera, settings: RelocalizationSettings) -> bool:
    """Whether another place explains the image almost as well; overlapping maps tell of the same place.

    A place that could be the answer if it were alone must be beaten clearly: by more than counts vary by chance,
    and also in the share of its landmarks that agree. Otherwise a dense map of a street that looks much the same
    would outdo the sparse map of the right one.
    """
    if is_same(one, best):
        return False
    if one.inlier_count >= settings.max_rival * best.inlier_count:
        return True
    if not is_trustworthy(one.fit, camera, settings.gate):
        return False
    lead, spread = best.inlier_count - one.inlier_count, np.sqrt(best.inlier_count + one.inlier_count)
    return bool(one.share >= settings.max_rival * best.share or lead < settings.min_lead_sigmas * spread)


def _candidate_places(
    views: Sequence[MapView], search: PlaceSearch, settings: RelocalizationSettings
) -> Iterator[tuple[float, int, Indices]]:
    """Score, view and landmarks of the likeliest places, best first; no keyframe stands for two of them."""
    for _ in range(settings.candidates):
        highest = [float(each.max(initial=0.0)) for each in search.scores]
        if not highest or max(highest) < settings.min_score:
            return
        number = int(np.argmax(highest))
        local_map, best = views[number].local_map, int(np.argmax(search.scores[number]))
        group = np.append(local_map.covisible(best, settings.min_shared_landmarks, settings.neighbours), best)
        search.dismiss(number, group)
        yield highest[number], number, local_map.landmarks_of(group, settings.max_landmarks)


def _pose_among(
    view: MapView, camera: Camera, features: Features, landmarks: Indices, settings: RelocalizationSettings
) -> Pose | None:
    """The pose that the matches with these landmarks agree on, by RANSAC."""
    group = view.content.landmarks
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
        camera,
        AbsolutePoseSettings(settings.min_ransac_inliers, settings.ransac_error_px),
    )
    return None if answer is None else answer.map_from_cam
