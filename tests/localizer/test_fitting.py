"""Fitting: from a guess near the truth to the pose, by landmarks described along their own orientations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.drive import Frame
from fleetmap.geometry import Pose, so3_exp
from fleetmap.simulation.look import Look
from fleetmap.simulation.rendering import render
from fleetmap.vision.features import FeatureExtractor
from fleetmap_localizer.fitting import fit_around
from fleetmap_localizer.gate import Fit
from fleetmap_localizer.map_view import LocalizableMap, MapView
from fleetmap_localizer.query_image import QueryImage
from fleetmap_localizer.settings import LocalizerSettings

SETTINGS = LocalizerSettings()
DUSK = Look(exposure=0.5, gamma=1.6, noise_sigma=5.0, blur_sigma_px=1.0, seed=5)
NIGHTFALL = Look(exposure=0.35, gamma=1.8, noise_sigma=6.0, blur_sigma_px=1.3, seed=5)
FRAMES = slice(4, 16, 3)
GUESS_M = np.array([0.15, -0.05, 0.2])


@pytest.fixture(scope="module")
def fits_of(mapped_street, second_drive):
    """Fits, and how many metres they are off; with the map's orientations turned, or unknown."""
    camera = second_drive.camera
    extractor = FeatureExtractor(camera)

    def measure(look: Look, turned_deg: float | None = 0.0, rolled_deg: float = 0.0) -> list[tuple[Fit, float]]:
        landmarks = mapped_street.content.landmarks
        angles = None if turned_deg is None else landmarks.angles_deg + np.float32(turned_deg)
        content = replace(mapped_street.content, landmarks=replace(landmarks, angles_deg=angles))
        survey_camera = mapped_street.manifest.camera.to_camera()
        view = MapView(LocalizableMap("street", "0" * 64, survey_camera, content), camera, SETTINGS)
        found = []
        for index in range(len(second_drive.frames))[FRAMES]:
            truth = second_drive.truth.pose(index)
            rotation = truth.rotation @ so3_exp(np.radians([0.0, 0.0, rolled_deg]))
            pose = Pose(rotation, view.anchor.map_from_utm(truth.translation_m))
            frame = Frame(index, render(mapped_street.street, camera, pose, look))
            guess = Pose(rotation, pose.translation_m + GUESS_M)
            fit = fit_around(view, camera, QueryImage.of(frame, extractor), guess, (15.0, 5.0), SETTINGS.fitting)
            assert fit is not None
            error_m = np.linalg.norm(fit.answer.map_from_cam.translation_m - pose.translation_m)
            found.append((fit, float(error_m)))
        return found

    return measure


def inliers(fits: list[tuple[Fit, float]]) -> float:
    return float(np.mean([fit.answer.inlier_count for fit, _ in fits]))


def test_poses_are_found_from_a_guess_beside_them(fits_of) -> None:
    for _, error_m in fits_of(DUSK):
        assert 1e-5 < error_m < 0.04


def test_along_the_maps_orientations_more_landmarks_are_recognised(fits_of) -> None:
    along, without = fits_of(NIGHTFALL), fits_of(NIGHTFALL, turned_deg=None)  # as maps before format 2.1 are
    assert 1.08 < inliers(along) / inliers(without) < 2.0
    assert min(fit.answer.inlier_count / len(fit.matched_px) for fit, _ in along) > 0.8
    for fits in (along, without):
        assert np.median([error_m for _, error_m in fits]) < 0.1


def test_a_camera_that_leans_recognises_as_many(fits_of) -> None:
    """Orientations count from what is up in the image, not from its border."""
    upright, leaning = fits_of(DUSK), fits_of(DUSK, rolled_deg=25.0)
    assert 0.8 < inliers(leaning) / inliers(upright) < 1.25
    assert max(error_m for _, error_m in leaning) < 0.06


def test_along_wrong_orientations_fewer_are_recognised(fits_of) -> None:
    wrong, without = fits_of(DUSK, turned_deg=15.0), fits_of(DUSK, turned_deg=None)
    assert 0.2 < inliers(wrong) / inliers(without) < 0.7
