"""Descriptors and orientations: what cv2.ORB gives the same corners, because stored maps hold those."""

from __future__ import annotations

import cv2
import numpy as np

from fleetmap.vision.descriptors import BORDER_PX, DESCRIPTOR_BYTES, describe_along, orientations_deg
from fleetmap.vision.pyramid import blurred, image_pyramid


def describe(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Along what each corner shows, as features are."""
    return describe_along(blurred(image), pixels, orientations_deg(image, pixels))


def textured_image() -> np.ndarray:
    noise = np.random.default_rng(5).normal(0.0, 1.0, (320, 480))
    image = sum(sigma * cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in (1.0, 3.0, 9.0))
    return cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def opencv_keypoints(image: np.ndarray) -> tuple[list[cv2.KeyPoint], np.ndarray]:
    """Found, oriented and described by OpenCV alone, sorted by level."""
    keypoints, descriptors = cv2.ORB.create(1500, fastThreshold=5).detectAndCompute(image, None)
    order = np.argsort([k.octave for k in keypoints], kind="stable")
    return [keypoints[n] for n in order], descriptors[order]


def level_pixels(keypoints: list[cv2.KeyPoint], level: int) -> np.ndarray:
    on_level = [k.pt for k in keypoints if k.octave == level]
    return np.rint(np.array(on_level).reshape(-1, 2) / 1.2**level).astype(np.int32)


def test_the_same_corners_get_the_descriptors_that_stored_maps_hold() -> None:
    image = textured_image()
    keypoints, expected = opencv_keypoints(image)
    corners = [level_pixels(keypoints, level) for level in range(8)]
    assert min(len(c) for c in corners) > 20
    described = [describe(*on_level) for on_level in zip(image_pyramid(image, 8, 1.2), corners, strict=True)]
    assert np.array_equal(np.concatenate(described), expected)


def test_at_every_angle_the_pattern_is_turned_to_the_very_pixels_that_opencv_turns_it_to() -> None:
    """Rounding half to even, single precision: one of them missed, some of a map's bits would be others."""
    noise = np.random.default_rng(7).integers(0, 256, (300, 400)).astype(np.uint8)
    image = cv2.blur(noise, (3, 3))
    pixels = (
        np.stack(np.meshgrid(np.arange(19, 381, 3), np.arange(19, 281, 3)), axis=2).reshape(-1, 2).astype(np.int32)
    )
    angles = orientations_deg(image, pixels)
    keypoints = [
        cv2.KeyPoint(x, y, 31.0, a, 0.0, 0) for (x, y), a in zip(pixels.tolist(), angles.tolist(), strict=True)
    ]
    _, expected = cv2.ORB.create(nlevels=1, edgeThreshold=BORDER_PX, patchSize=31).compute(image, keypoints)
    assert np.histogram(angles, bins=72, range=(0.0, 360.0))[0].min() > 50
    assert np.array_equal(describe(image, pixels), expected)


def test_orientations_are_those_of_opencv_on_every_level() -> None:
    image = textured_image()
    keypoints, _ = opencv_keypoints(image)
    for level, on_level in enumerate(image_pyramid(image, 8, 1.2)):
        expected = np.array([k.angle for k in keypoints if k.octave == level])
        angles = orientations_deg(on_level, level_pixels(keypoints, level))
        assert np.abs(angles - expected).max() < 1e-3


def test_an_orientation_points_to_the_bright_side() -> None:
    image = np.zeros((60, 60), np.uint8)
    image[:, 30:] = 200
    turned = np.rot90(image)  # bright above: y grows downwards
    assert abs(orientations_deg(image, np.array([[30, 30]], np.int32))[0]) < 0.5
    assert abs(orientations_deg(turned, np.array([[30, 29]], np.int32))[0] - 270.0) < 0.5


def test_corners_up_to_the_border_are_described_and_none_is_lost() -> None:
    image = textured_image()
    for level in image_pyramid(image, 8, 1.2):
        bottom, right = level.shape[0] - BORDER_PX - 1, level.shape[1] - BORDER_PX - 1
        corners = np.array([(x, y) for y in (BORDER_PX, bottom) for x in (BORDER_PX, right)], np.int32)
        descriptors = describe(level, corners)
        assert descriptors.shape == (4, DESCRIPTOR_BYTES)
        assert all(10 < np.unpackbits(d).sum() < 246 for d in descriptors)


def test_no_corners_no_descriptors() -> None:
    assert describe(textured_image(), np.zeros((0, 2), np.int32)).shape == (0, DESCRIPTOR_BYTES)
