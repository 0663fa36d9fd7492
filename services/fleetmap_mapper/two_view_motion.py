"""The motion between two views, from matched pixels.

A camera with a narrow view that looks along a road can hardly tell a sideways step from a turn: where most matches
are far away, or on a car that drives ahead, a wrong motion that turns much and lets everything lie near explains
as many of them as the true one, which turns little and lets them be far. So several explanations are sought, and
the caller prefers the one with least parallax. Source of the ambiguity: G. Adiv, "Inherent ambiguities in
recovering 3-D motion and structure from a noisy flow field", PAMI 1989.
"""

from __future__ import annotations

import numpy as np
import poselib
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap_mapper.triangulation import rays_of

Array = NDArray[np.float64]

_MAX_EPIPOLAR_PX = 1.5
_FAR_PX = (1.5, 3.0)  # a match that a mere turn predicts so well counts as far away
_LOSSES_PX = (1.5, 3.0)  # beyond, a match counts as an outlier when the start is refined
_TRIALS = 200


def motions_between(camera: Camera, pixels_a: Array, pixels_b: Array, seed: int) -> list[Pose]:
    """``a_from_b`` with |t| = 1 as different readings of matches (N, 2) have it, of both signs where it is open.

    The first is the one that the largest number agrees with (Nister's five-point method in LO-RANSAC, as PoseLib
    implements it); the others start from the mere turn that explains most.
    """
    model = _model(camera)
    b_from_a, _ = poselib.estimate_relative_pose(
        pixels_a, pixels_b, model, model, {"max_epipolar_error": _MAX_EPIPOLAR_PX, "seed": seed}
    )
    motions = [_inverse(b_from_a)]
    rng = np.random.default_rng(seed)
    rays_a, rays_b = (rays_of(camera, Pose.identity(), pixels) for pixels in (pixels_a, pixels_b))
    for far_px in _FAR_PX:
        start = poselib.CameraPose()
        start.R = _rotation_of_most(rng, rays_a, rays_b, far_px / camera.fx_px)
        normals = np.cross(rays_a @ start.R.T, rays_b)  # of the epipolar planes: t lies in all of them
        start.t = _direction_of_most(rng, normals, _MAX_EPIPOLAR_PX / camera.fx_px)
        for loss_px in _LOSSES_PX:
            options = {"loss_type": "TRUNCATED", "loss_scale": loss_px}
            refined, _ = poselib.refine_relative_pose(pixels_a, pixels_b, start, model, model, options)
            motion = _inverse(refined)
            motions += [motion, Pose(motion.rotation, -motion.translation_m)]
    return motions


def _rotation_of_most(rng: np.random.Generator, rays_a: Array, rays_b: Array, max_angle: float) -> Array:
    """b_from_a (3, 3), from pairs of matches, that turns the most rays (N, 3) of a onto those of b."""
    pairs = rng.integers(0, len(rays_a), (_TRIALS, 2))
    rotations = _frames(rays_b[pairs]) @ np.swapaxes(_frames(rays_a[pairs]), 1, 2)
    apart = np.linalg.norm(np.einsum("tij,nj->tni", rotations, rays_a) - rays_b, axis=2)
    costs = np.minimum(apart, max_angle).sum(axis=1)
    costs[~np.isfinite(costs)] = np.inf
    return np.asarray(rotations[np.argmin(costs)])


def _frames(rays: Array) -> Array:
    """Rotation matrices (T, 3, 3) whose first two columns span the two rays of each pair (T, 2, 3)."""
    middle, across = rays[:, 0] + rays[:, 1], rays[:, 0] - rays[:, 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        x = middle / np.linalg.norm(middle, axis=1, keepdims=True)
        y = across / np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=2)


def _direction_of_most(rng: np.random.Generator, normals: Array, max_distance: float) -> Array:
    """Unit vector (3,) nearest to perpendicular to the normals (N, 3); long ones say more than short ones."""
    pairs = rng.integers(0, len(normals), (_TRIALS, 2))
    directions = np.cross(normals[pairs[:, 0]], normals[pairs[:, 1]])
    lengths = np.linalg.norm(directions, axis=1)
    directions = directions[lengths > 0.0] / lengths[lengths > 0.0, None]
    if len(directions) == 0:
        return np.array([0.0, 0.0, 1.0])
    costs = np.minimum(np.abs(directions @ normals.T), max_distance).sum(axis=1)
    return np.asarray(directions[np.argmin(costs)])


def _inverse(b_from_a: poselib.CameraPose) -> Pose:
    return Pose(np.asarray(b_from_a.R), np.asarray(b_from_a.t)).inverse()


def _model(camera: Camera) -> dict[str, object]:
    return {
        "model": "PINHOLE",
        "width": camera.width_px,
        "height": camera.height_px,
        "params": [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px],
    }
