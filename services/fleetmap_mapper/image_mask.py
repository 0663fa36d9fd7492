"""Which pixels of every image may be used: a picture of the images' size, white = use, black = ignore."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.drives.image_codec import decode_compressed
from fleetmap.errors import InputError
from fleetmap.vision.features import Features

_WHITE = 128  # from here on


@dataclass(frozen=True)
class ImageMask:
    """Recorded pixels whose features may enter the map."""

    usable: NDArray[np.bool_]  # (H, W)

    def kept(self, features: Features, camera: Camera) -> Features:
        """The features whose corner lies on a usable pixel."""
        if len(features) == 0:
            return features
        focal, centre = np.array([camera.fx_px, camera.fy_px]), np.array([camera.cx_px, camera.cy_px])
        rays = np.column_stack([(features.pixels - centre) / focal, np.ones(len(features))])
        recorded = camera.project(rays)
        column, row = np.rint(recorded).astype(np.int64).T
        height, width = self.usable.shape
        kept = self.usable[row.clip(0, height - 1), column.clip(0, width - 1)]
        return replace(
            features,
            pixels=features.pixels[kept],
            octaves=features.octaves[kept],
            descriptors=np.ascontiguousarray(features.descriptors[kept]),
            angles_deg=features.angles_deg[kept],
        )


def read_mask(path: Path, camera: Camera) -> ImageMask:
    """The mask in a PNG, JPEG or WebP file, for images of a camera.

    Raises:
        InputError: no such file, no image, another size than the camera's, or a mask that leaves nothing.
    """
    try:
        image = decode_compressed(path.read_bytes(), path.suffix)
    except OSError as error:
        raise InputError(f"the mask {path} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise InputError(
            f"the mask {path} is no image: {error}; give a PNG, white = use, black = ignore"
        ) from None
    if image.shape != (camera.height_px, camera.width_px):
        raise InputError(
            f"the mask {path} is {image.shape[1]}x{image.shape[0]}, but the images are "
            f"{camera.width_px}x{camera.height_px}; give a mask of their size"
        )
    if not np.any(image >= _WHITE):
        raise InputError(
            f"the mask {path} is black all over and leaves nothing to see; paint white what may be used"
        )
    return ImageMask(image >= _WHITE)
