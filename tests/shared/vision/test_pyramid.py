"""The image pyramid: its sizes, and where its pixels lie."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.vision.pyramid import image_from_level_px, image_pyramid, level_from_image_px


def ramp(width: int, height: int, across: float, down: float) -> np.ndarray:
    """A plane of grey: what linear interpolation keeps as it is."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    return np.rint(20.0 + across * x + down * y).astype(np.uint8)


def test_each_level_is_smaller_by_the_factor_and_the_first_is_the_image() -> None:
    image = ramp(1241, 376, 0.1, 0.2)
    pyramid = image_pyramid(image, levels=8, scale_factor=1.2)
    assert np.array_equal(pyramid[0], image)
    assert [level.shape for level in pyramid] == [(round(376 / 1.2**n), round(1241 / 1.2**n)) for n in range(8)]
    assert all(level.dtype == np.uint8 and level.flags.c_contiguous for level in pyramid)


def test_a_slice_of_a_larger_image_is_taken_too() -> None:
    image = ramp(300, 200, 0.5, 0.2)
    whole, part = image_pyramid(image[20:120, 30:230].copy(), 4, 1.2), image_pyramid(image[20:120, 30:230], 4, 1.2)
    assert all(np.array_equal(a, b) for a, b in zip(whole, part, strict=True))


def test_an_image_smaller_than_its_pyramid_ends_in_single_pixels() -> None:
    assert [level.shape for level in image_pyramid(ramp(3, 2, 1.0, 1.0), 4, 2.0)] == [
        (2, 3),
        (1, 2),
        (1, 1),
        (1, 1),
    ]


@pytest.mark.parametrize(("width", "height"), [(1241, 376), (1392, 512), (333, 251)])
def test_a_pixel_of_a_level_shows_what_the_image_shows_there(width: int, height: int) -> None:
    across, down = 200.0 / width, 30.0 / height
    image = ramp(width, height, across, down)
    for level in image_pyramid(image, 8, 1.2):
        inside = np.array([[x, y] for x in (2, level.shape[1] - 3) for y in (2, level.shape[0] - 3)])
        at = image_from_level_px(inside.astype(float), image.shape, level.shape)
        there = 20.0 + across * at[:, 0] + down * at[:, 1]
        assert (
            np.abs(level[inside[:, 1], inside[:, 0]] - there).max() < 1.3
        )  # a few roundings to whole grey levels


def test_a_blob_lies_where_the_convention_says_to_a_small_part_of_a_pixel() -> None:
    centre = np.array([[900.3, 300.6]])
    x, y = np.meshgrid(np.arange(1241), np.arange(376))
    image = np.rint(250.0 * np.exp(-((x - 900.3) ** 2 + (y - 300.6) ** 2) / (2 * 8.0**2))).astype(np.uint8)
    for level in image_pyramid(image, 8, 1.2):
        weights = level.astype(float) / level.sum()
        x, y = np.meshgrid(np.arange(level.shape[1]), np.arange(level.shape[0]))
        seen = np.array([(weights * x).sum(), (weights * y).sum()])
        assert np.abs(seen - level_from_image_px(centre, image.shape, level.shape)).max() < 0.02


def test_to_a_level_and_back_is_the_same_pixel() -> None:
    pixels = np.array([[0.0, 0.0], [1240.0, 375.0], [17.25, 301.5]])
    there = level_from_image_px(pixels, (376, 1241), (181, 598))
    assert np.allclose(image_from_level_px(there, (376, 1241), (181, 598)), pixels, atol=1e-12)
