"""A calibrated camera: pinhole with one of ROS' distortion models, in plain numpy.

Pixels: (0, 0) is the centre of the top-left pixel. Camera frame: x right, y down, z forward.
Distortion: see fleetmap.distortion.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fleetmap.distortion import COEFFICIENT_COUNTS, DistortionModel, distort, is_distorting, jacobian, undistort
from fleetmap.errors import CalibrationError

Array = NDArray[np.float64]

WIDEST_ANGLE_DEG = 75.0
"""Off the optical axis; what a fisheye lens sees further out takes no part in mapping.

Landmarks are measured in the undistorted image, where an error of one recorded pixel grows with 1 / cos^2: 15-fold
at this angle, without bounds at 90 degrees.
"""


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera. No coefficients means all zero."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()
    distortion_model: DistortionModel = "plumb_bob"

    def __post_init__(self) -> None:
        count = COEFFICIENT_COUNTS.get(self.distortion_model)
        if count is None:
            raise CalibrationError(
                f"distortion model '{self.distortion_model}' is not one of {', '.join(COEFFICIENT_COUNTS)}"
            )
        coefficients = tuple(float(value) for value in self.distortion) or (0.0,) * count
        object.__setattr__(self, "distortion", coefficients)
        if len(coefficients) != count:
            raise CalibrationError(
                f"{self.distortion_model} has {count} coefficients, the calibration gives {len(coefficients)}"
            )
        numbers = (self.fx_px, self.fy_px, self.cx_px, self.cy_px, *coefficients)
        if not np.all(np.isfinite(numbers)) or self.fx_px <= 0.0 or self.fy_px <= 0.0:
            raise CalibrationError(f"camera calibration is not usable: fx={self.fx_px}, fy={self.fy_px}")
        if self.width_px <= 0 or self.height_px <= 0:
            raise CalibrationError(f"camera size {self.width_px}x{self.height_px} is not usable")

    @property
    def has_distortion(self) -> bool:
        """Whether the lens moves any pixel away from where an ideal camera with the same K sees it."""
        return is_distorting(self.distortion_model, self.distortion)

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

        NaN where the lens images nothing that lies in front of the camera.
        """
        if not self.has_distortion:
            return np.asarray(pixels, dtype=np.float64)
        centre, focal = np.array([self.cx_px, self.cy_px]), np.array([self.fx_px, self.fy_px])
        ideal = undistort(self.distortion_model, self.distortion, (pixels - centre) / focal)
        return np.asarray(ideal * focal + centre)

    def distort(self, ideal_pixels: Array) -> Array:
        """The inverse of :meth:`undistort`: where the sensor sees pixels (N, 2) of the undistorted camera.

        NaN beyond what the lens images.
        """
        if not self.has_distortion:
            return np.asarray(ideal_pixels, dtype=np.float64)
        return self._pixels(self._distort(self.normalise(ideal_pixels)))

    def normalise(self, ideal_pixels: Array) -> Array:
        """Normalised image coordinates (N, 2), x / z and y / z, of undistorted pixels (N, 2)."""
        return np.asarray((ideal_pixels - [self.cx_px, self.cy_px]) / [self.fx_px, self.fy_px])

    def is_within_reach(self, ideal_pixels: Array) -> NDArray[np.bool_]:
        """Which undistorted pixels (N, 2) lie at most ``WIDEST_ANGLE_DEG`` off the optical axis."""
        square = (self.normalise(ideal_pixels) ** 2).sum(axis=1)
        return np.asarray(square <= np.tan(np.radians(WIDEST_ANGLE_DEG)) ** 2)

    def magnification(self, ideal_pixels: Array) -> Array:
        """How far a recorded pixel's error is stretched by undistorting it: (N,) for undistorted pixels (N, 2).

        The root of |det d undistorted / d recorded|, so that an isotropic sigma keeps the information that the
        pixel has; 1 where nothing is distorted. Off the axis of a wide lens errors grow more along the radius than
        across it. The larger of the two stretches would waste what is known across, and let mismatches pass there.
        """
        if not self.has_distortion:
            return np.ones(len(ideal_pixels))
        J = jacobian(self.distortion_model, self.distortion, self.normalise(ideal_pixels))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(1.0 / np.sqrt(np.abs(J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0])))

    @cached_property
    def ideal_bounds_px(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom, in undistorted pixels, of what mapping uses of the image."""
        right, bottom = self.width_px - 1.0, self.height_px - 1.0
        if not self.has_distortion:
            return 0.0, 0.0, right, bottom
        grid = np.stack(np.meshgrid(np.linspace(0, right, 65), np.linspace(0, bottom, 65)), axis=2).reshape(-1, 2)
        ideal = self.undistort(grid)
        ideal = ideal[self.is_within_reach(ideal)]
        if len(ideal) == 0:
            return 0.0, 0.0, right, bottom
        margin_px = 2.0 * (ideal.max(axis=0) - ideal.min(axis=0)) / 64.0  # the grid steps over the limit
        (left, top), (right, bottom) = ideal.min(axis=0) - margin_px, ideal.max(axis=0) + margin_px
        return float(left), float(top), float(right), float(bottom)

    def is_inside(self, pixels: Array, border_px: float = 0.0) -> NDArray[np.bool_]:
        """Which pixels (N, 2) lie in the image, at least ``border_px`` from its edge; NaN is outside."""
        x, y = pixels[:, 0], pixels[:, 1]
        inside = (x >= border_px) & (x <= self.width_px - 1 - border_px)
        return np.asarray(inside & (y >= border_px) & (y <= self.height_px - 1 - border_px))

    def _pixels(self, normalised: Array) -> Array:
        focal, centre = np.array([self.fx_px, self.fy_px]), np.array([self.cx_px, self.cy_px])
        return np.asarray(normalised * focal + centre)

    def _distort(self, normalised: Array) -> Array:
        if not self.has_distortion:
            return normalised
        return distort(self.distortion_model, self.distortion, normalised)


def _normalised(points_in_cam: Array) -> Array:
    depth = points_in_cam[:, 2:3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(depth > 1e-6, points_in_cam[:, :2] / depth, np.nan)
