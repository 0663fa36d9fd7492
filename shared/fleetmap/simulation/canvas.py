"""A sheet to paint a texture on, in metres from its top-left corner."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

FloatImage = NDArray[np.float32]
GreyImage = NDArray[np.uint8]

_LETTERS = list("ABCDEFGHKLMNOPRSTUVWXYZ0123456789&.-")


def fractal_noise(
    rng: np.random.Generator, shape: tuple[int, int], coarsest_px: float = 128.0, persistence: float = 0.75
) -> FloatImage:
    """Noise (H, W) with detail at every scale from ``coarsest_px`` down to one pixel; mean 0, deviation 1."""
    total = np.zeros(shape, dtype=np.float32)
    cell, amplitude = coarsest_px, 1.0
    while cell >= 1.0:
        knots = (int(np.ceil(shape[0] / cell)) + 2, int(np.ceil(shape[1] / cell)) + 2)
        coarse = rng.standard_normal(knots, dtype=np.float32) * np.float32(amplitude)
        grown = (
            cv2.resize(coarse, None, fx=cell, fy=cell, interpolation=cv2.INTER_LINEAR) if cell > 1.0 else coarse
        )
        total += grown[: shape[0], : shape[1]]
        cell, amplitude = cell / 2.0, amplitude * persistence
    return np.asarray((total - total.mean()) / (total.std() + 1e-6), dtype=np.float32)


class Canvas:
    """A grey sheet of a size in metres; sides are rounded up to multiples of 64 texels."""

    def __init__(
        self, rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float, grey: float
    ) -> None:
        self.rng = rng
        self.width_m, self.height_m = width_m, height_m
        columns, rows = (int(np.ceil(side * px_per_m / 64.0)) * 64 for side in (width_m, height_m))
        self.scale = (columns / width_m, rows / height_m)  # px per m across and down
        self.grey: FloatImage = np.full((rows, columns), grey, dtype=np.float32)

    def grain(self, amplitude: float, coarsest_m: float = 2.0, persistence: float = 0.75) -> None:
        """Add fractal noise."""
        shape = (self.grey.shape[0], self.grey.shape[1])
        noise = fractal_noise(self.rng, shape, max(coarsest_m * self.scale[1], 2.0), persistence)
        self.grey += np.float32(amplitude) * noise

    def patch(self, left_m: float, top_m: float, right_m: float, bottom_m: float) -> FloatImage:
        """The sheet's own texels (h, w) of a rectangle; empty outside the sheet."""
        x0, x1 = round(left_m * self.scale[0]), round(right_m * self.scale[0])
        y0, y1 = round(top_m * self.scale[1]), round(bottom_m * self.scale[1])
        return self.grey[max(y0, 0) : max(y1, y0 + 1, 0), max(x0, 0) : max(x1, x0 + 1, 0)]

    def rectangle(
        self, left_m: float, top_m: float, right_m: float, bottom_m: float, grey: float, grain: float = 2.0
    ) -> None:
        """Fill a rectangle, with a little noise."""
        patch = self.patch(left_m, top_m, right_m, bottom_m)
        patch[...] = grey + np.float32(grain) * self.rng.standard_normal(patch.shape, dtype=np.float32)

    def darken(self, left_m: float, top_m: float, right_m: float, bottom_m: float, factor: float) -> None:
        """Multiply a rectangle."""
        self.patch(left_m, top_m, right_m, bottom_m)[...] *= np.float32(factor)

    def polygon(self, points_m: NDArray[np.float64], factor: float) -> None:
        """Multiply a polygon (N, 2)."""
        mask = np.zeros(self.grey.shape, dtype=np.uint8)
        cv2.fillPoly(mask, [np.rint(points_m * self.scale).astype(np.int32)], 1)
        self.grey[mask > 0] *= np.float32(factor)

    def line(self, points_m: NDArray[np.float64], width_m: float, grey: float) -> None:
        """Draw an open polyline (N, 2)."""
        thickness = max(round(width_m * self.scale[0]), 1)
        cv2.polylines(
            self.grey, [np.rint(points_m * self.scale).astype(np.int32)], False, grey, thickness, cv2.LINE_AA
        )

    def ellipse(self, x_m: float, y_m: float, radius_x_m: float, radius_y_m: float, grey: float) -> None:
        """Fill an ellipse."""
        centre = (round(x_m * self.scale[0]), round(y_m * self.scale[1]))
        axes = (max(round(radius_x_m * self.scale[0]), 1), max(round(radius_y_m * self.scale[1]), 1))
        cv2.ellipse(self.grey, centre, axes, 0.0, 0.0, 360.0, grey, -1, cv2.LINE_AA)

    def text(self, left_m: float, bottom_m: float, height_m: float, grey: float, letters: int) -> None:
        """Write random letters."""
        word = "".join(self.rng.choice(_LETTERS, size=letters).tolist())
        font_scale = height_m * self.scale[1] / 22.0
        origin = (round(left_m * self.scale[0]), round(bottom_m * self.scale[1]))
        thickness = max(round(2.5 * font_scale), 1)
        ink = np.zeros(self.grey.shape, dtype=np.uint8)
        cv2.putText(ink, word, origin, cv2.FONT_HERSHEY_SIMPLEX, font_scale, 255, thickness, cv2.LINE_AA)
        self.grey += (np.float32(grey) - self.grey) * (ink.astype(np.float32) / np.float32(255.0))

    def finish(self) -> GreyImage:
        """The picture, (H, W) uint8."""
        return np.asarray(np.clip(np.rint(self.grey), 1, 255), dtype=np.uint8)
