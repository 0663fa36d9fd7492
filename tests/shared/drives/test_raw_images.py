"""Every raw encoding against a picture whose grey is known."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.drives.messages import RawPicture
from fleetmap.drives.raw_images import decode_raw

WIDTH, HEIGHT = 64, 48
X, Y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
RGB = np.stack([200 - X, 40 + Y, 30 + X + Y], axis=2).astype(np.uint8)  # red, green and blue change apart
GREY = RGB @ np.array([0.299, 0.587, 0.114])  # Rec. 601
BAYER = {"rggb": "rg gb", "bggr": "bg gr", "gbrg": "gb rg", "grbg": "gr bg"}


def picture(encoding, rows, *, padding=0, height=HEIGHT, **options):
    """A picture of rows (height, bytes), with some bytes after each."""
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
    return RawPicture(encoding, WIDTH, height, padded.shape[1], padded.reshape(-1), **options)


def mosaic(pattern):
    """What a sensor with a Bayer filter sees of RGB: the first four pixels as ROS names them."""
    seen = np.zeros((HEIGHT, WIDTH), np.uint8)
    for row, letters in enumerate(BAYER[pattern].split()):
        for column, letter in enumerate(letters):
            seen[row::2, column::2] = RGB[row::2, column::2, "rgb".index(letter)]
    return seen


def assert_is(image, expected, tolerance):
    assert image.shape == (HEIGHT, WIDTH)
    assert image.dtype == np.uint8
    assert image.flags.c_contiguous
    assert np.abs(image.astype(float) - expected).max() <= tolerance


@pytest.mark.parametrize("padding", [0, 12])
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8", "8UC3", "8UC4"])
def test_colours_become_the_grey_of_rec_601(encoding, padding):
    order = {"8UC3": "bgr", "8UC4": "bgra"}.get(encoding, encoding.removesuffix("8"))
    opaque = np.dstack([RGB, np.full((HEIGHT, WIDTH), 255, np.uint8)])
    rows = opaque[:, :, ["rgba".index(letter) for letter in order]].reshape(HEIGHT, -1)
    assert_is(decode_raw(picture(encoding, rows, padding=padding)), GREY, 1.0)


@pytest.mark.parametrize("is_bigendian", [False, True])
@pytest.mark.parametrize("encoding", ["rgb16", "bgr16", "rgba16", "bgra16"])
def test_sixteen_bits_a_channel_are_scaled(encoding, is_bigendian):
    opaque = np.dstack([RGB, np.full((HEIGHT, WIDTH), 255, np.uint8)]).astype(np.uint16) * 257
    samples = opaque[:, :, ["rgba".index(letter) for letter in encoding.removesuffix("16")]]
    rows = np.ascontiguousarray(samples.astype(">u2" if is_bigendian else "<u2")).view(np.uint8)
    found = decode_raw(picture(encoding, rows.reshape(HEIGHT, -1), is_bigendian=is_bigendian))
    assert_is(found, GREY, 1.0)


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_grey_stays_as_it_is(encoding):
    grey = GREY.astype(np.uint8)
    assert np.array_equal(decode_raw(picture(encoding, grey, padding=5)), grey)


@pytest.mark.parametrize("is_bigendian", [False, True])
def test_mono16_goes_from_black_to_white(is_bigendian):
    ramp = np.linspace(0, 65535, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
    rows = ramp.astype(">u2" if is_bigendian else "<u2").view(np.uint8)
    found = decode_raw(picture("mono16", rows, padding=7, is_bigendian=is_bigendian))
    assert (found[0, 0], found[-1, -1]) == (0, 255)
    assert_is(found, ramp / 257.0, 0.51)


@pytest.mark.parametrize("padding", [0, 8])
@pytest.mark.parametrize("pattern", BAYER)
def test_each_bayer_pattern_is_the_one_that_ros_means(pattern, padding):
    found = decode_raw(picture(f"bayer_{pattern}8", mosaic(pattern), padding=padding))
    assert np.abs(found[2:-2, 2:-2] - GREY[2:-2, 2:-2]).max() < 3.0
    wrong = {"rggb": "bggr", "bggr": "rggb", "gbrg": "grbg", "grbg": "gbrg"}[pattern]
    confused = decode_raw(picture(f"bayer_{wrong}8", mosaic(pattern)))
    assert np.abs(confused[2:-2, 2:-2] - GREY[2:-2, 2:-2]).max() > 10.0  # red taken for blue


@pytest.mark.parametrize("pattern", BAYER)
def test_bayer_patterns_of_sixteen_bits(pattern):
    rows = (mosaic(pattern).astype("<u2") * 257).view(np.uint8)
    found = decode_raw(picture(f"bayer_{pattern}16", rows))
    assert np.abs(found[2:-2, 2:-2] - GREY[2:-2, 2:-2]).max() < 3.0


@pytest.mark.parametrize(
    ("encoding", "luma_first"), [("yuv422", False), ("uyvy", False), ("yuv422_yuy2", True), ("yuyv", True)]
)
def test_of_yuv422_the_luma_is_taken(encoding, luma_first):
    luma = GREY.astype(np.uint8)
    chroma = np.full_like(luma, 128) + (X % 7).astype(np.uint8)
    pair = (luma, chroma) if luma_first else (chroma, luma)
    rows = np.stack(pair, axis=2).reshape(HEIGHT, -1)
    assert np.array_equal(decode_raw(picture(encoding, rows, padding=4)), luma)


@pytest.mark.parametrize("encoding", ["nv12", "nv21"])
def test_of_two_planes_the_first_is_taken(encoding):
    luma = GREY.astype(np.uint8)
    rows = np.vstack([luma, np.full((HEIGHT // 2, WIDTH), 77, np.uint8)])
    assert np.array_equal(decode_raw(picture(encoding, rows, padding=6)), luma)
    with pytest.raises(ValueError, match="do not make 64x48"):
        decode_raw(picture(encoding, luma))


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "64FC1", "jpeg", ""])
def test_what_is_no_picture_is_refused_with_what_is(encoding):
    with pytest.raises(ValueError, match=f"'{encoding}' is not one of mono8, .*bayer_rggb8.*yuv422"):
        decode_raw(picture(encoding, np.zeros((HEIGHT, WIDTH * 8), np.uint8)))


@pytest.mark.parametrize(
    ("encoding", "row_bytes", "rows"),
    [
        ("mono8", 63, 48),
        ("mono8", 64, 47),
        ("mono16", 127, 48),
        ("rgb8", 191, 48),
        ("rgba16", 511, 48),
        ("yuv422", 64, 48),
        ("bayer_rggb16", 64, 48),
        ("mono8", 0, 48),
    ],
)
def test_too_few_bytes_are_refused_with_the_numbers(encoding, row_bytes, rows):
    few = RawPicture(encoding, WIDTH, HEIGHT, row_bytes, np.zeros(row_bytes * rows, np.uint8))
    with pytest.raises(ValueError, match=f"^{row_bytes * rows} bytes do not make 64x48 pixels of {encoding}"):
        decode_raw(few)


@pytest.mark.parametrize(("width", "height"), [(0, 48), (64, 0), (0, 0)])
def test_an_image_without_pixels_is_refused(width, height):
    with pytest.raises(ValueError, match=f"do not make {width}x{height}"):
        decode_raw(RawPicture("mono8", width, height, 64, np.zeros(64 * 48, np.uint8)))


def test_a_huge_size_is_refused_without_reserving_memory():
    with pytest.raises(ValueError, match="do not make"):
        decode_raw(RawPicture("rgb8", 2**31, 2**31, 2**32 - 1, np.zeros(10, np.uint8)))


@pytest.mark.parametrize("pattern", BAYER)
@pytest.mark.parametrize(("width", "height"), [(1, 1), (2, 1), (3, 3)])
def test_tiny_bayer_images_are_decoded(pattern, width, height):
    tiny = RawPicture(f"bayer_{pattern}8", width, height, width, np.full(width * height, 50, np.uint8))
    assert decode_raw(tiny).shape == (height, width)
