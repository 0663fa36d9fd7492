"""How a camera moved between two images close in time: optical flow, then rotation and direction of travel.

Corners are followed by pyramidal Lucas-Kanade at reduced size, forth and back. The epipolar geometry starts from
the five-point method in RANSAC (Nister, "An efficient solution to the five-point relative pose problem", PAMI
2004) and from a straight drive ahead; each is refined by minimising Sampson's distance (Hartley and Zisserman,
"Multiple View Geometry", 2003, eq. 11.9) under Cauchy's robust weights, and the better one is kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import nearest_rotations, so3_exp, so3_log

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_WIDTH_PX = 640  # images are followed at this width
_CORNERS, _CORNER_DISTANCE_PX, _CORNER_QUALITY = 350, 9, 0.002
_WINDOW_PX, _LEVELS = (15, 15), 4
_BACK_CHECK_PX = 0.7
_MIN_TRACKS = 20
_NOISE_PX = 0.3  # of a followed corner at reduced size; the scale of the robust weights
_FLOW_BIAS_PX = 0.03  # of Lucas-Kanade at full size, common to many corners: no parallax smaller points anywhere
_ITERATIONS = 12


@dataclass(frozen=True)
class FrameMotion:
    """From one image to the next. Directions are in the first camera's frame."""

    rotation_rad: Array  # (3,) rotation vector of first_from_second
    direction: Array  # (3,) unit vector towards the second camera's centre; arbitrary where the camera stands
    rotation_sigma_rad: float  # per axis
    direction_sigma_rad: float  # large where the camera stands
    track_count: int
    parallax_px: float  # median flow at full size that the rotation does not explain


