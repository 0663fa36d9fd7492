"""UGBA: the global bundle adjustment of poses and points on images and GNSS together, in GTSAM.

    min over S, {T_i}, {X_j} of  sum |z_ij - pi(T_i, X_j)|^2 in Omega
                               + sum_i rho(|u_i - S o trans(T_i)|^2 in Sigma_i)

The graph has a gauge freedom of seven, (S, T, X) ~ (S G^-1, G T, G X), so S is redundant: everything is
brought into the map frame first, S becomes the identity there, and the final S is composed afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap_mapper.fix_terms import FixTerm, add_gnss

Array = NDArray[np.float64]
_HUBER_PIXEL_SIGMAS = 2.4477  # 95 % of chi-square with 2 degrees of freedom


@dataclass(frozen=True)
class GlobalProblem:
    """Everything in the map frame."""

    camera: Camera
    poses: Sequence[Pose]  # K map_from_cam
    points_m: Array  # (P, 3)
    keyframe_index: NDArray[np.int32]  # (M,)
    point_index: NDArray[np.int32]  # (M,)
    pixels: Array  # (M, 2) undistorted
    sigmas_px: Array  # (M,)
    fixes: Sequence[FixTerm]
    level_sigma_rad: float  # of the mean tilt of the camera's horizontal axis, where fixes do not determine it


@dataclass(frozen=True)
class GlobalOptimum:
    """The same order as the problem."""

    poses: list[Pose]
    points_m: Array  # (P, 3)
    initial_cost: float
    cost: float


def adjust_globally(problem: GlobalProblem, max_iterations: int = 30) -> GlobalOptimum:
    """Run Levenberg-Marquardt on the whole graph."""
    graph, values = graph_without_images(problem)
    _add_observations(graph, problem)
    for j, point in enumerate(problem.points_m):
        values.insert(L(j), point)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(max_iterations)
    parameters.setRelativeErrorTol(1e-5)
    parameters.setOrdering(_points_first(len(problem.poses), len(problem.points_m)))
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    initial_cost = float(optimizer.error())
    result = optimizer.optimize()
    poses = [result.atPose3(X(i)) for i in range(len(problem.poses))]
    return GlobalOptimum(
        [Pose(p.rotation().matrix(), np.asarray(p.translation())) for p in poses],
        np.array([result.atPoint3(L(j)) for j in range(len(problem.points_m))]).reshape(-1, 3),
        initial_cost,
        float(optimizer.error()),
    )


def graph_without_images(problem: GlobalProblem) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """All that is known of the poses besides what they see, and where they start (keys X)."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    add_gnss(graph, problem.poses, problem.fixes, problem.level_sigma_rad)
    for i, pose in enumerate(problem.poses):
        values.insert(X(i), gtsam.Pose3(gtsam.Rot3(pose.rotation), pose.translation_m))
    return graph, values


def _add_observations(graph: gtsam.NonlinearFactorGraph, problem: GlobalProblem) -> None:
    camera = problem.camera
    calibration = gtsam.Cal3_S2(camera.fx_px, camera.fy_px, 0.0, camera.cx_px, camera.cy_px)
    huber = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER_PIXEL_SIGMAS)
    noises = {
        sigma: gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Isotropic.Sigma(2, sigma))
        for sigma in np.unique(problem.sigmas_px).tolist()
    }
    rows = zip(
        problem.keyframe_index.tolist(),
        problem.point_index.tolist(),
        problem.pixels,
        problem.sigmas_px.tolist(),
        strict=True,
    )
    for i, j, pixel, sigma in rows:
        graph.push_back(
            gtsam.GenericProjectionFactorCal3_S2(pixel, noises[sigma], X(i), L(j), calibration, False, False)
        )


def _points_first(keyframes: int, points: int) -> gtsam.Ordering:
    """Eliminate points before poses: the Schur complement, and no time spent on looking for an ordering."""
    ordering = gtsam.Ordering()
    for j in range(points):
        ordering.push_back(L(j))
    for i in range(keyframes):
        ordering.push_back(X(i))
    return ordering
