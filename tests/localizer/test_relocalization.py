"""Searching from nothing among several maps: the right one, and none where two could be meant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geodesy import UtmAnchor
from fleetmap.vision.features import FeatureExtractor
from fleetmap.visual_map import LocalizationMap
from fleetmap_localizer.map_view import LocalizableMap, MapView
from fleetmap_localizer.query_image import QueryImage
from fleetmap_localizer.relocalization import Located, candidates_beside, find_candidates, relocalize
from fleetmap_localizer.settings import LocalizerSettings

SETTINGS = LocalizerSettings()
ELSEWHERE_M = 4000


@pytest.fixture(scope="module")
def queries(second_drive) -> list[QueryImage]:
    extractor = FeatureExtractor(second_drive.camera, SETTINGS.features)
    return [QueryImage.of(frame, extractor) for frame in second_drive.frames[::4]]


@pytest.fixture(scope="module")
def look_into(mapped_street, second_drive):
    survey_camera = mapped_street.manifest.camera.to_camera()

    def view(content: LocalizationMap, map_id: str) -> MapView:
        return MapView(LocalizableMap(map_id, "0" * 64, survey_camera, content), second_drive.camera, SETTINGS)

    return view


def twin(content: LocalizationMap, repainted: float, away_m: int = ELSEWHERE_M) -> LocalizationMap:
    """A street elsewhere of the same shape, a share of whose landmarks looks otherwise."""
    rng = np.random.default_rng(4)
    descriptors = content.landmarks.descriptors.copy()
    changed = rng.random(len(descriptors)) < repainted
    descriptors[changed] = rng.integers(0, 256, (np.count_nonzero(changed), 32), dtype=np.uint8)
    anchor = content.anchor
    moved = UtmAnchor(anchor.epsg, anchor.easting_m + away_m, anchor.northing_m, anchor.height_m)
    return replace(content, anchor=moved, landmarks=replace(content.landmarks, descriptors=descriptors))


def thinned(content: LocalizationMap, kept: float) -> LocalizationMap:
    """The same map with a share of its landmarks."""
    stays = np.random.default_rng(6).random(len(content.landmarks)) < kept
    group, seen = content.landmarks, stays[content.seen_landmark]
    arrays = ("points_m", "descriptors", "normals", "octaves", "distances_m", "sigmas_m", "angles_deg")
    held = {name: getattr(group, name) for name in arrays}
    return replace(
        content,
        landmarks=replace(group, **{name: each if each is None else each[stays] for name, each in held.items()}),
        seen_by_keyframe=content.seen_by_keyframe[seen],
        seen_landmark=(np.cumsum(stays) - 1)[content.seen_landmark[seen]].astype(np.int32),
    )


@pytest.mark.parametrize("aside_m", [-1.5, 1.5, 3.0])
def test_beside_a_pose_in_the_wrong_lane_the_true_one_is_found(
    look_into, mapped_street, second_drive, queries, aside_m: float
) -> None:
    view, camera = look_into(mapped_street.content, "street"), second_drive.camera
    right = max(find_candidates([view], camera, queries[2], SETTINGS), key=lambda each: each.score)
    pose = right.fit.answer.map_from_cam
    shifted = replace(pose, translation_m=pose.translation_m + aside_m * pose.rotation[:, 0])
    wrong = replace(right, fit=replace(right.fit, answer=replace(right.fit.answer, map_from_cam=shifted)))
    beside = list(candidates_beside(wrong, camera, queries[2], [wrong], SETTINGS))
    away_m = [np.linalg.norm(each.fit.answer.map_from_cam.translation_m - pose.translation_m) for each in beside]
    assert min(away_m) < 0.05
    assert list(candidates_beside(right, camera, queries[2], [right], SETTINGS)) == []


def answers(views: list[MapView], second_drive, queries: list[QueryImage]) -> list[Located | str]:
    return [relocalize(views, second_drive.camera, image, SETTINGS) for image in queries]


def located(found: list[Located | str]) -> list[Located]:
    return [answer for answer in found if isinstance(answer, Located)]


@pytest.mark.parametrize("order", [1, -1])
def test_the_right_one_of_two_near_identical_streets_is_told(
    look_into, mapped_street, second_drive, queries, order: int
) -> None:
    views = [look_into(mapped_street.content, "right"), look_into(twin(mapped_street.content, 0.5), "twin")]
    poses = located(answers(views[::order], second_drive, queries))
    assert len(poses) >= 0.9 * len(queries) > 3
    assert {pose.view.map_id for pose in poses} == {"right"}


def test_two_streets_that_look_the_same_give_no_pose(look_into, mapped_street, second_drive, queries) -> None:
    views = [look_into(mapped_street.content, "one"), look_into(twin(mapped_street.content, 0.0), "other")]
    for answer in answers(views, second_drive, queries):
        assert isinstance(answer, str)
        assert "too much alike" in answer


def test_a_sparse_map_of_the_street_is_not_taken_for_its_denser_twin(
    look_into, mapped_street, second_drive, queries
) -> None:
    right, wrong = thinned(mapped_street.content, 0.3), twin(mapped_street.content, 0.6)
    poses = located(answers([look_into(wrong, "twin"), look_into(right, "right")], second_drive, queries))
    assert "twin" not in {pose.view.map_id for pose in poses}


def test_where_descriptors_alone_find_no_pose_those_of_the_keyframes_lead_on(
    look_into, mapped_street, second_drive, queries
) -> None:
    deaf = replace(SETTINGS, relocalization=replace(SETTINGS.relocalization, min_matches=1_000_000))
    view = look_into(mapped_street.content, "street")
    both, alone = (
        located([relocalize([view], second_drive.camera, image, settings) for image in queries])
        for settings in (SETTINGS, deaf)
    )
    assert len(alone) == len(both) >= 0.9 * len(queries)
    for one, other in zip(both, alone, strict=True):
        assert np.allclose(one.utm_from_cam().translation_m, other.utm_from_cam().translation_m, atol=0.02)


def test_two_maps_of_one_street_do_not_rival_each_other(look_into, mapped_street, second_drive, queries) -> None:
    same = twin(mapped_street.content, 0.0, away_m=0)
    views = [look_into(mapped_street.content, "first"), look_into(same, "second")]
    assert len(located(answers(views, second_drive, queries))) >= 0.9 * len(queries)


def test_more_maps_of_elsewhere_change_no_answer(look_into, mapped_street, second_drive, queries) -> None:
    right = look_into(mapped_street.content, "right")
    others = [look_into(twin(mapped_street.content, 1.0, 1000 * (k + 1)), f"other {k}") for k in range(3)]
    alone, among = (answers(views, second_drive, queries) for views in ([right], [*others, right]))
    for one, other in zip(located(alone), located(among), strict=True):
        assert other.view is right
        assert np.allclose(one.utm_from_cam().translation_m, other.utm_from_cam().translation_m, atol=0.05)


def test_without_maps_there_is_no_place(second_drive, queries) -> None:
    assert answers([], second_drive, queries[:1]) == ["the image shows no place that the map knows"]
