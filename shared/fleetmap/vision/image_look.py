"""How sharp and how well exposed one image is, in numbers that do not need another image to compare with."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

_SATURATED_GREY, _BLACK_GREY = 250, 8
_REBLUR_PX = 9
_FAINT_GREY, _FAINT_SIGMAS = 4.0, 4.0  # differences below are the sensor's and the codec's, not the scene's
_NOISE_MASK = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]], dtype=np.float32)


@dataclass(frozen=True)
class ImageLook:
    """One image."""

    blur: float  # 0 sharp .. 1 nothing left to lose by blurring it again
    mean_grey: float
    saturated_share: float  # of all pixels
    black_share: float


def look_at(image: Image) -> ImageLook:
    """Judge a grey image (H, W) uint8."""
    return ImageLook(
        blur=_blur(image),
        mean_grey=float(image.mean()),
        saturated_share=float(np.count_nonzero(image >= _SATURATED_GREY)) / image.size,
        black_share=float(np.count_nonzero(image <= _BLACK_GREY)) / image.size,
    )


def _blur(image: Image) -> float:
    """The worse of both axes: motion blurs one of them only.

    Source: Crete, Dolmiere, Ladret, Nicolas, "The blur effect: perception and estimation with a new no-reference
    perceptual quality metric", SPIE 2007. The share of the differences between neighbours that survives when a
    box filter blurs the image (again); differences as small as noise are left out.
    """
    grey = image.astype(np.float32)
    faint = max(_FAINT_GREY, _FAINT_SIGMAS * _noise_grey(grey))
    survive = []
    for axis, size in ((0, (1, _REBLUR_PX)), (1, (_REBLUR_PX, 1))):
        blurred = cv2.blur(grey, size)
        before, after = np.abs(np.diff(grey, axis=axis)), np.abs(np.diff(blurred, axis=axis))
        edges = before > faint
        total = float(before[edges].sum())
        lost = float(np.maximum(before[edges] - after[edges], 0.0).sum())
        survive.append(1.0 - lost / total if total > 0.0 else 1.0)
    return max(survive)


def _noise_grey(grey: NDArray[np.float32]) -> float:
    """Sigma of the noise from the part of the image that neither planes nor edges explain.

    Source: Immerkaer, "Fast noise variance estimation", CVIU 1996, with a median for his mean.
    """
    rest = np.abs(cv2.filter2D(grey[::2], -1, _NOISE_MASK))
    return 1.4826 * float(np.median(rest)) / 6.0
