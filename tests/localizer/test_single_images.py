"""Single images as they come: JPEG or PNG, grey or colour, turned by EXIF or not."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest

from fleetmap.errors import CalibrationError
from fleetmap.localization import Localized
from fleetmap_localizer.map_source import read_map
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.settings import LocalizerSettings
from fleetmap_localizer.single_images import UnreadableImageError, locate

NUMBER = 6  # of the image in the second drive


@pytest.fixture(scope="module")
def views(mapped_street, second_drive) -> tuple[MapView, ...]:
    return (MapView(read_map(mapped_street.package), second_drive.camera, LocalizerSettings()),)


@pytest.fixture(scope="module")
def grey(second_drive) -> np.ndarray:
    return second_drive.frames[NUMBER].image


@pytest.fixture(scope="module")
def answer(grey, views, second_drive) -> Localized:
    """What the image itself, without any loss, is answered with."""
    return locate(encoded(grey, ".png"), second_drive.camera, views)


def encoded(image: np.ndarray, suffix: str) -> bytes:
    done, data = cv2.imencode(suffix, image)
    assert done
    return bytes(data)


def turned_by_exif(jpeg: bytes, orientation: int) -> bytes:
    """A JPEG with a tag that asks viewers to turn it (EXIF 2.3, tag 0x0112)."""
    entry = struct.pack(">HHIHH", 0x0112, 3, 1, orientation, 0)
    exif = b"Exif\0\0" + b"MM\0*" + struct.pack(">IH", 8, 1) + entry + struct.pack(">I", 0)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]


def test_the_pose_is_the_true_one(answer, second_drive):
    assert answer.pose is not None
    error_m = answer.pose.utm_from_cam().translation_m - second_drive.truth.positions_m[NUMBER]
    assert 0.0 < np.linalg.norm(error_m) < 0.3


def test_colour_and_depth_do_not_matter(answer, grey, views, second_drive):
    for image in (np.stack([grey] * 3, axis=2), np.stack([grey] * 3 + [np.full_like(grey, 9)], axis=2)):
        assert locate(encoded(image, ".png"), second_drive.camera, views) == answer


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_an_image_is_taken_as_the_sensor_saw_it_however_exif_would_turn_it(
    answer, grey, views, second_drive, orientation
):
    plain = encoded(grey, ".jpg")
    turned = turned_by_exif(plain, orientation)
    assert cv2.imdecode(np.frombuffer(turned, dtype=np.uint8), 0).shape == (
        grey.shape[::-1] if orientation == 6 else grey.shape
    )  # others do turn it
    told = locate(turned, second_drive.camera, views)
    assert told.pose is not None
    assert told == locate(plain, second_drive.camera, views)


def test_an_image_that_was_turned_indeed_is_told_from_one_of_another_camera(grey, views, second_drive):
    height_px, width_px = grey.shape
    with pytest.raises(CalibrationError, match=f"wall.jpg has {height_px}x{width_px} pixels.*EXIF"):
        locate(encoded(grey.T, ".jpg"), second_drive.camera, views, name="wall.jpg")
    with pytest.raises(CalibrationError) as refused:
        locate(encoded(grey[:-2], ".jpg"), second_drive.camera, views)
    assert "EXIF" not in str(refused.value)


def test_a_stamp_comes_back_and_means_nothing_else(answer, grey, views, second_drive):
    told = locate(encoded(grey, ".png"), second_drive.camera, views, stamp_ns=-5)
    assert told.pose is not None
    assert told.pose.stamp_ns == -5
    assert told.pose.model_copy(update={"stamp_ns": None}) == answer.pose


def test_without_maps_there_is_no_pose(grey, second_drive):
    told = locate(encoded(grey, ".png"), second_drive.camera, ())
    assert told.pose is None
    assert told.reason


def test_other_formats_are_refused_by_name(grey, second_drive):
    for suffix in (".webp", ".bmp"):
        with pytest.raises(UnreadableImageError, match="a picture is neither JPEG nor PNG"):
            locate(encoded(grey, suffix), second_drive.camera, (), name="a picture")
