"""Covariances of the final graph: GTSAM's own, number by number, and true to the errors that are really made."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from fleetmap.geometry import Pose
from fleetmap_mapper import global_adjustment
from fleetmap_mapper.fix_terms import FixTerm
from fleetmap_mapper.global_adjustment import GlobalProblem, adjust_globally
from fleetmap_mapper.pose_covariances import pose_covariances

ARM = np.array([0.3, -1.2, -0.8])
FIX_COVARIANCE = np.diag([1.0, 1.5, 4.0]) * 0.05**2
LEVEL_RAD = np.radians(0.5)
NO_LEVEL = 1e6  # rad: as good as no prior, whose weight depends on the whole drive
STREET = {"keyframes": 24, "points": 400, "step_m": 2.0}  # a keyframe sees back as far as half the street


def problem_of(world: Any, rng: np.random.Generator, every: int = 4) -> GlobalProblem:
    """A world at its truth, with a fix at every fourth keyframe."""
    fixes = [
        FixTerm(k, ARM, pose.transform(ARM) + rng.multivariate_normal(np.zeros(3), FIX_COVARIANCE), FIX_COVARIANCE)
        for k, pose in enumerate(world.poses)
        if k % every == 0
    ]
    return GlobalProblem(
        world.camera,
        world.poses,
        world.points,
        world.keyframe_index,
        world.point_index,
        world.pixels,
        world.sigmas_px,
        fixes,
        LEVEL_RAD,
    )


def gtsam_covariances(problem: GlobalProblem) -> np.ndarray:
    """Of the graph that the adjustment builds, with its points in it."""
    graph, values = global_adjustment.graph_without_images(problem)
    global_adjustment._add_observations(graph, problem)
    for j, point in enumerate(problem.points_m):
        values.insert(L(j), point)
    marginals = gtsam.Marginals(graph, values)
    return np.array([marginals.marginalCovariance(X(i)) for i in range(len(problem.poses))])


def position_covariances_m2(problem: GlobalProblem) -> np.ndarray:
    """Of the camera centres, in map."""
    rotations = np.array([pose.rotation for pose in problem.poses])
    return rotations @ pose_covariances(problem)[:, 3:, 3:] @ rotations.transpose(0, 2, 1)


def relative_error(found: np.ndarray, wanted: np.ndarray) -> float:
    """The largest difference over the sigmas of row and column."""
    sigmas = np.sqrt(np.diagonal(wanted, axis1=1, axis2=2))
    return float((np.abs(found - wanted) / (sigmas[:, :, None] * sigmas[:, None, :])).max())


@pytest.mark.parametrize("outliers", [0.0, 0.05])
def test_they_are_those_of_gtsam(make_world, outliers):
    """With wrong matches and a wild fix, too: robust costs count with the weights they have at the optimum."""
    problem = problem_of(make_world(**STREET, outliers=outliers), np.random.default_rng(1))
    wild = replace(problem.fixes[2], position_m=problem.fixes[2].position_m + np.array([3.0, -2.0, 1.0]))
    problem = replace(problem, fixes=[*problem.fixes[:2], wild, *problem.fixes[3:]])
    assert relative_error(pose_covariances(problem), gtsam_covariances(problem)) < 1e-6


def test_a_road_that_closes_upon_itself_is_no_exception(make_world):
    world = make_world(keyframes=40, points=500, step_m=4.0, radius_m=20.0)  # round, and on over the same road
    problem = problem_of(world, np.random.default_rng(2), every=6)
    spread = np.abs(np.subtract.outer(world.keyframe_index, world.keyframe_index))
    same = np.equal.outer(world.point_index, world.point_index)
    assert (spread * same).max() > 30  # the end does see what the beginning saw
    assert relative_error(pose_covariances(problem), gtsam_covariances(problem)) < 1e-6


def test_positions_are_turned_into_the_map(make_world):
    """Fixes at the cameras, precise and everywhere, leave nearly their own covariance, east, north and up."""
    world = make_world(keyframes=6, points=60)
    fixes = [FixTerm(k, np.zeros(3), p.translation_m, FIX_COVARIANCE * 1e-6) for k, p in enumerate(world.poses)]
    found = position_covariances_m2(replace(problem_of(world, np.random.default_rng(0)), fixes=fixes))
    np.testing.assert_allclose(found, np.tile(FIX_COVARIANCE * 1e-6, (6, 1, 1)), atol=2e-4 * 0.01e-6 * 4)


def test_what_no_fix_is_tied_to_is_unknown_and_the_rest_is_not(make_world):
    """Two streets that share no landmark, fixes on the first of them only."""
    first, second = (
        replace(problem_of(make_world(seed=seed, **STREET), np.random.default_rng(seed)), level_sigma_rad=NO_LEVEL)
        for seed in (1, 2)
    )
    keyframes, points = len(first.poses), len(first.points_m)
    both = replace(
        first,
        poses=[*first.poses, *second.poses],
        points_m=np.vstack([first.points_m, second.points_m]),
        keyframe_index=np.concatenate([first.keyframe_index, second.keyframe_index + keyframes]),
        point_index=np.concatenate([first.point_index, second.point_index + points]),
        pixels=np.vstack([first.pixels, second.pixels]),
        sigmas_px=np.concatenate([first.sigmas_px, second.sigmas_px]),
    )
    found = pose_covariances(both)
    assert np.isnan(found[keyframes:]).all()
    assert relative_error(found[:keyframes], pose_covariances(first)) < 1e-6


def test_a_keyframe_that_sees_nothing_and_has_no_fix_is_unknown_alone(make_world):
    world = make_world(**STREET)
    problem = problem_of(world, np.random.default_rng(0))
    blind = replace(problem, poses=[*problem.poses, Pose(np.eye(3), np.array([0.0, 0.0, 9.0]))])
    is_known = np.isfinite(pose_covariances(blind)).all(axis=(1, 2))
    assert is_known.tolist() == [True] * len(problem.poses) + [False]


def test_a_keyframe_that_hangs_on_one_landmark_is_unknown_alone(make_world):
    world = make_world(**STREET)
    problem = replace(problem_of(world, np.random.default_rng(0)), level_sigma_rad=NO_LEVEL)
    hanging = world.poses[5]
    pixel = world.camera.project_ideal(hanging.inverse().transform(world.points))[[0]]
    dangling = replace(
        problem,
        poses=[*problem.poses, hanging],
        keyframe_index=np.append(problem.keyframe_index, len(problem.poses)).astype(np.int32),
        point_index=np.append(problem.point_index, 0).astype(np.int32),
        pixels=np.vstack([problem.pixels, pixel]),
        sigmas_px=np.append(problem.sigmas_px, 1.0),
    )
    found = pose_covariances(dangling)
    assert np.isnan(found[-1]).all()
    assert relative_error(found[:-1], pose_covariances(problem)) < 1e-4


def test_it_grows_away_from_the_fixes(make_world):
    world = make_world(keyframes=40, points=900, step_m=2.0)
    fixed = [k for k in range(40) if k < 10 or k >= 30]
    fixes = [FixTerm(k, ARM, world.poses[k].transform(ARM), FIX_COVARIANCE) for k in fixed]
    problem = replace(problem_of(world, np.random.default_rng(0)), fixes=fixes)
    sigmas = np.sqrt(np.trace(position_covariances_m2(problem), axis1=1, axis2=2))
    assert 14 <= int(np.argmax(sigmas)) <= 26
    assert 1.5 < sigmas.max() / np.median(sigmas[fixed]) < 3.0


def test_errors_really_made_are_as_large_as_the_covariances_say(make_world):
    """NEES of positions over worlds that differ by their noise alone: 3 on average for three parts each."""
    nees = []
    for seed in range(12):
        world = make_world(keyframes=16, points=260, step_m=2.5, seed=seed)
        problem = problem_of(world, np.random.default_rng(100 + seed), every=2)
        optimum = adjust_globally(problem)
        at_optimum = replace(problem, poses=optimum.poses, points_m=optimum.points_m)
        errors = np.array([pose.translation_m for pose in optimum.poses]) - world.centres
        nees.append(np.einsum("ki,kij,kj->k", errors, np.linalg.inv(position_covariances_m2(at_optimum)), errors))
    assert 2.2 < np.mean(nees) < 3.9  # neighbouring keyframes err alike: about 40 independent ones
