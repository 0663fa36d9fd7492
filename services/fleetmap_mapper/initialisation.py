"""The first map, from two views (Nister's five-point method in LO-RANSAC, from poselib).

Raw parallax is fooled by rotation, so what counts is the angle between the rays of triangulated points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import poselib
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap.vision.features import Features
from fleetmap.vision.matching import match_descriptors
from fleetmap_mapper.settings import MapperSettings
from fleetmap_mapper.triangulation import is_consistent, parallax_rad, triangulate

Array = NDArray[np.float64]
_MAX_HAMMING, _RATIO = 64, 0.8
_MIN_CONSISTENT = 0.6  # of all matches: moving traffic may own the rest
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
    pixels_a, pixels_b = first.pixels[pairs[:, 0]], second.pixels[pairs[:, 1]]
    first_from_second = _relative_pose(camera, pixels_a, pixels_b, settings.seed)
    points = triangulate(camera, Pose.identity(), pixels_a, first_from_second, pixels_b)
    consistent = is_consistent(
        camera, Pose.identity(), points, pixels_a, first.sigmas_px[pairs[:, 0]]
    ) & is_consistent(camera, first_from_second, points, pixels_b, second.sigmas_px[pairs[:, 1]])
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


def _relative_pose(camera: Camera, pixels_a: Array, pixels_b: Array, seed: int) -> Pose:
    model = {
        "model": "PINHOLE",
        "width": camera.width_px,
        "height": camera.height_px,
        "params": [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px],
    }
    second_from_first, _ = poselib.estimate_relative_pose(
        pixels_a, pixels_b, model, model, {"max_epipolar_error": 1.5, "seed": seed}
    )
    return Pose(np.asarray(second_from_first.R), np.asarray(second_from_first.t)).inverse()
