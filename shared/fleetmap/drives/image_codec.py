"""The door for compressed images: JPEG, PNG and WebP as grey arrays, and back."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_JPEG_QUALITY = 95
_JPEG_START, _JPEG_SCAN, _JPEG_END = b"\xff\xd8", b"\xff\xda", b"\xff\xd9"
_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_RIFF_START, _WEBP_MARK = b"RIFF", b"WEBP"
_JPEG_WITHOUT_LENGTH = frozenset({0x01, *range(0xD0, 0xD9)})
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # ITU-T T.81, table B.1: they tell the size
_PIXEL_LIMIT = 100_000_000  # a damaged header can claim 4 gigapixels, and the decoder would make room for them

Image = NDArray[np.uint8]


def decode_compressed(data: bytes, image_format: str, max_pixels: int = _PIXEL_LIMIT) -> Image:
    """A JPEG, PNG or WebP as grey (height, width), whole and as the sensor saw it (EXIF orientation ignored).

    Args:
        data: all of it.
        image_format: what it was said to be, for errors.
        max_pixels: a JPEG or PNG that claims more is not decoded.

    Raises:
        ValueError: none of these, truncated, or damaged.
    """
    if data.startswith(_JPEG_START):
        # Decoders fill the missing part of a truncated JPEG with grey; a scan must be followed by the end marker.
        is_whole = data.rfind(_JPEG_END) > data.rfind(_JPEG_SCAN) > 0
    elif data.startswith(_PNG_START):
        is_whole = data.rfind(_PNG_END) > 0
    elif data.startswith(_RIFF_START) and data[8:12] == _WEBP_MARK:
        is_whole = len(data) >= 8 + int.from_bytes(data[4:8], "little")
    else:
        raise ValueError(f"it is neither JPEG nor PNG nor WebP (format '{image_format}')")
    if not is_whole:
        raise ValueError(f"its {len(data)} bytes end in the middle of the image")
    width, height = _claimed_size(data)
    if width * height > max_pixels:
        raise ValueError(f"it claims {width}x{height} pixels; {max_pixels:,} are read at most")
    try:
        image = cv2.imdecode(
            np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        )
    except cv2.error as error:
        raise ValueError(f"the decoder refuses it: {error.err}") from error
    if image is None:
        raise ValueError(f"the decoder refuses its {len(data)} bytes")
    return np.asarray(image, dtype=np.uint8)


def _claimed_size(data: bytes) -> tuple[int, int]:
    """Width and height by the header of a JPEG or PNG; zeros where it does not say (a WebP cannot claim much)."""
    if data.startswith(_PNG_START):
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    at = 2 if data.startswith(_JPEG_START) else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker in _JPEG_FRAMES:
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        is_short = marker == 0xFF or marker in _JPEG_WITHOUT_LENGTH
        at += (1 if marker == 0xFF else 2) if is_short else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return 0, 0


def encode_image(image: Image, *, png: bool = False) -> bytes:
    """A grey image (height, width) as JPEG of quality 95, or as PNG."""
    if png:
        done, data = cv2.imencode(".png", image)
    else:
        done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not done:
        raise ValueError(f"an image of shape {image.shape} cannot be encoded")
    return bytes(data.tobytes())
