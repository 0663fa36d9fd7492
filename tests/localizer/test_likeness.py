"""Likeness: an image of the mapped street is told from one of which only a part shows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.drive import Frame
from fleetmap.geometry import Pose
from fleetmap.vision.absolute_pose import AbsolutePose
from fleetmap.vision.features import FeatureExtractor
from fleetmap_localizer.likeness import PLACE_WEIGHTS, Likeness, likeness_at, place_evidence, place_score
from fleetmap_localizer.map_view import LocalizableMap, MapView
from fleetmap_localizer.query_image import QueryImage
from fleetmap_localizer.settings import LocalizerSettings

SETTINGS = LocalizerSettings()
FRAMES = slice(4, 16, 3)


@pytest.fixture(scope="module")
def view(mapped_street, second_drive) -> MapView:
    survey_camera = mapped_street.manifest.camera.to_camera()
    source = LocalizableMap("street", "0" * 64, survey_camera, mapped_street.content)
    return MapView(source, second_drive.camera, SETTINGS)


@pytest.fixture(scope="module")
def likeness_of(view, second_drive):
    """How much altered images are like the map at their true poses, or ``ahead_m`` further on."""
    extractor = FeatureExtractor(second_drive.camera)

    def measure(alter, ahead_m: float = 0.0) -> list[Likeness]:
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
        assert each.much_alike > 0.4
        assert each.landmarks_alike > 0.5
        assert 0.2 < each.landmarks_unmistakable < 0.8


def test_in_the_dark_it_still_is(likeness_of) -> None:
    for bright, dark in zip(likeness_of(unchanged), likeness_of(darkened), strict=True):
        assert dark.alike > 0.8 * bright.alike
        assert dark.landmarks_alike < bright.landmarks_alike


def test_something_else_is_not(likeness_of) -> None:
    for each in likeness_of(mirrored):
        assert each.alike < 0.4
        assert each.much_alike < 0.1
        assert each.landmarks_alike < 0.15
        assert each.landmarks_unmistakable < 0.05


def test_of_half_a_street_half_is(likeness_of) -> None:
    for whole, half in zip(likeness_of(unchanged), likeness_of(half_mirrored), strict=True):
        assert 0.35 < half.alike / whole.alike < 0.8
        assert 0.2 < half.much_alike / whole.much_alike < 0.8


def test_a_pose_beside_the_true_one_is_told_as_well(likeness_of) -> None:
    for right, wrong in zip(likeness_of(unchanged), likeness_of(unchanged, ahead_m=3.0), strict=True):
        assert wrong.alike < 0.7 * right.alike
        assert wrong.landmarks_alike < 0.5 * right.landmarks_alike


def test_where_nothing_is_in_view_nothing_is_alike(view, second_drive) -> None:
    image = QueryImage.of(second_drive.frames[0], FeatureExtractor(second_drive.camera))
    far_above = Pose(np.eye(3), np.array([0.0, 0.0, 5000.0]))
    assert likeness_at(view, second_drive.camera, image, far_above) == Likeness(0.0, 0.0, 0.0, 0.0)


def answer(position_sigma_m: float) -> AbsolutePose:
    sigmas = np.r_[np.full(3, 1e-3), np.full(2, 0.01), position_sigma_m]
    return AbsolutePose(Pose(np.eye(3), np.zeros(3)), np.ones(20, np.bool_), np.diag(sigmas**2))


def test_a_place_scores_by_what_is_alike_and_by_how_firmly_its_pose_is_held() -> None:
    firm, loose = answer(0.03), answer(0.3)
    likeness = Likeness(alike=0.8, much_alike=0.3, landmarks_alike=0.4, landmarks_unmistakable=0.2)
    assert place_score(likeness, firm) == pytest.approx(PLACE_WEIGHTS @ place_evidence(likeness, firm))
    assert place_score(likeness, firm) > SETTINGS.relocalization.min_place_score > place_score(likeness, loose)
    for name, less in (("alike", 0.4), ("landmarks_alike", 0.2), ("landmarks_unmistakable", 0.05)):
        assert place_score(replace(likeness, **{name: less}), firm) < place_score(likeness, firm)
