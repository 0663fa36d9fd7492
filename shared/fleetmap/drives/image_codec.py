"""The door for image decoding: JPEG, PNG and raw ROS images as grey arrays, and back."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_JPEG_QUALITY = 95
_JPEG_START, _JPEG_SCAN, _JPEG_END = b"\xff\xd8", b"\xff\xda", b"\xff\xd9"
_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_CHANNELS = {"mono8": 1, "8UC1": 1, "bgr8": 3, "8UC3": 3, "rgb8": 3, "bgra8": 4, "8UC4": 4, "rgba8": 4}
_GREY_FROM = {
    "bgr8": cv2.COLOR_BGR2GRAY,
    "8UC3": cv2.COLOR_BGR2GRAY,
    "rgb8": cv2.COLOR_RGB2GRAY,
    "bgra8": cv2.COLOR_BGRA2GRAY,
    "8UC4": cv2.COLOR_BGRA2GRAY,
    "rgba8": cv2.COLOR_RGBA2GRAY,
}

Image = NDArray[np.uint8]


def decode_compressed(data: bytes, image_format: str) -> Image:
    """A JPEG or PNG as grey (height, width), whole and as the sensor saw it (EXIF orientation ignored).

    Raises:
        ValueError: neither JPEG nor PNG, truncated, or damaged.
    """
    if data.startswith(_JPEG_START):
        # Decoders fill the missing part of a truncated JPEG with grey; a scan must be followed by the end marker.
        is_whole = data.rfind(_JPEG_END) > data.rfind(_JPEG_SCAN) > 0
    elif data.startswith(_PNG_START):
        is_whole = data.rfind(_PNG_END) > 0
    else:
        raise ValueError(f"it is neither JPEG nor PNG (format '{image_format}')")
    if not is_whole:
        raise ValueError(f"its {len(data)} bytes end in the middle of the image")
    try:
        image = cv2.imdecode(
            np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        )
    except cv2.error as error:
        raise ValueError(f"the decoder refuses it: {error.err}") from error
    if image is None:
        raise ValueError(f"the decoder refuses its {len(data)} bytes")
    return np.asarray(image, dtype=np.uint8)


def decode_raw(message: Any) -> Image:
    """A sensor_msgs/Image as grey (height, width).

    Raises:
        ValueError: an encoding that is not 8-bit grey or colour, or a size that does not fit the data.
    """
    encoding, height, width, step = (
        str(message.encoding),
        int(message.height),
        int(message.width),
        int(message.step),
    )
    channels = _CHANNELS.get(encoding)
    if channels is None:
        raise ValueError(f"its encoding '{encoding}' is not one of {', '.join(_CHANNELS)}")
    data = np.asarray(message.data, dtype=np.uint8)
    if height <= 0 or width <= 0 or step < width * channels or data.size < height * step:
        raise ValueError(f"{data.size} bytes do not make {width}x{height} pixels of {encoding} in rows of {step}")
    rows = data[: height * step].reshape(height, step)[:, : width * channels]
    if channels == 1:
        return np.ascontiguousarray(rows)
    pixels = np.ascontiguousarray(rows).reshape(height, width, channels)
    return np.asarray(cv2.cvtColor(pixels, _GREY_FROM[encoding]), dtype=np.uint8)


def encode_image(image: Image, *, png: bool = False) -> bytes:
    """A grey image (height, width) as JPEG of quality 95, or as PNG."""
    if png:
        done, data = cv2.imencode(".png", image)
    else:
        done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not done:
        raise ValueError(f"an image of shape {image.shape} cannot be encoded")
    return bytes(data.tobytes())
