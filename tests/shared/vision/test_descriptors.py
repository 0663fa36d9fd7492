"""Descriptors and orientations: what cv2.ORB gives the same corners, because stored maps hold those."""

from __future__ import annotations

import cv2
import numpy as np

from fleetmap.vision.descriptors import BORDER_PX, DESCRIPTOR_BYTES, Describer, orientations_deg
from fleetmap.vision.pyramid import image_pyramid


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
    described = Describer(8, 1.2).describe(image_pyramid(image, 8, 1.2), corners)
    assert np.array_equal(described, expected)


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
    pyramid = image_pyramid(image, 8, 1.2)
    corners = []
    for level in pyramid:
        bottom, right = level.shape[0] - BORDER_PX - 1, level.shape[1] - BORDER_PX - 1
        corners.append(np.array([(x, y) for y in (BORDER_PX, bottom) for x in (BORDER_PX, right)], np.int32))
    descriptors = Describer(8, 1.2).describe(pyramid, corners)
    assert descriptors.shape == (32, DESCRIPTOR_BYTES)
    assert all(10 < np.unpackbits(d).sum() < 246 for d in descriptors)


def test_no_corners_no_descriptors() -> None:
    pyramid = image_pyramid(textured_image(), 8, 1.2)
    none = np.zeros((0, 2), np.int32)
    assert Describer(8, 1.2).describe(pyramid, [none] * 8).shape == (0, DESCRIPTOR_BYTES)
