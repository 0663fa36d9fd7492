"""Searching from nothing: like places of all maps, landmarks matched by descriptor alone, then by projection.

What is found must look like its map all over the view, and must have no rival that does so as well.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
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
from fleetmap_localizer.likeness import Likeness, likeness_at, place_score
from fleetmap_localizer.local_map import Indices
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.query_image import QueryImage
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

    def utm_from_cam(self) -> Pose:
        """The camera's pose as easting, northing, ellipsoidal height."""
        pose = self.fit.answer.map_from_cam
        return Pose(pose.rotation, self.view.anchor.utm_from_map(pose.translation_m))


@dataclass(frozen=True)
class Candidate(Located):
    """A pose that the image may have, and whether it would be believed if it had no rival."""

    likeness: Likeness
    score: float  # see fleetmap_localizer.likeness.place_score
    is_trusted: bool

    @property
    def share(self) -> float:
        """Of the landmarks that should be in view, those that agree; does not depend on the map's density."""
        return self.inlier_count / max(len(self.fit.predicted_px), 1)

    @property
    def support(self) -> float:
        """Landmarks that agree, weighed by how much of the view is like the map: a copied house weighs little."""
        return self.inlier_count * self.likeness.alike


def relocalize(
    views: Sequence[MapView], camera: Camera, image: QueryImage, settings: LocalizerSettings
) -> Located | str:
    """The one place in all maps that explains an image; or why there is none, in words for people."""
    options = settings.relocalization
    found = find_candidates(views, camera, image, settings)
    if not found:
        return "the image shows no place that the map knows"
    best = max(found, key=lambda each: each.score)
    if best.is_trusted and best.score < options.clear_place_score:
        for each in candidates_beside(best, camera, image, found, settings):
            found.append(each)
        best = max(found, key=lambda each: each.score)
    if any(_is_rival(each, best, options) for each in found):
        return "the image could be of two places, which look too much alike"
    if not best.is_trusted:
        return f"too little of the image agrees with the likeliest place ({best.inlier_count} landmarks)"
    return best


def find_candidates(
    views: Sequence[MapView], camera: Camera, image: QueryImage, settings: LocalizerSettings
) -> list[Candidate]:
    """Poses in the places that are most like the image; none of them twice."""
    options = settings.relocalization
    search = PlaceSearch([view.places for view in views], image.features.descriptors, settings.place_index)
    found: list[Candidate] = []
    firmest = 0.0  # score of what is clear so far
    for score, number, keyframes in _candidate_places(views, search, options):
        if score < options.min_rival_score * firmest:
            break
        guesses = _guesses(views[number], camera, image.features, keyframes, found, options)
        for each in _new_candidates(views[number], camera, image, guesses, found, settings):
            found.append(each)
            search.explain(number, each.fit.landmarks[each.fit.answer.inliers])
            if each.score >= options.clear_place_score:
                firmest = max(firmest, score)
                break
    return found


def candidates_beside(
    one: Candidate, camera: Camera, image: QueryImage, found: Sequence[Candidate], settings: LocalizerSettings
) -> Iterator[Candidate]:
    """What is new of the poses that steps to the side of one lead to; ``found`` as in _new_candidates.

    Windows repeat: seen from another lane, those of a house may be taken for their neighbours, while all that is
    far away agrees.
    """
    options, pose = settings.relocalization, one.fit.answer.map_from_cam
    guesses = (
        (Pose(pose.rotation, pose.translation_m + step_m * pose.rotation[:, 0]), options.side_radii_px)
        for step_m in options.side_steps_m
    )
    return _new_candidates(one.view, camera, image, guesses, found, settings)


def judged(view: MapView, camera: Camera, image: QueryImage, fit: Fit, settings: LocalizerSettings) -> Candidate:
    """A pose with all that speaks for it where nothing before vouches for it."""
    likeness = likeness_at(view, camera, image, fit.answer.map_from_cam)
    score, options = place_score(likeness), settings.relocalization
    least = options.min_place_score if likeness.is_oriented else options.min_place_score_unoriented
    is_trusted = score >= least and is_trustworthy(fit, camera, settings.gate)
    return Candidate(view, fit, likeness, score, is_trusted)