class FrameFollower:
    """Measures the motion between successive images of one camera."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._shrink = min(1.0, _WIDTH_PX / camera.width_px)
        self._noise = _NOISE_PX / (self._shrink * camera.fx_px)  # on the normalised image plane

    def reduced(self, image: Image) -> Image:
        """The image at the size it is followed at."""
        size = (round(image.shape[1] * self._shrink), round(image.shape[0] * self._shrink))
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def motion(self, first: Image, second: Image) -> FrameMotion | None:
        """The motion between two reduced images; None where too few corners can be followed."""
        pixels_a, pixels_b = _follow(first, second)
        rays_a, rays_b = self._rays(pixels_a, first), self._rays(pixels_b, first)
        seen = np.isfinite(rays_a).all(axis=1) & np.isfinite(rays_b).all(axis=1)
        rays_a, rays_b = rays_a[seen], rays_b[seen]
        if len(rays_a) < _MIN_TRACKS:
            return None
        starts = [(_rotation_only(rays_a, rays_b, self._noise), np.array([0.0, 0.0, 1.0]))]
        starts += _five_point(rays_a, rays_b, 2.0 * self._noise)
        fits = [_refine(rays_a, rays_b, rotation, direction, self._noise) for rotation, direction in starts]
        best = min(fits, key=lambda fit: fit.cost)
        parallax_px = self._parallax_px(rays_a, rays_b, best.rotation)
        return FrameMotion(
            rotation_rad=so3_log(best.rotation),
            direction=_ahead_of_points(rays_a, rays_b, best.rotation, best.direction),
            rotation_sigma_rad=best.rotation_sigma_rad,
            direction_sigma_rad=float(np.hypot(best.direction_sigma_rad, _FLOW_BIAS_PX / max(parallax_px, 1e-6))),
            track_count=len(rays_a),
            parallax_px=parallax_px,
        )

    def _rays(self, reduced_pixels: Array, reduced: Image) -> Array:
        """Viewing rays (N, 3) with z = 1."""
        scale = np.array([self.camera.width_px / reduced.shape[1], self.camera.height_px / reduced.shape[0]])
        return self.camera.unproject((reduced_pixels + 0.5) * scale - 0.5)

    def _parallax_px(self, rays_a: Array, rays_b: Array, rotation: Array) -> float:
        turned = rays_b @ rotation.T
        flow = turned[:, :2] / turned[:, 2:3] - rays_a[:, :2]
        return float(np.median(np.linalg.norm(flow, axis=1)) * self.camera.fx_px)


def _follow(first: Image, second: Image) -> tuple[Array, Array]:
    """Pixels (N, 2) of the same corners in both images."""
    corners = cv2.goodFeaturesToTrack(first, _CORNERS, _CORNER_QUALITY, _CORNER_DISTANCE_PX)
    if corners is None or len(corners) == 0:
        return np.zeros((0, 2)), np.zeros((0, 2))
    followed, found, _ = cv2.calcOpticalFlowPyrLK(
        first, second, corners, np.zeros_like(corners), winSize=_WINDOW_PX, maxLevel=_LEVELS
    )
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(
        second, first, followed, np.zeros_like(corners), winSize=_WINDOW_PX, maxLevel=_LEVELS
    )
    there = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    here = np.asarray(followed, dtype=np.float64).reshape(-1, 2)
    error_px = np.linalg.norm(np.asarray(back, dtype=np.float64).reshape(-1, 2) - there, axis=1)
    good = (found.ravel() == 1) & (found_back.ravel() == 1) & (error_px < _BACK_CHECK_PX)
    return there[good], here[good]


def _rotation_only(rays_a: Array, rays_b: Array, noise: float) -> Array:
    """The rotation (3, 3) a_from_b that explains most of the flow if nothing is near."""
    unit_a = rays_a / np.linalg.norm(rays_a, axis=1, keepdims=True)
    unit_b = rays_b / np.linalg.norm(rays_b, axis=1, keepdims=True)
    weights = np.ones(len(rays_a))
    rotation = np.eye(3)
    for _ in range(5):
        rotation = nearest_rotations((unit_a * weights[:, None]).T @ unit_b)
        errors = np.linalg.norm(unit_b @ rotation.T - unit_a, axis=1)
        weights = 1.0 / (1.0 + (errors / max(float(np.median(errors)), noise)) ** 2)
    return rotation


def _five_point(rays_a: Array, rays_b: Array, threshold: float) -> list[tuple[Array, Array]]:
    """Rotation a_from_b and direction in a, as RANSAC finds them; empty where it finds none."""
    cv2.setRNGSeed(0)
    points_b, points_a = np.ascontiguousarray(rays_b[:, :2]), np.ascontiguousarray(rays_a[:, :2])
    essential, inliers = cv2.findEssentialMat(
        points_b, points_a, np.eye(3), method=cv2.RANSAC, prob=0.99, threshold=threshold, maxIters=100
    )
    if essential is None or essential.shape != (3, 3):
        return []
    _, rotation, translation, _ = cv2.recoverPose(essential, points_b, points_a, np.eye(3), mask=inliers)
    return [(np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64).ravel())]


@dataclass(frozen=True)
class _Fit:
    rotation: Array  # (3, 3) a_from_b
    direction: Array  # (3,) unit, sign undetermined
    cost: float
    rotation_sigma_rad: float
    direction_sigma_rad: float


def _refine(rays_a: Array, rays_b: Array, rotation: Array, direction: Array, noise: float) -> _Fit:
    """Gauss-Newton on Sampson's distance; the robust scale narrows from four times the noise to the noise."""
    for iteration in range(_ITERATIONS):
        scale = noise * max(1.0, 4.0 * 0.6**iteration)
        residuals, jacobian = _sampson(rays_a, rays_b, rotation, direction)
        weights = 1.0 / (1.0 + (residuals / scale) ** 2)
        weighted = jacobian * weights[:, None]
        information = weighted.T @ jacobian + 1e-9 * np.eye(5)
        step = np.asarray(-np.linalg.solve(information, weighted.T @ residuals), dtype=np.float64)
        step *= min(1.0, 0.3 / max(float(np.linalg.norm(step)), 1e-12))
        rotation = rotation @ so3_exp(step[:3])
        direction = direction + _tangents(direction) @ step[3:]
        direction = direction / np.linalg.norm(direction)
        if iteration > 5 and float(np.linalg.norm(step)) < 1e-7:
            break
    spread = max(float(np.average(residuals**2, weights=weights)) ** 0.5, 0.2 * noise)
    sigmas = np.sqrt(np.diag(np.linalg.inv(information))) * spread
    cost = float(np.log1p((residuals / noise) ** 2).sum())
    return _Fit(rotation, direction, cost, float(sigmas[:3].max()), float(sigmas[3:].max()))


def _sampson(rays_a: Array, rays_b: Array, rotation: Array, direction: Array) -> tuple[Array, Array]:
    """Sampson distances (N,) on the normalised plane, and their derivatives (N, 5): rotation, then direction.

    The constraint is a . (t x R b) = 0; its gradient's length is taken as constant.
    """
    turned = rays_b @ rotation.T
    line_in_a = np.cross(direction, turned)
    line_in_b = np.cross(rays_a, direction) @ rotation
    gradient = np.sqrt((line_in_a[:, :2] ** 2).sum(axis=1) + (line_in_b[:, :2] ** 2).sum(axis=1) + 1e-18)
    by_rotation = np.cross(rays_b, line_in_b)
    by_direction = np.cross(turned, rays_a) @ _tangents(direction)
    residuals = (rays_a * line_in_a).sum(axis=1) / gradient
    return residuals, np.hstack([by_rotation, by_direction]) / gradient[:, None]


def _tangents(direction: Array) -> Array:
    """Two unit vectors (3, 2) across a unit vector."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(direction[0]) < 0.7 else np.array([0.0, 1.0, 0.0])
    first = np.cross(direction, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)], axis=1)


def _ahead_of_points(rays_a: Array, rays_b: Array, rotation: Array, direction: Array) -> Array:
    """The direction with the sign that puts the points in front of the camera."""
    turned = rays_b @ rotation.T
    depths = (np.cross(turned, direction) * np.cross(turned, rays_a)).sum(axis=1)
    return direction if float(np.sign(depths).sum()) >= 0.0 else -direction
