"""Lens and sensor do what their numbers say."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.geometry import Pose
from fleetmap.simulation.look import Look

_FLAT = np.full((120, 160), 120.0, dtype=np.float32)
_IDEAL = {"noise_sigma": 0.0, "blur_sigma_px": 0.0, "vignetting": 0.0}


def test_an_ideal_look_changes_nothing() -> None:
    assert (Look(**_IDEAL).apply(_FLAT, Pose.identity()) == 120).all()


def test_exposure_scales_the_light_and_saturates() -> None:
    assert (Look(exposure=0.5, **_IDEAL).apply(_FLAT, Pose.identity()) == 60).all()
    assert (Look(exposure=3.0, **_IDEAL).apply(_FLAT, Pose.identity()) == 255).all()


def test_gamma_bends_the_curve_between_black_and_white() -> None:
    image = Look(gamma=2.0, **_IDEAL).apply(_FLAT, Pose.identity())
    assert (image == round(255.0 * (120.0 / 255.0) ** 2.0)).all()


def test_noise_has_its_sigma_at_mid_grey_and_differs_between_poses() -> None:
    look = Look(noise_sigma=4.0, blur_sigma_px=0.0, vignetting=0.0)
    mid_grey = np.full((120, 160), 127.5, dtype=np.float32)
    here = look.apply(mid_grey, Pose.identity())
    there = look.apply(mid_grey, Pose(np.eye(3), np.array([0.0, 0.0, 0.8])))
    assert 3.8 < here.astype(float).std() < 4.2
    assert here.mean() == pytest.approx(127.5, abs=0.2)
    correlation = np.corrcoef(here.ravel(), there.ravel())[0, 1]
    assert abs(correlation) < 0.05


def test_vignetting_darkens_the_corners_alone() -> None:
    image = Look(noise_sigma=0.0, blur_sigma_px=0.0, vignetting=0.3).apply(_FLAT, Pose.identity())
    assert image[60, 80] == 120
    assert image[0, 0] == pytest.approx(84, abs=1)


def test_blur_keeps_the_mean_and_softens_an_edge() -> None:
    edge = np.where(np.arange(160) < 80, 40.0, 200.0)[None, :].repeat(120, axis=0).astype(np.float32)
    image = Look(noise_sigma=0.0, blur_sigma_px=1.5, vignetting=0.0).apply(edge, Pose.identity()).astype(float)
    assert image.mean() == pytest.approx(120.0, abs=0.5)
    assert 35.0 < np.abs(np.diff(image[60])).max() < 50.0  # 160 / (1.5 sqrt(2 pi)) = 42.6
