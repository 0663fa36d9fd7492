"""Likeness: an image of the mapped street is told from one of which only a part shows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.drive import Frame
from fleetmap.geometry import Pose
from fleetmap.vision.features import FeatureExtractor
from fleetmap_localizer.likeness import Likeness, likeness_at, margins_of, place_score
from fleetmap_localizer.map_view import LocalizableMap, MapView
from fleetmap_localizer.query_image import QueryImage
from fleetmap_localizer.settings import LocalizerSettings

SETTINGS = LocalizerSettings()
FRAMES = slice(4, 16, 3)


@pytest.fixture(scope="module")
def view(mapped_street, second_drive) -> MapView:
    return view_of(mapped_street, second_drive, mapped_street.content)


@pytest.fixture(scope="module")
def view_without_orientations(mapped_street, second_drive) -> MapView:
    """As maps before format 2.1 are."""
    landmarks = replace(mapped_street.content.landmarks, angles_deg=None)
    return view_of(mapped_street, second_drive, replace(mapped_street.content, landmarks=landmarks))


def view_of(mapped_street, second_drive, content) -> MapView:
    survey_camera = mapped_street.manifest.camera.to_camera()
    return MapView(LocalizableMap("street", "0" * 64, survey_camera, content), second_drive.camera, SETTINGS)


@pytest.fixture(scope="module")
def likeness_of(view, second_drive):
    """How much altered images are like the map at their true poses, or ``ahead_m`` further on."""
    extractor = FeatureExtractor(second_drive.camera)

    def measure(alter, ahead_m: float = 0.0, view: MapView = view) -> list[Likeness]:
        found = []
        for index in range(len(second_drive.frames))[FRAMES]:
            frame, truth = second_drive.frames[index], second_drive.truth.pose(index)
            true_m = view.anchor.map_from_utm(truth.translation_m) + ahead_m * truth.rotation[:, 2]
            image = QueryImage.of(Frame(frame.stamp_ns, alter(frame.image)), extractor)
            found.append(likeness_at(view, second_drive.camera, image, Pose(truth.rotation, true_m)))
        return found

    return measure


def unchanged(image: np.ndarray) -> np.ndarray:
    return image


def mirrored(image: np.ndarray) -> np.ndarray:
    """Something else of the same light and kind."""
    return np.ascontiguousarray(image[:, ::-1])


def half_mirrored(image: np.ndarray) -> np.ndarray:
    middle = image.shape[1] // 2
    return np.ascontiguousarray(np.hstack([image[:, :middle], image[:, :middle][:, ::-1]]))


def darkened(image: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(1).normal(0.0, 3.0, image.shape)
    return np.clip(255.0 * (image / 255.0) ** 1.8 + noise, 0, 255).astype(np.uint8)


def test_the_street_is_like_its_map_all_over_the_view(likeness_of) -> None:
    for each in likeness_of(unchanged):
        assert each.alike > 0.85
        assert 0.5 < each.landmarks_alike < 0.95


def test_in_the_dark_it_still_is(likeness_of) -> None:
    for bright, dark in zip(likeness_of(unchanged), likeness_of(darkened), strict=True):
        assert dark.alike > 0.8 * bright.alike
        assert 0.8 * bright.landmarks_alike < dark.landmarks_alike < 1.02 * bright.landmarks_alike


def test_something_else_is_not(likeness_of) -> None:
    for each in likeness_of(mirrored):
        assert each.alike < 0.4
        assert each.landmarks_alike < 0.15


def test_of_half_a_street_half_is(likeness_of) -> None:
    for whole, half in zip(likeness_of(unchanged), likeness_of(half_mirrored), strict=True):
        assert 0.35 < half.alike / whole.alike < 0.8
        assert 0.35 < half.landmarks_alike / whole.landmarks_alike < 0.85


def test_a_pose_beside_the_true_one_is_told_as_well(likeness_of) -> None:
    for right, wrong in zip(likeness_of(unchanged), likeness_of(unchanged, ahead_m=3.0), strict=True):
        assert wrong.alike < 0.7 * right.alike
        assert wrong.landmarks_alike < 0.6 * right.landmarks_alike


def test_without_orientations_less_is_alike_and_weighs_more(likeness_of, view_without_orientations) -> None:
    without = likeness_of(unchanged, view=view_without_orientations)
    for oriented, each in zip(likeness_of(unchanged), without, strict=True):
        assert (oriented.is_oriented, each.is_oriented) == (True, False)
        assert each.landmarks_alike < oriented.landmarks_alike
        assert place_score(each) > place_score(replace(each, is_oriented=True))


def test_places_score_by_their_likeness(likeness_of, view_without_orientations) -> None:
    least = SETTINGS.relocalization.min_place_score
    for view in ({}, {"view": view_without_orientations}):
        assert min(place_score(each) for each in likeness_of(unchanged, **view)) > least
        assert max(place_score(each) for each in likeness_of(mirrored, **view)) < least
        assert max(place_score(each) for each in likeness_of(unchanged, ahead_m=3.0, **view)) < least
    assert max(place_score(each) for each in likeness_of(half_mirrored)) < least


def test_where_nothing_is_in_view_nothing_is_alike(view, second_drive) -> None:
    image = QueryImage.of(second_drive.frames[0], FeatureExtractor(second_drive.camera))
    far_above = Pose(np.eye(3), np.array([0.0, 0.0, 5000.0]))
    assert likeness_at(view, second_drive.camera, image, far_above) == Likeness(0.0, 0.0, is_oriented=True)


def test_a_margin_is_whole_at_the_landmark_itself_and_nothing_between_it_and_another() -> None:
    own, other, apart = (
        np.array([0, 60, 30, 60, 200]),
        np.array([60, 0, 30, 90, 10]),
        np.array([60, 60, 60, 60, 0]),
    )
    assert margins_of(own, other, apart).tolist() == [1.0, -1.0, 0.0, 0.5, -1.0]
