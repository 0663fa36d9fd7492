"""What of a camera's calibration is estimated, in which units, and how far off a workshop's may be.

Each parameter is a change against the recorded calibration, in units of its prior sigma:

    focal    common relative change of fx and fy        fx = fx0 exp(focal + aspect / 2)
    aspect   relative change of fx against fy           fy = fy0 exp(focal - aspect / 2)
    centre   cx and cy, pixels
    lens     every coefficient of the camera's own distortion model; its sigma is given as the shift, by this
             coefficient alone, of the image point that lies farthest from the centre
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.distortion import coefficient_jacobian, jacobian
from fleetmap_mapper.settings import CalibrationGroup

Array = NDArray[np.float64]
FOCAL, ASPECT, CENTRE, LENS = slice(0, 1), slice(1, 2), slice(2, 4), slice(4, None)


@dataclass(frozen=True)
class CalibrationPrior:
    """The recorded calibration, and a sigma for every parameter's change against it."""

    recorded: Camera
    sigmas: Array  # (C,) in the parameters' own units
    is_held: bool = False  # then nothing moves the calibration, not even by a rounding error

    def camera(self, change: Array) -> Camera:
        """The camera after a change (C,) in prior sigmas."""
        if self.is_held:
            return self.recorded
        focal, aspect, dcx, dcy, *lens = (change * self.sigmas).tolist()
        r = self.recorded
        return replace(
            r,
            fx_px=r.fx_px * float(np.exp(focal + 0.5 * aspect)),
            fy_px=r.fy_px * float(np.exp(focal - 0.5 * aspect)),
            cx_px=r.cx_px + dcx,
            cy_px=r.cy_px + dcy,
            distortion=tuple(k + dk for k, dk in zip(r.distortion, lens, strict=True)),
        )

    def change(self, camera: Camera) -> Array:
        """The inverse of :meth:`camera`: (C,) in prior sigmas."""
        if self.is_held:
            return np.zeros(len(self.sigmas))
        x, y = np.log(camera.fx_px / self.recorded.fx_px), np.log(camera.fy_px / self.recorded.fy_px)
        centre = [camera.cx_px - self.recorded.cx_px, camera.cy_px - self.recorded.cy_px]
        lens = np.subtract(camera.distortion, self.recorded.distortion)
        return np.concatenate([[0.5 * (x + y), x - y], centre, lens]) / self.sigmas

    def pixel_jacobian(self, camera: Camera, normalised: Array) -> Array:
        """d recorded pixel / d change (N, 2, C) at normalised points (N, 2) of ``camera``."""
        if self.is_held:
            return np.zeros((len(normalised), 2, len(self.sigmas)))
        focal = np.array([camera.fx_px, camera.fy_px])
        reach = camera.distort(normalised * focal + [camera.cx_px, camera.cy_px]) - [camera.cx_px, camera.cy_px]
        columns = np.zeros((len(normalised), 2, len(self.sigmas)))
        columns[:, :, 0] = reach
        columns[:, :, 1] = reach * [0.5, -0.5]
        columns[:, 0, 2] = columns[:, 1, 3] = 1.0
        by_lens = coefficient_jacobian(camera.distortion_model, camera.distortion, normalised)
        columns[:, :, LENS] = by_lens * focal[None, :, None]
        return columns * self.sigmas


def calibration_prior(camera: Camera, settings: CalibrationGroup) -> CalibrationPrior:
    """How far off the calibration of a recording may be, as the settings put it."""
    allowance_px = settings.distortion_sigma_ratio * camera.width_px
    corner = camera.normalise(farthest_point(camera)[None])
    by_lens = coefficient_jacobian(camera.distortion_model, camera.distortion, corner)[0]
    shifts_px = np.linalg.norm(by_lens * np.array([[camera.fx_px], [camera.fy_px]]), axis=0)
    centre_px = settings.centre_sigma_ratio * camera.width_px
    sigmas = [settings.focal_sigma_ratio, settings.aspect_sigma_ratio, centre_px, centre_px]
    return CalibrationPrior(camera, np.concatenate([sigmas, allowance_px / np.maximum(shifts_px, 1e-9)]))


def farthest_point(camera: Camera) -> Array:
    """The undistorted pixel (2,) of the image point farthest off the axis that mapping still uses."""
    border = border_points(camera)
    return np.asarray(border[np.argmax(np.linalg.norm(camera.normalise(border), axis=1))])


def border_points(camera: Camera) -> Array:
    """Undistorted pixels (N, 2) around the image, drawn in towards the centre where the lens leaves none."""
    right, bottom = camera.width_px - 1.0, camera.height_px - 1.0
    grid = np.linspace(0.0, 1.0, 9)
    sides = [(grid * right, 0.0 * grid), (grid * right, 0.0 * grid + bottom)]
    sides += [(0.0 * grid, grid * bottom), (0.0 * grid + right, grid * bottom)]
    recorded = np.concatenate([np.stack(side, axis=1) for side in sides])
    centre = np.array([0.5 * right, 0.5 * bottom])
    for shrink in np.linspace(1.0, 0.2, 17):
        ideal = camera.undistort(centre + shrink * (recorded - centre))
        usable = np.isfinite(ideal).all(axis=1) & camera.is_within_reach(np.nan_to_num(ideal))
        if np.count_nonzero(usable) >= len(grid):
            return np.asarray(ideal[usable])
    return np.array([[camera.cx_px + 0.5 * camera.width_px, camera.cy_px]])


def recorded_jacobian(camera: Camera, normalised: Array) -> Array:
    """d recorded pixel / d normalised (N, 2, 2)."""
    focal = np.array([[camera.fx_px], [camera.fy_px]])
    return np.asarray(jacobian(camera.distortion_model, camera.distortion, normalised) * focal)
