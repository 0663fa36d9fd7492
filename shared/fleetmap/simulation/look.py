"""What light, lens and sensor make of a scene: weather, blur, vignetting, exposure, gamma, noise."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import InputError
from fleetmap.geometry import Pose

Array = NDArray[np.float64]
FloatImage = NDArray[np.float32]

_METER_EVERY_PX = 6
_METER_STEPS = 14
_DAY_GREY = 100.0
_EXPOSURE_RANGE = (0.25, 16.0)  # what an automatic exposure reaches
_MEAN_BRIGHTNESS = 0.8  # of a surface: where a change of the sun's contrast turns about


@dataclass(frozen=True)
class Look:
    """How one vehicle's camera renders a scene. Equal looks, poses and seeds give equal bytes."""

    exposure: float = 1.0  # factor on the light
    gamma: float = 1.0  # grey = 255 * (light / 255) ** gamma; above 1 darkens the shadows
    noise_sigma: float = 1.5  # grey levels, at mid-grey (grows with the light, as shot noise does)
    blur_sigma_px: float = 0.45  # the lens' point spread
    vignetting: float = 0.15  # share of the light that the corners lose
    seed: int = 0
    auto_exposure_grey: float | None = None  # mean grey level that the exposure aims at; None: it stays as set
    daylight: float = 1.0  # factor on the light that falls on everything, and on the sky's own
    sky: float = 1.0  # factor on the sky's own light, on top of daylight
    sun_contrast: float = 1.0  # 1: sunlit and shaded sides as built; 0: light from everywhere, no shaded side
    lamps: float = 0.0  # how bright lamps burn: the light of a white lamp, as a share of a white wall's in the sun
    wetness: float = 0.0  # of the ground, 0..1: darker, and it mirrors what stands above it

    def apply(self, light: FloatImage, map_from_cam: Pose) -> NDArray[np.uint8]:
        """Turn light (H, W) into a grey image (H, W); the pose only seeds the noise, so that frames differ."""
        image = light
        if self.blur_sigma_px > 0.0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), self.blur_sigma_px), dtype=np.float32)
        image = image * self._falloff(image.shape)
        gain = self._exposure_of(image)
        image = self._tone(image, gain)
        if self.noise_sigma > 0.0:
            salt = zlib.crc32(map_from_cam.translation_m.tobytes() + map_from_cam.rotation.tobytes())
            noise = np.random.default_rng([self.seed, salt]).standard_normal(image.shape, dtype=np.float32)
            amplified = max(gain / self.exposure, 1.0) ** 0.5  # the sensor counts fewer photons in the dark
            noise *= np.sqrt(image + np.float32(0.1))
            noise *= np.float32(self.noise_sigma * amplified / 255.0 / 0.775)
            image += noise
        image *= np.float32(255.0)
        return np.asarray(cv2.convertScaleAbs(np.maximum(image, np.float32(0.0))), dtype=np.uint8)

    def surface_light(self, brightness: Array, is_lamp: NDArray[np.bool_]) -> Array:
        """Brightness (Q,) of surfaces under the sun they were built in, as it is in this look's light."""
        if self.sun_contrast != 1.0:
            relative = np.maximum(brightness, 0.0) / _MEAN_BRIGHTNESS
            brightness = _MEAN_BRIGHTNESS * relative**self.sun_contrast
        return np.maximum(brightness * self.daylight, np.where(is_lamp, self.lamps, 0.0))

    def _tone(self, light: FloatImage, exposure: float) -> FloatImage:
        """Share of full white (...), before noise."""
        image = np.clip(light * np.float32(exposure / 255.0), np.float32(0.0), np.float32(1.0))
        return image if self.gamma == 1.0 else np.asarray(cv2.pow(image, self.gamma), dtype=np.float32)

    def _exposure_of(self, light: FloatImage) -> float:
        """The exposure of one image: as set, or the one that brings its mean grey to ``auto_exposure_grey``.

        It depends on that image alone, not on those before it, so frames can be rendered in any order. The grey
        rises with the exposure, saturated pixels included, so halving the interval of its logarithm finds it.
        """
        if self.auto_exposure_grey is None:
            return self.exposure
        metered = np.ascontiguousarray(light[_METER_EVERY_PX // 2 :: _METER_EVERY_PX, ::_METER_EVERY_PX])
        low, high = (np.log(self.exposure * limit) for limit in _EXPOSURE_RANGE)
        for _ in range(_METER_STEPS):
            middle = 0.5 * (low + high)
            if 255.0 * float(self._tone(metered, float(np.exp(middle))).mean()) < self.auto_exposure_grey:
                low = middle
            else:
                high = middle
        return float(np.exp(0.5 * (low + high)))

    def _falloff(self, shape: tuple[int, ...]) -> FloatImage:
        y = np.linspace(-1.0, 1.0, shape[0], dtype=np.float32)[:, None]
        x = np.linspace(-1.0, 1.0, shape[1], dtype=np.float32)
        return np.asarray(1.0 - np.float32(self.vignetting) * (x * x + y * y) / 2.0, dtype=np.float32)


LOOKS = {
    "day": Look(),
    "overcast": Look(daylight=0.75, sky=1.25, sun_contrast=0.35, auto_exposure_grey=115.0),
    "dusk": Look(
        daylight=0.1, sky=0.9, sun_contrast=0.25, lamps=1.0, noise_sigma=2.2, auto_exposure_grey=72.0, gamma=1.1
    ),
    "wet": Look(daylight=0.7, sky=1.1, sun_contrast=0.4, wetness=1.0, auto_exposure_grey=105.0),
}


def look_of_drive(name: str, seed: int) -> Look:
    """The named look as one drive's camera has it: gamma, noise, blur, vignetting and exposure drawn by a seed.

    Raises:
        InputError: no look has that name.
    """
    if name not in LOOKS:
        raise InputError(f"there is no look '{name}'; choose from {', '.join(LOOKS)}")
    look, rng = LOOKS[name], np.random.default_rng([seed, zlib.crc32(name.encode())])
    grey = look.auto_exposure_grey
    if grey is None and rng.random() < 0.5:  # by day the one camera adapts, the other is set once
        grey = _DAY_GREY
    return replace(
        look,
        exposure=look.exposure * rng.uniform(0.8, 1.1) if grey is None else look.exposure,
        auto_exposure_grey=None if grey is None else grey * rng.uniform(0.9, 1.15),
        gamma=look.gamma * rng.uniform(0.85, 1.25),
        noise_sigma=look.noise_sigma * rng.uniform(0.7, 1.6),
        blur_sigma_px=rng.uniform(0.35, 0.7),
        vignetting=rng.uniform(0.05, 0.3),
        seed=seed,
    )
