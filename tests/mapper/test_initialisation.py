"""The first map from two images of the simulated street, against their true poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, rotation_angle_rad, so3_exp
from fleetmap.simulation.driving import drive_along
from fleetmap.simulation.look import Look
from fleetmap.simulation.rendering import render
from fleetmap.simulation.simulated_drive import simulate_drive
from fleetmap.simulation.street import build_street
from fleetmap.vision.features import FeatureExtractor, FeatureSettings
from fleetmap_mapper.initialisation import TwoViewMap, map_from_two_views, match_two_views
from fleetmap_mapper.settings import MapperSettings

FIRST = 10


@pytest.fixture(scope="module")
def two_views(survey, survey_drive):
    """What the image at a pose and the survey's image 10 make of each other."""
    extractor = FeatureExtractor(survey_drive.camera, FeatureSettings(count=4000))
    first = extractor.extract(survey_drive.images[FIRST].image)
    at = survey.truth.pose(FIRST)
    origin = replace(at, translation_m=survey.street.anchor.map_from_utm(at.translation_m))

    def look(first_from_second: Pose) -> TwoViewMap | None:
        image = render(survey.street, survey_drive.camera, origin @ first_from_second, Look(seed=3))
        second = extractor.extract(image)
        pairs = match_two_views(first, second)
        return map_from_two_views(survey_drive.camera, first, second, pairs, MapperSettings())

    return look


@pytest.mark.parametrize(
    "motion",
    [
        Pose(np.eye(3), np.array([0.5, 0.0, 0.0])),
        Pose(so3_exp(np.array([0.0, 0.03, 0.0])), np.array([0.1, 0.0, 1.6])),
        Pose(so3_exp(np.array([0.01, -0.08, 0.02])), np.array([-0.6, 0.05, 1.2])),
    ],
    ids=["sideways", "forwards", "around a corner"],
)
def test_direction_and_rotation_are_the_true_ones(two_views, motion):
    start = two_views(motion)
    assert start is not None
    direction = start.first_from_second.translation_m / np.linalg.norm(start.first_from_second.translation_m)
    true = motion.translation_m / np.linalg.norm(motion.translation_m)
    assert 0.0 < np.degrees(np.arccos(direction @ true)) < 3.0
    assert np.degrees(rotation_angle_rad(start.first_from_second.rotation.T @ motion.rotation)) < 0.5
    assert np.median(start.points[:, 2]) == pytest.approx(10.0)
    assert len(start.points) == len(start.first_features) == len(start.second_features) >= 60


def test_a_turn_on_the_spot_makes_no_map(two_views):
    """It moves pixels a lot and shows no depth at all."""
    assert two_views(Pose(so3_exp(np.array([0.0, 0.06, 0.0])), np.zeros(3))) is None


def test_a_standing_camera_makes_no_map(two_views):
    assert two_views(Pose.identity()) is None


def test_a_step_too_small_for_depth_makes_no_map(two_views):
    assert two_views(Pose(np.eye(3), np.array([0.0, 0.0, 0.02]))) is None


def test_forward_motion_is_not_mistaken_for_its_planar_twin():
    """Where facades and road dominate, a plane's second solution fits late views as well as the true one."""
    street = build_street(3, 60.0)
    camera = Camera(512, 256, 330.0, 330.0, 255.5, 127.5)
    truth = drive_along(street, seed=1)
    drive = simulate_drive(street, camera=camera, trajectory=truth)
    extractor = FeatureExtractor(camera, FeatureSettings(count=4000))
    first = extractor.extract(drive.frame(0).image)
    for later in range(1, 8):
        second = extractor.extract(drive.frame(later).image)
        start = map_from_two_views(camera, first, second, match_two_views(first, second), MapperSettings())
        if start is not None:
            break
    assert start is not None
    motion = drive.map_from_cam(0).inverse() @ drive.map_from_cam(later)
    direction = start.first_from_second.translation_m / np.linalg.norm(start.first_from_second.translation_m)
    assert np.degrees(np.arccos(direction @ motion.translation_m / np.linalg.norm(motion.translation_m))) < 5.0
    assert np.degrees(rotation_angle_rad(start.first_from_second.rotation.T @ motion.rotation)) < 1.0
