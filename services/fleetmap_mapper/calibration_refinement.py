"""The calibration refined in the UGBA: one Levenberg-Marquardt over calibration, poses, points and fixes."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap_mapper.bordered_system import solve_bordered
from fleetmap_mapper.calibrated_graph import CalibratedGraph, State
from fleetmap_mapper.calibration_parameters import CalibrationPrior
from fleetmap_mapper.global_adjustment import GlobalProblem

_log = logging.getLogger(__name__)
Array = NDArray[np.float64]

_MAX_STEPS = 50
_MAX_DAMPING = 1e6


@dataclass(frozen=True)
class Refined:
    """The joint optimum."""

    problem: GlobalProblem  # with the refined camera, its poses, points, undistorted pixels and their sigmas
    initial_cost: float
    cost: float


def refine_calibration(problem: GlobalProblem, prior: CalibrationPrior, tolerance: float = 1e-7) -> Refined:
    """Move the calibration with everything else to the optimum of all observations, fixes and priors.

    It is reached when a step lessens the cost by less than ``tolerance`` of it.
    """
    graph = CalibratedGraph(problem, prior)
    state, cost = optimise(graph, _MAX_STEPS, tolerance)
    refined = Refined(_renewed(problem, graph, state), graph.cost(graph.start), cost)
    if not prior.is_held:
        _log.info("calibration refined from %s to %s", problem.camera, refined.problem.camera)
    return refined


def optimise(graph: CalibratedGraph, max_steps: int, tolerance: float = 0.0) -> tuple[State, float]:
    """Levenberg-Marquardt from the graph's start: the state reached, and its cost."""
    state, damping = graph.start, 1e-5
    cost = graph.cost(state)
    for _ in range(max_steps):
        images, rest = graph.linearised(state)
        while True:
            try:
                moved = graph.moved(state, solve_bordered(images, rest, state.change, damping))
                new_cost = graph.cost(moved)
            except (np.linalg.LinAlgError, RuntimeError):  # singular, says SuperLU by the latter: damp it more
                new_cost = np.inf
            if new_cost < cost:
                break
            damping *= 10.0
            if damping > _MAX_DAMPING:
                return state, cost
        decrease, state, cost = cost - new_cost, moved, new_cost
        damping = max(0.1 * damping, 1e-9)
        if decrease <= tolerance * cost:
            break
    return state, cost


def seen_anew(pixels: Array, before: Camera, after: Camera) -> Array:
    """Undistorted pixels (N, 2) of one calibration as another one undistorts them; as before where it cannot."""
    if before == after:
        return pixels
    renewed = after.undistort(before.distort(pixels))
    return np.where(np.isfinite(renewed).all(axis=1, keepdims=True), renewed, pixels)


def _renewed(problem: GlobalProblem, graph: CalibratedGraph, state: State) -> GlobalProblem:
    """The problem seen through the refined camera."""
    camera = graph.camera(state)
    pixels = seen_anew(problem.pixels, problem.camera, camera)
    return replace(
        problem,
        camera=camera,
        poses=graph.poses(state),
        points_m=state.points_m,
        pixels=pixels,
        sigmas_px=problem.sigmas_px * camera.magnification(pixels) / problem.camera.magnification(problem.pixels),
    )
