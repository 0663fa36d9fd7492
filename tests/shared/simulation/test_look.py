"""Lens and sensor do what their numbers say."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.errors import InputError
from fleetmap.geometry import Pose
from fleetmap.simulation.look import LOOKS, Look, look_of_drive

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


@pytest.mark.parametrize("light", [0.1, 0.3, 1.0, 2.5])
@pytest.mark.parametrize("gamma", [0.8, 1.3])
def test_automatic_exposure_brings_the_mean_to_its_target_in_dark_and_bright_scenes(
    light: float, gamma: float
) -> None:
    rng = np.random.default_rng(0)
    scene = np.kron(rng.uniform(40.0, 200.0, (12, 16)), np.ones((10, 10))).astype(np.float32) * np.float32(light)
    image = Look(auto_exposure_grey=100.0, gamma=gamma).apply(scene, Pose.identity())
    assert image.mean() == pytest.approx(100.0, abs=6.0)


def test_automatic_exposure_reaches_sixteen_times_and_amplifies_the_noise() -> None:
    black = Look(auto_exposure_grey=100.0, **_IDEAL).apply(_FLAT * np.float32(0.01), Pose.identity())
    assert (black == round(120.0 * 0.01 * 16.0)).all()
    look = Look(auto_exposure_grey=127.5, noise_sigma=2.0, blur_sigma_px=0.0, vignetting=0.0)
    sigmas = [
        look.apply(_FLAT * np.float32(light), Pose.identity()).astype(float).std()
        for light in (1.0625, 1.0625 / 9.0)
    ]
    assert 1.9 < sigmas[0] < 2.1
    assert 2.8 < sigmas[1] / sigmas[0] < 3.2  # nine times fewer photons


def test_a_look_of_the_sky_flattens_shaded_sides_and_leaves_lamps() -> None:
    brightness, is_lamp = np.array([0.42, 1.2, 0.42]), np.array([False, False, True])
    day, overcast, dusk = (LOOKS[name].surface_light(brightness, is_lamp) for name in ("day", "overcast", "dusk"))
    np.testing.assert_array_equal(day, brightness)
    assert 1.2 < overcast[1] / overcast[0] < 2.0 < day[1] / day[0]
    assert dusk[:2].max() < 0.2
    assert dusk[2] == 1.0


def test_a_drive_draws_its_look_from_its_seed() -> None:
    looks = [look_of_drive("overcast", seed) for seed in range(20)]
    assert looks[3] == look_of_drive("overcast", 3)
    for name in ("gamma", "noise_sigma", "blur_sigma_px", "vignetting", "auto_exposure_grey"):
        assert len({getattr(look, name) for look in looks}) == 20
    assert {look.sun_contrast for look in looks} == {LOOKS["overcast"].sun_contrast}
    assert look_of_drive("day", 3).gamma != looks[3].gamma


def test_an_unknown_look_is_refused_with_the_known_ones() -> None:
    with pytest.raises(InputError, match="no look 'night'; choose from day, overcast, dusk, wet"):
        look_of_drive("night", 1)
