"""A mask hides parts of all images from the map."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.drives.image_codec import encode_image
from fleetmap.errors import InputError
from fleetmap.vision.features import FeatureExtractor, FeatureSettings
from fleetmap_mapper.image_mask import ImageMask, read_mask

LENS = Camera(640, 320, 430.0, 430.0, 319.5, 159.5, (-0.3, 0.1, 0.0, 0.0, 0.0))


def left_half(camera: Camera) -> np.ndarray:
    mask = np.zeros((camera.height_px, camera.width_px), np.uint8)
    mask[:, : camera.width_px // 2] = 255
    return mask


def test_only_features_on_white_are_kept_and_white_is_where_the_sensor_has_it():
    """The lens moves corners by up to forty pixels, and the mask is a picture of the recorded image."""
    rng = np.random.default_rng(0)
    image = np.kron(rng.integers(0, 255, (40, 80)), np.ones((8, 8))).astype(np.uint8)
    found = FeatureExtractor(LENS, FeatureSettings(count=1500)).extract(image)
    mask = left_half(LENS)
    mask[:, :100] = 0
    kept = ImageMask(mask >= 128).kept(found, LENS)
    rays = (found.pixels - [LENS.cx_px, LENS.cy_px]) / [LENS.fx_px, LENS.fy_px]
    recorded_x = LENS.project(np.column_stack([rays, np.ones(len(rays))]))[:, 0]
    expected = (recorded_x > 99.5) & (recorded_x < 319.5)
    assert 100 < len(kept) < 0.5 * len(found)
    np.testing.assert_array_equal(kept.pixels, found.pixels[expected])
    np.testing.assert_array_equal(kept.descriptors, found.descriptors[expected])
    np.testing.assert_array_equal(kept.octaves, found.octaves[expected])
    assert np.abs(found.pixels[expected][:, 0] - recorded_x[expected]).max() > 5.0


def test_an_image_without_features_stays_so():
    nothing = FeatureExtractor(LENS, FeatureSettings(count=500)).extract(np.zeros((320, 640), np.uint8))
    assert len(ImageMask(left_half(LENS) > 0).kept(nothing, LENS)) == 0


def test_a_mask_is_read_as_it_was_painted(tmp_path):
    path = tmp_path / "mask.png"
    path.write_bytes(encode_image(left_half(LENS), png=True))
    np.testing.assert_array_equal(read_mask(path, LENS).usable, left_half(LENS) > 0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read: No such file"),
        (b"not a picture", "is no image: it is neither JPEG nor PNG"),
        (encode_image(np.full((100, 200), 255, np.uint8), png=True), "is 200x100, but the images are 640x320"),
        (encode_image(np.zeros((320, 640), np.uint8), png=True), "is black all over"),
    ],
    ids=["missing", "no image", "wrong size", "black"],
)
def test_a_mask_that_cannot_be_used_is_refused_in_one_line(tmp_path, content, message):
    path = tmp_path / "mask.png"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError) as refused:
        read_mask(path, LENS)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)
