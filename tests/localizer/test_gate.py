"""The gate: many inliers are not enough, they must fill the view and have no rival."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap.vision.absolute_pose import AbsolutePose
from fleetmap_localizer.gate import Fit, chance_of, is_trustworthy
from fleetmap_localizer.settings import GateSettings

CAMERA = Camera(800, 400, 500.0, 500.0, 399.5, 199.5)
SETTINGS = GateSettings(chance_ratio=0.015, max_chance=1e-6, min_coverage=0.5, max_position_sigma_m=0.2)
EVERYWHERE = np.stack(np.meshgrid(np.arange(5, 800, 20.0), np.arange(5, 400, 20.0)), axis=-1).reshape(-1, 2)


def fit(
    inlier_px: np.ndarray,
    outliers: int = 0,
    position_sigma_m: float = 0.02,
    rotation_sigma_deg: float = 0.1,
    predicted_px: np.ndarray = EVERYWHERE,
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Fit:
    inliers = np.arange(len(inlier_px) + outliers) < len(inlier_px)
    pixels = np.vstack([inlier_px, np.full((outliers, 2), 10.0)])
    sigmas = np.r_[np.full(3, np.radians(rotation_sigma_deg)), np.full(3, position_sigma_m)]
    answer = AbsolutePose(Pose(np.eye(3), np.array(position_m)), inliers, np.diag(sigmas**2))
    ones = np.ones(len(pixels))
    return Fit(answer, np.arange(len(pixels)), pixels, ones, predicted_px, EVERYWHERE)


def trusted(candidate: Fit) -> bool:
    return is_trustworthy(candidate, CAMERA, SETTINGS)


def test_landmarks_that_agree_all_over_the_view_are_trusted() -> None:
    assert trusted(fit(EVERYWHERE[::10]))


def test_too_few_inliers_or_too_many_outliers_are_not() -> None:
    assert not trusted(fit(EVERYWHERE[::30]))
    assert trusted(fit(EVERYWHERE[::19]))
    assert trusted(fit(EVERYWHERE[::10], outliers=70))
    assert not trusted(fit(EVERYWHERE[::10], outliers=90))


def test_few_of_many_expected_landmarks_are_not_trusted() -> None:
    expected = np.repeat(EVERYWHERE, 4, axis=0)
    assert trusted(fit(EVERYWHERE[::8], predicted_px=expected))
    assert not trusted(fit(EVERYWHERE[::10], predicted_px=expected))


def test_a_sparse_map_asks_for_fewer_landmarks_but_never_for_fewer_than_geometry_needs() -> None:
    sparse = EVERYWHERE[::8]
    assert len(sparse) == 100
    assert trusted(fit(sparse[::7], predicted_px=sparse))
    assert not trusted(fit(EVERYWHERE[::53]))  # as many, of eight times as many
    assert len(sparse[::10]) < SETTINGS.min_inliers
    assert not trusted(fit(sparse[::10], predicted_px=sparse[::9]))


def test_the_chance_of_agreement_bounds_that_of_random_landmarks() -> None:
    rng = np.random.default_rng(0)
    for predicted, ratio, agreeing in ((100, 0.05, 12), (1000, 0.02, 32), (50, 0.1, 11)):
        drawn = rng.binomial(predicted, ratio, 200_000)
        measured = np.mean(drawn >= agreeing)
        assert 0.0 < measured <= chance_of(agreeing, predicted, ratio) < 20.0 * measured
    assert chance_of(1, 100, 0.02) == 1.0
    assert chance_of(100, 100, 0.02) == pytest.approx(0.02**100)
    assert chance_of(0, 0, 0.02) == 1.0


def test_a_copy_of_one_house_is_not_trusted_however_many_points_it_has() -> None:
    left_quarter = EVERYWHERE[EVERYWHERE[:, 0] < 200]
    assert len(left_quarter) == 200
    assert not trusted(fit(left_quarter))
    assert trusted(fit(left_quarter, predicted_px=left_quarter))  # nothing was expected elsewhere


def test_all_points_in_a_few_cells_are_not_trusted() -> None:
    corner = EVERYWHERE[(EVERYWHERE[:, 0] < 200) & (EVERYWHERE[:, 1] < 100)]
    assert len(corner) == 50
    assert not trusted(fit(corner, predicted_px=corner))


def test_a_pose_that_is_hardly_held_is_not_trusted() -> None:
    assert not trusted(fit(EVERYWHERE[::10], position_sigma_m=0.21))
    assert not trusted(fit(EVERYWHERE[::10], rotation_sigma_deg=1.1))
