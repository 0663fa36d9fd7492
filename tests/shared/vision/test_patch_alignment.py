"""Patches of a picture that was moved, turned, stretched and relit are found where they went, or not at all."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from fleetmap.vision.patch_alignment import PATCH_PX, align_patches, sample_patches
from fleetmap.vision.pyramid import image_pyramid

LEVELS, SCALE = 8, 1.2
WIDTH, HEIGHT = 400, 300


def scenery(seed: int, smooth_px: float = 2.0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0.0, 1.0, (HEIGHT, WIDTH))
    smooth = cv2.GaussianBlur(noise, (0, 0), smooth_px)
    return np.clip(128.0 + 35.0 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def places(count: int = 60) -> np.ndarray:
    rng = np.random.default_rng(5)
    return rng.uniform([80.0, 80.0], [WIDTH - 80.0, HEIGHT - 80.0], (count, 2))


def moved(image: np.ndarray, A: np.ndarray, gain: float = 1.0, bias: float = 0.0) -> np.ndarray:
    """The picture after ``x -> A [x, 1]``, with another contrast and brightness."""
    warped = cv2.warpAffine(image.astype(np.float32), A, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC)
    return np.clip(gain * warped + bias, 0, 255).astype(np.uint8)


def aligned(image, other, A, octaves, start_error_px=0.8, max_shift_px=4.0, warp=None):
    pixels = places(len(octaves))
    truth = pixels @ A[:, :2].T + A[:, 2]
    patches = sample_patches(image_pyramid(image, LEVELS, SCALE), pixels, octaves)
    scales = np.array([WIDTH, HEIGHT]) / np.array(
        [image_pyramid(image, LEVELS, SCALE)[o].shape[::-1] for o in octaves]
    )
    warps = (A[:, :2] if warp is None else warp)[None] * scales[:, None, :]
    starts = truth + np.random.default_rng(1).uniform(-start_error_px, start_error_px, truth.shape)
    found, ok = align_patches(
        image_pyramid(other, LEVELS, SCALE), SCALE, patches, warps, starts, np.full(len(truth), max_shift_px)
    )
    np.testing.assert_array_equal(found[~ok], starts[~ok])
    return np.linalg.norm(found - truth, axis=1), ok


TURN = cv2.getRotationMatrix2D((200.0, 150.0), 5.0, 1.0)
GROW = cv2.getRotationMatrix2D((200.0, 150.0), -3.0, 1.5)
SHRINK = cv2.getRotationMatrix2D((200.0, 150.0), 2.0, 0.7)
SHIFT = np.array([[1.0, 0.0, 7.37], [0.0, 1.0, -3.71]])


@pytest.mark.parametrize("A", [SHIFT, TURN, GROW, SHRINK], ids=["shifted", "turned", "grown", "shrunk"])
def test_patches_are_found_to_a_twentieth_of_a_pixel(A):
    errors, ok = aligned(scenery(1), moved(scenery(1), A), A, np.zeros(60, int))
    assert ok.mean() > 0.9
    assert 0.0 < np.median(errors[ok]) < 0.05
    assert errors[ok].max() < 0.4


def test_patches_of_coarse_levels_are_found_too():
    octaves = np.repeat([0, 3, 6], 20)
    smooth = scenery(2, smooth_px=5.0)
    errors, ok = aligned(smooth, moved(smooth, SHIFT), SHIFT, octaves)
    assert ok.mean() > 0.8
    assert np.median(errors[ok]) < 0.1


def test_contrast_and_brightness_do_not_matter():
    errors, ok = aligned(scenery(1), moved(scenery(1), SHIFT, gain=0.6, bias=60.0), SHIFT, np.zeros(60, int))
    assert ok.mean() > 0.9
    assert np.median(errors[ok]) < 0.05


def test_what_looks_different_is_not_aligned():
    _, ok = aligned(scenery(1), moved(scenery(3), SHIFT), SHIFT, np.zeros(60, int))
    assert ok.mean() < 0.05


def test_what_has_no_texture_is_not_aligned():
    flat = np.full((HEIGHT, WIDTH), 90, np.uint8)
    _, ok = aligned(flat, flat, SHIFT, np.zeros(60, int))
    assert not ok.any()


def test_what_can_slide_along_an_edge_is_not_aligned():
    stripes = np.tile((128 + 60 * np.sin(np.arange(WIDTH) / 3.0)).astype(np.uint8), (HEIGHT, 1))
    _, ok = aligned(stripes, moved(stripes, SHIFT), SHIFT, np.zeros(60, int))
    assert not ok.any()


def test_an_alignment_far_from_the_start_is_not_believed():
    _, near = aligned(scenery(1), moved(scenery(1), SHIFT), SHIFT, np.zeros(60, int), 0.8, max_shift_px=0.2)
    _, far = aligned(scenery(1), moved(scenery(1), SHIFT), SHIFT, np.zeros(60, int), 0.8, max_shift_px=4.0)
    assert near.mean() < 0.3 < far.mean()


def test_a_patch_beyond_the_border_is_not_aligned():
    pyramid = image_pyramid(scenery(1), LEVELS, SCALE)
    corner = np.array([[2.0, 2.0], [200.0, 150.0]])
    patches = sample_patches(pyramid, corner, np.zeros(2, int))
    assert patches.shape == (2, PATCH_PX, PATCH_PX)
    assert np.isnan(patches[0]).any()
    assert np.isfinite(patches[1]).all()
    starts = np.array([[200.0, 150.0], [1.0, 1.0]])
    warps = np.tile(np.eye(2), (2, 1, 1))
    _, ok = align_patches(pyramid, SCALE, patches, warps, starts, np.full(2, 3.0))
    assert not ok.any()
