"""Sharpness and exposure of one image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from fleetmap.vision.image_look import look_at


@pytest.fixture(scope="module")
def image(survey_frames):
    return survey_frames[10].image


def test_blur_grows_with_every_blur(image):
    blurs = [
        look_at(image).blur,
        *(look_at(cv2.GaussianBlur(image, (0, 0), s)).blur for s in (0.7, 1.0, 1.5, 2.5)),
    ]
    assert blurs[0] < 0.35
    assert all(np.diff(blurs) > 0.03)
    assert blurs[3] > 0.48
    assert blurs[4] > 0.65


def test_motion_along_one_axis_is_blur(image):
    for size in ((9, 1), (1, 9)):
        assert look_at(cv2.blur(image, size)).blur > look_at(image).blur + 0.25


def test_a_darker_image_of_the_same_scene_is_as_sharp(image):
    assert look_at((image * 0.5).astype(np.uint8)).blur == pytest.approx(look_at(image).blur, abs=0.08)


def test_noise_does_not_hide_blur_altogether(image):
    noise = np.random.default_rng(0).normal(0.0, 3.0, image.shape)
    blurred = cv2.GaussianBlur(image, (0, 0), 2.0)
    assert look_at(np.clip(blurred + noise, 0, 255).astype(np.uint8)).blur > look_at(image).blur + 0.15


def test_an_image_without_edges_has_nothing_sharp():
    assert look_at(np.full((48, 64), 90, np.uint8)).blur == 1.0


def test_exposure_counts_what_is_lost():
    image = np.full((100, 100), 120, np.uint8)
    image[:30], image[30:40] = 255, 3
    look = look_at(image)
    assert (look.saturated_share, look.black_share) == (pytest.approx(0.3), pytest.approx(0.1))
    assert look.mean_grey == pytest.approx(image.mean())
