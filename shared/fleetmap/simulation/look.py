"""What lens and sensor make of the light: blur, vignetting, exposure, gamma, noise."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Pose


@dataclass(frozen=True)
class Look:
    """How one vehicle's camera renders a scene. Equal looks, poses and seeds give equal bytes."""

    exposure: float = 1.0  # factor on the light
    gamma: float = 1.0  # grey = 255 * (light / 255) ** gamma; above 1 darkens the shadows
    noise_sigma: float = 1.5  # grey levels, at mid-grey (grows with the light, as shot noise does)
    blur_sigma_px: float = 0.45  # the lens' point spread
    vignetting: float = 0.15  # share of the light that the corners lose
    seed: int = 0

    def apply(self, light: NDArray[np.float32], map_from_cam: Pose) -> NDArray[np.uint8]:
        """Turn light (H, W) into a grey image (H, W); the pose only seeds the noise, so that frames differ."""
        image = light
        if self.blur_sigma_px > 0.0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), self.blur_sigma_px), dtype=np.float32)
        image = np.clip(image * (self.exposure / 255.0) * self._falloff(image.shape), 0.0, 1.0)
        if self.gamma != 1.0:
            image = np.asarray(cv2.pow(image, self.gamma), dtype=np.float32)
        if self.noise_sigma > 0.0:
            salt = zlib.crc32(map_from_cam.translation_m.tobytes() + map_from_cam.rotation.tobytes())
            noise = np.random.default_rng([self.seed, salt]).standard_normal(image.shape, dtype=np.float32)
            image = image + noise * np.sqrt(image + 0.1) * np.float32(self.noise_sigma / 255.0 / 0.775)
        return np.asarray(np.clip(np.rint(image * 255.0), 0, 255), dtype=np.uint8)

    def _falloff(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        y = np.linspace(-1.0, 1.0, shape[0], dtype=np.float32)[:, None]
        x = np.linspace(-1.0, 1.0, shape[1], dtype=np.float32)
        return np.asarray(1.0 - np.float32(self.vignetting) * (x * x + y * y) / 2.0, dtype=np.float32)