def is_same(first: Located, second: Located) -> bool:
    """Whether two answers say the same, be they of one map or of two."""
    if first.view.anchor.epsg != second.view.anchor.epsg:
        return False
    return is_same_place(first.utm_from_cam(), second.utm_from_cam())


def _new_candidates(
    view: MapView,
    camera: Camera,
    image: QueryImage,
    guesses: Iterable[tuple[Pose, tuple[float, ...]]],
    found: Sequence[Candidate],
    settings: LocalizerSettings,
) -> Iterator[Candidate]:
    """What is new of the poses that guesses lead to, each with the radii of the windows to look in.

    The caller adds to ``found`` what it is given, before it asks for the next.
    """
    for initial, radii_px in guesses:
        fit = fit_around(view, camera, image, initial, radii_px, settings.fitting)
        if fit is not None and not any(_is_found(each, view, fit.answer.map_from_cam) for each in found):
            yield judged(view, camera, image, fit, settings)


def _guesses(
    view: MapView,
    camera: Camera,
    features: Features,
    keyframes: Indices,
    found: Sequence[Candidate],
    settings: RelocalizationSettings,
) -> Iterator[tuple[Pose, tuple[float, ...]]]:
    """Where the camera may be, and how far the landmarks may then be from where they should.

    What the descriptors alone agree on; and, as vehicles drive on roads, the keyframe's own pose. From there more
    is found where few descriptors agree, as in the dark: a landmark has not the whole image to be mistaken in.
    """
    pose = _pose_among(view, camera, features, keyframes, settings)
    if pose is not None and not any(_is_found(each, view, pose) for each in found):
        yield pose, settings.radii_px
    yield view.content.keyframes.pose(int(keyframes[-1])), settings.wide_radii_px


def _is_found(one: Located, view: MapView, map_from_cam: Pose) -> bool:
    return one.view is view and is_same_place(map_from_cam, one.fit.answer.map_from_cam)


def _is_rival(one: Candidate, best: Candidate, settings: RelocalizationSettings) -> bool:
    """Whether another place explains the image almost as well; overlapping maps tell of the same place.

    A place that could be the answer if it were alone must be beaten clearly: by more than counts vary by chance,
    and also in the share of its landmarks that agree. Otherwise a dense map of a street that looks much the same
    would outdo the sparse map of the right one.
    """
    if is_same(one, best) or best.score - one.score >= settings.min_score_lead:
        return False
    if one.support >= settings.max_rival * best.support:
        return True
    if not one.is_trusted:
        return False
    lead, spread = best.inlier_count - one.inlier_count, np.sqrt(best.inlier_count + one.inlier_count)
    return bool(one.share >= settings.max_rival * best.share or lead < settings.min_lead_sigmas * spread)


def _candidate_places(
    views: Sequence[MapView], search: PlaceSearch, settings: RelocalizationSettings
) -> Iterator[tuple[float, int, Indices]]:
    """Score, view and keyframes of the likeliest places, best first; no keyframe stands for two of them.

    The last of a place's keyframes is the one most like the image.
    """
    for _ in range(settings.candidates):
        highest = [float(each.max(initial=0.0)) for each in search.scores]
        if not highest or max(highest) < settings.min_score:
            return
        number = int(np.argmax(highest))
        local_map, best = views[number].local_map, int(np.argmax(search.scores[number]))
        group = np.append(local_map.covisible(best, settings.min_shared_landmarks, settings.neighbours), best)
        search.dismiss(number, group)
        yield highest[number], number, group


def _pose_among(
    view: MapView,
    camera: Camera,
    features: Features,
    keyframes: Indices,
    settings: RelocalizationSettings,
) -> Pose | None:
    """The pose that the matches with landmarks of these keyframes agree on, by RANSAC."""
    group = view.content.landmarks
    landmarks = view.local_map.landmarks_of(keyframes, settings.max_landmarks)
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
