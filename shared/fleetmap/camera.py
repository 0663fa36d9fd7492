"""A pinhole camera with plumb-bob distortion, in plain numpy.

Pixels: (0, 0) is the centre of the top-left pixel. Camera frame: x right, y down, z forward.
Distortion: Brown-Conrady (k1, k2, p1, p2, k3), as in ROS ``plumb_bob`` and OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import CalibrationError

Array = NDArray[np.float64]
_UNDISTORT_ITERATIONS = 20


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)  # k1, k2, p1, p2, k3

    def __post_init__(self) -> None:
        numbers = (self.fx_px, self.fy_px, self.cx_px, self.cy_px, *self.distortion)
        if not np.all(np.isfinite(numbers)) or self.fx_px <= 0.0 or self.fy_px <= 0.0:
            raise CalibrationError(f"camera calibration is not usable: fx={self.fx_px}, fy={self.fy_px}")
        if self.width_px <= 0 or self.height_px <= 0:
            raise CalibrationError(f"camera size {self.width_px}x{self.height_px} is not usable")

    @property
    def matrix(self) -> Array:
        """K, (3, 3)."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])

    def project(self, points_in_cam: Array) -> Array:
        """Pixels (N, 2) as the sensor sees them, distorted; NaN for points (N, 3) not in front."""
        return self._pixels(self._distort(_normalised(points_in_cam)))

    def project_ideal(self, points_in_cam: Array) -> Array:
        """Pixels (N, 2) of the undistorted camera with the same K; NaN for points not in front."""
        return self._pixels(_normalised(points_in_cam))

    def unproject(self, pixels: Array) -> Array:
        """Viewing rays (N, 3) with z = 1 of distorted pixels (N, 2)."""
        ideal = self.undistort(pixels)
        x = (ideal[:, 0] - self.cx_px) / self.fx_px
        y = (ideal[:, 1] - self.cy_px) / self.fy_px
        return np.stack([x, y, np.ones_like(x)], axis=1)

    def undistort(self, pixels: Array) -> Array:
        """Distorted pixels (N, 2) as pixels (N, 2) of the undistorted camera with the same K.

        Fixed-point iteration, as in Heikkila & Silven (CVPR 1997), section 4.
        """
        if not any(self.distortion):
            return np.asarray(pixels, dtype=np.float64)
        centre, focal = np.array([self.cx_px, self.cy_px]), np.array([self.fx_px, self.fy_px])
        distorted = (pixels - centre) / focal
        ideal = distorted.copy()
        for _ in range(_UNDISTORT_ITERATIONS):
            radial, tangential = self._distortion_terms(ideal)
            ideal = (distorted - tangential) / radial[:, None]
        return np.asarray(ideal * focal + centre)

    def is_inside(self, pixels: Array, border_px: float = 0.0) -> NDArray[np.bool_]:
        """Which pixels (N, 2) lie in the image, at least ``border_px`` from its edge; NaN is outside."""
        x, y = pixels[:, 0], pixels[:, 1]
        inside = (x >= border_px) & (x <= self.width_px - 1 - border_px)
        return np.asarray(inside & (y >= border_px) & (y <= self.height_px - 1 - border_px))

    def _pixels(self, normalised: Array) -> Array:
        focal, centre = np.array([self.fx_px, self.fy_px]), np.array([self.cx_px, self.cy_px])
        return np.asarray(normalised * focal + centre)

    def _distort(self, normalised: Array) -> Array:
        if not any(self.distortion):
            return normalised
        radial, tangential = self._distortion_terms(normalised)
        return np.asarray(normalised * radial[:, None] + tangential)

    def _distortion_terms(self, normalised: Array) -> tuple[Array, Array]:
        k1, k2, p1, p2, k3 = self.distortion
        x, y = normalised[:, 0], normalised[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        tangential = np.stack(
            [2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y], axis=1
        )
        return radial, tangential


def _normalised(points_in_cam: Array) -> Array:
    depth = points_in_cam[:, 2:3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(depth > 1e-6, points_in_cam[:, :2] / depth, np.nan)
