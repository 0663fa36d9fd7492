"""The first map, from two views.

Raw parallax is fooled by rotation, so what counts is the angle between the rays of triangulated points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap.vision.features import Features
from fleetmap.vision.matching import match_descriptors
from fleetmap_mapper.settings import MapperSettings
from fleetmap_mapper.triangulation import is_consistent, parallax_rad, triangulate
from fleetmap_mapper.two_view_motion import motions_between

Array = NDArray[np.float64]
_MAX_HAMMING, _RATIO = 64, 0.8
_MIN_CONSISTENT = 0.6  # of all matches: moving traffic may own the rest
_ABOUT_AS_MANY = 0.75  # of the most: the rest may ride on a car ahead
_NOMINAL_DEPTH = 10.0  # median depth of the first map: its scale is free, this keeps numbers of order one


@dataclass(frozen=True)
class TwoViewMap:
    """Two poses and what both of them see; the first camera is the origin."""

    first_from_second: Pose
    points: Array  # (n, 3) float64 in the first camera's frame
    first_features: NDArray[np.int32]  # (n,)
    second_features: NDArray[np.int32]  # (n,)


def match_two_views(first: Features, second: Features) -> NDArray[np.int32]:
    """Pairs (P, 2) of feature indices that look alike."""
    return match_descriptors(first.descriptors, second.descriptors, _MAX_HAMMING, _RATIO)


def map_from_two_views(
    camera: Camera, first: Features, second: Features, pairs: NDArray[np.int32], settings: MapperSettings
) -> TwoViewMap | None:
    """A first map, or None while the two views do not determine one."""
    pixels_a, sigmas_a = first.pixels[pairs[:, 0]], first.sigmas_px[pairs[:, 0]]
    pixels_b, sigmas_b = second.pixels[pairs[:, 1]], second.sigmas_px[pairs[:, 1]]
    first_from_second = _motion(camera, pixels_a, sigmas_a, pixels_b, sigmas_b, settings.seed)
    points, consistent = _triangulated(camera, first_from_second, pixels_a, sigmas_a, pixels_b, sigmas_b)
    parallax = parallax_rad(points, np.zeros(3), first_from_second.translation_m)
    good = consistent & (parallax > settings.mapping.min_parallax_px / camera.fx_px)
    # Far matches show no parallax, but bear witness. To wait until most show some would be wrong: matches thin
    # out on the way, and then the second solution of a plane wins, which shows parallax everywhere.
    if good.sum() < settings.initialisation.min_points or consistent.sum() < _MIN_CONSISTENT * len(pairs):
        return None
    scale = _NOMINAL_DEPTH / float(np.median(points[good, 2]))
    return TwoViewMap(
        Pose(first_from_second.rotation, first_from_second.translation_m * scale),
        points[good] * scale,
        pairs[good, 0],
        pairs[good, 1],
    )


def _motion(camera: Camera, pixels_a: Array, sigmas_a: Array, pixels_b: Array, sigmas_b: Array, seed: int) -> Pose:
    """``first_from_second``, of unit length: the one that lets the scene be far, unless another explains more."""
    motions = motions_between(camera, pixels_a, pixels_b, seed)
    explained, parallaxes = [], []
    for motion in motions:
        points, consistent = _triangulated(camera, motion, pixels_a, sigmas_a, pixels_b, sigmas_b)
        explained.append(int(consistent.sum()))
        parallax = parallax_rad(points[consistent], np.zeros(3), motion.translation_m)
        parallaxes.append(float(parallax.mean()) if len(parallax) else np.inf)
    enough = np.array(explained) >= _ABOUT_AS_MANY * max(explained)
    return motions[int(np.argmin(np.where(enough, parallaxes, np.inf)))]


def _triangulated(
    camera: Camera, first_from_second: Pose, pixels_a: Array, sigmas_a: Array, pixels_b: Array, sigmas_b: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Points (n, 3) in the first camera's frame, and which of them both views believe."""
    points = triangulate(camera, Pose.identity(), pixels_a, first_from_second, pixels_b)
    consistent = is_consistent(camera, Pose.identity(), points, pixels_a, sigmas_a)
    return points, consistent & is_consistent(camera, first_from_second, points, pixels_b, sigmas_b)
