"""Raw images as grey: every encoding of a camera that sensor_msgs and Foxglove name.

Encodings: sensor_msgs/image_encodings.hpp; https://docs.foxglove.dev/docs/sdk/schemas/raw-image.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.drives.messages import RawPicture

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class _Layout:
    channels: int
    bytes_per_channel: int = 1
    to_grey: int | None = None  # OpenCV's conversion; None where the channel ``luma`` is the grey image
    luma: int = 0
    planes: float = 1.0  # rows of the message per row of the image


# OpenCV names a Bayer pattern after the second row's second and third pixel, ROS after the first four.
_BAYER = {
    "rggb": cv2.COLOR_BayerBG2GRAY,
    "bggr": cv2.COLOR_BayerRG2GRAY,
    "gbrg": cv2.COLOR_BayerGR2GRAY,
    "grbg": cv2.COLOR_BayerGB2GRAY,
}
_COLOURS = {
    "rgb": (3, cv2.COLOR_RGB2GRAY),
    "bgr": (3, cv2.COLOR_BGR2GRAY),
    "rgba": (4, cv2.COLOR_RGBA2GRAY),
    "bgra": (4, cv2.COLOR_BGRA2GRAY),
}
_UYVY, _YUYV, _NV12 = _Layout(2, luma=1), _Layout(2, luma=0), _Layout(1, planes=1.5)
_LAYOUTS: dict[str, _Layout] = {
    "mono8": _Layout(1),
    "8UC1": _Layout(1),
    "mono16": _Layout(1, 2),
    "8UC3": _Layout(3, to_grey=cv2.COLOR_BGR2GRAY),
    "8UC4": _Layout(4, to_grey=cv2.COLOR_BGRA2GRAY),
    **{f"{name}8": _Layout(channels, to_grey=code) for name, (channels, code) in _COLOURS.items()},
    **{f"{name}16": _Layout(channels, 2, code) for name, (channels, code) in _COLOURS.items()},
    **{f"bayer_{name}8": _Layout(1, to_grey=code) for name, code in _BAYER.items()},
    **{f"bayer_{name}16": _Layout(1, 2, code) for name, code in _BAYER.items()},
    "yuv422": _UYVY,
    "uyvy": _UYVY,
    "yuv422_yuy2": _YUYV,
    "yuyv": _YUYV,
    "nv12": _NV12,
    "nv21": _NV12,
}


def decode_raw(picture: RawPicture) -> Image:
    """A raw image as grey (height, width); 16 bits a channel are scaled so that 65535 becomes 255.

    Raises:
        ValueError: an encoding that is no camera's, or a size that does not fit the data.
    """
    layout = _LAYOUTS.get(picture.encoding)
    if layout is None:
        raise ValueError(f"its encoding '{picture.encoding}' is not one of {', '.join(_LAYOUTS)}")
    pixels = _pixels(picture, layout)
    if layout.to_grey is None:
        grey = np.ascontiguousarray(pixels[:, :, layout.luma])
    else:
        grey = np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), layout.to_grey))
    if layout.bytes_per_channel == 2:
        return np.asarray(np.rint(np.asarray(grey, dtype=np.float32) / 257.0), dtype=np.uint8)
    return np.asarray(grey, dtype=np.uint8)


def _pixels(picture: RawPicture, layout: _Layout) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Pixels (height, width, channels) in this machine's byte order."""
    width, height, step = picture.width_px, picture.height_px, picture.row_bytes
    row_bytes = width * layout.channels * layout.bytes_per_channel
    if height <= 0 or width <= 0 or step < row_bytes or picture.data.size < int(height * layout.planes) * step:
        raise ValueError(
            f"{picture.data.size} bytes do not make {width}x{height} pixels of {picture.encoding}"
            f" in rows of {step}"
        )
    rows = picture.data[: height * step].reshape(height, step)[:, :row_bytes]
    if layout.bytes_per_channel == 1:
        return rows.reshape(height, width, layout.channels)
    byte_order = ">u2" if picture.is_bigendian else "<u2"
    samples = np.ascontiguousarray(rows).view(byte_order).astype(np.uint16)
    return samples.reshape(height, width, layout.channels)
