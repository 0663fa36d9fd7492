"""The compiled local adjustment against GTSAM on the same problem, and against a world that is known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from fleetmap.geometry import Pose, rotation_angle_rad
from fleetmap_mapper.adjustment import HUBER_PX, Adjusted, AdjustmentProblem, adjust, squared_errors

KEYFRAMES = 10
ENDS = (0, KEYFRAMES - 1)


def problem_of(world: Any, fixed: tuple[int, ...] = ENDS) -> AdjustmentProblem:
    """Some cameras stay where they are: the first and the last, or others."""
    inverse = [pose.inverse() for pose in world.poses]
    return AdjustmentProblem(
        world.camera,
        np.array([pose.rotation for pose in inverse]),
        np.array([pose.translation_m for pose in inverse]),
        np.isin(np.arange(len(inverse)), fixed),
        world.points,
        world.keyframe_index,
        world.point_index,
        world.pixels,
        world.sigmas_px,
    )


def misplaced(world: Any, fixed: tuple[int, ...] = ENDS) -> Any:
    """A start off by decimetres and a degree; the fixed cameras are right."""
    start = world.moved(np.random.default_rng(1), 0.1, 0.01, 0.3)
    return replace(start, poses=[world.poses[k] if k in fixed else pose for k, pose in enumerate(start.poses)])


def centres_of(adjusted: Adjusted) -> np.ndarray:
    return -np.einsum("kji,kj->ki", adjusted.rotations, adjusted.translations)


def adjust_with_gtsam(problem: AdjustmentProblem) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    camera = problem.camera
    calibration = gtsam.Cal3_S2(camera.fx_px, camera.fy_px, 0.0, camera.cx_px, camera.cy_px)
    huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER_PX)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, (R, t) in enumerate(zip(problem.rotations, problem.translations, strict=True)):
        world_from_cam = gtsam.Pose3(gtsam.Rot3(R), t).inverse()
        values.insert(X(i), world_from_cam)
        if problem.fixed[i]:
            graph.push_back(gtsam.NonlinearEqualityPose3(X(i), world_from_cam))
    for j, point in enumerate(problem.points):
        values.insert(L(j), point)
    for i, j, pixel, sigma in zip(
        problem.keyframe_index.tolist(),
        problem.point_index.tolist(),
        problem.pixels,
        problem.sigmas_px,
        strict=True,
    ):
        noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Isotropic.Sigma(2, sigma))
        graph.push_back(gtsam.GenericProjectionFactorCal3_S2(pixel, noise, X(i), L(j), calibration, False, False))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setMaxIterations(200)
    return graph, gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


def adjust_to_the_end(problem: AdjustmentProblem) -> Adjusted:
    """``adjust`` is content when the cost falls by less than a millionth; here every digit is wanted."""
    adjusted = adjust(problem, iterations=100)
    for _ in range(10):
        problem = replace(
            problem, rotations=adjusted.rotations, translations=adjusted.translations, points=adjusted.points
        )
        adjusted = adjust(problem, iterations=100)
    return adjusted


def values_of(adjusted: Adjusted) -> gtsam.Values:
    values = gtsam.Values()
    for i, (R, t) in enumerate(zip(adjusted.rotations, adjusted.translations, strict=True)):
        values.insert(X(i), gtsam.Pose3(gtsam.Rot3(R), t).inverse())
    for j, point in enumerate(adjusted.points):
        values.insert(L(j), point)
    return values


@pytest.mark.parametrize("outliers", [0.0, 0.05])
def test_the_optimum_is_gtsams(make_world, outliers):
    problem = problem_of(misplaced(make_world(outliers=outliers)))
    ours = adjust_to_the_end(problem)
    graph, values = adjust_with_gtsam(problem)

    assert ours.cost == pytest.approx(graph.error(values_of(ours)), rel=1e-9)
    assert ours.cost == pytest.approx(graph.error(values), rel=1e-8)
    assert adjust(problem, iterations=100).cost == pytest.approx(ours.cost, rel=1e-5)
    theirs = [values.atPose3(X(i)) for i in range(len(ours.rotations))]
    np.testing.assert_allclose(centres_of(ours), [pose.translation() for pose in theirs], atol=1e-4)
    turns = np.array([R @ pose.rotation().matrix() for R, pose in zip(ours.rotations, theirs, strict=True)])
    assert rotation_angle_rad(turns).max() < 1e-5
    points = np.array([values.atPoint3(L(j)) for j in range(len(ours.points))])
    assert np.median(np.linalg.norm(ours.points - points, axis=1)) < 1e-4


def test_a_known_world_is_found_again_as_well_as_its_noise_allows(make_world):
    world = make_world()
    start = misplaced(world)
    adjusted = adjust(problem_of(start), iterations=30)
    before_m = np.linalg.norm(start.centres - world.centres, axis=1)[1:-1]
    after_m = np.linalg.norm(centres_of(adjusted) - world.centres, axis=1)[1:-1]
    assert before_m.mean() > 0.1
    assert 0.001 < after_m.mean() < 0.05
    assert 0.9 < adjusted.chi2.mean() < 2.0  # two degrees of freedom, less those spent on poses and points


def test_without_noise_the_world_is_found_exactly(make_world):
    world = make_world(noise=0.0)
    adjusted = adjust(problem_of(misplaced(world)), iterations=50)
    np.testing.assert_allclose(centres_of(adjusted), world.centres, atol=1e-6)
    np.testing.assert_allclose(adjusted.points, world.points, atol=1e-4)
    assert adjusted.cost < 1e-8


def test_outliers_do_little_harm_and_show_in_chi2(make_world):
    world = make_world(outliers=0.08)
    clean = make_world()
    wrong = np.abs(world.pixels - clean.pixels).max(axis=1) > 12.0
    adjusted = adjust(problem_of(misplaced(world)), iterations=50)
    error_m = np.linalg.norm(centres_of(adjusted) - world.centres, axis=1)[1:-1]
    assert 0.001 < error_m.mean() < 0.1
    assert wrong.sum() > 50
    assert np.median(adjusted.chi2[wrong]) > 50.0
    assert (adjusted.chi2[~wrong] > 5.991).mean() < 0.1


def test_fixed_poses_do_not_move_at_all(make_world):
    fixed = [0, 3, 4]
    problem = problem_of(misplaced(make_world(), tuple(fixed)), tuple(fixed))
    adjusted = adjust(problem)
    np.testing.assert_allclose(adjusted.rotations[fixed], problem.rotations[fixed], atol=1e-14)
    np.testing.assert_array_equal(adjusted.translations[fixed], problem.translations[fixed])
    free = np.setdiff1d(np.arange(KEYFRAMES), fixed)
    assert np.abs(adjusted.translations[free] - problem.translations[free]).max(axis=1).min() > 0.01


def test_with_all_poses_fixed_only_points_move(make_world):
    world = make_world()
    start = replace(world, points=world.moved(np.random.default_rng(2), 0.0, 0.0, 0.3).points)
    adjusted = adjust(problem_of(start, fixed=tuple(range(KEYFRAMES))))
    before_m = np.median(np.linalg.norm(start.points - world.points, axis=1))
    after_m = np.median(np.linalg.norm(adjusted.points - world.points, axis=1))
    assert 0.0 < after_m < 0.8 * before_m
    np.testing.assert_array_equal(adjusted.translations, problem_of(start).translations)


def test_what_starts_behind_its_camera_takes_no_part(make_world):
    world = make_world()
    point = world.poses[-1].transform(np.array([[0.5, 0.2, -5.0]]))
    watchers = [k for k, pose in enumerate(world.poses) if pose.inverse().transform(point)[0, 2] > 1.0]
    assert 2 <= len(watchers) < KEYFRAMES - 1
    pixels = np.vstack([world.camera.project_ideal(world.poses[k].inverse().transform(point)) for k in watchers])

    def problem_with(claims: list[int], pixels: np.ndarray) -> AdjustmentProblem:
        problem = problem_of(misplaced(world))
        return replace(
            problem,
            points=np.vstack([problem.points, point]),
            keyframe_index=np.append(problem.keyframe_index, np.array(claims, np.int32)),
            point_index=np.append(problem.point_index, np.full(len(claims), len(problem.points), np.int32)),
            pixels=np.vstack([problem.pixels, pixels]),
            sigmas_px=np.append(problem.sigmas_px, np.ones(len(claims))),
        )

    plain = adjust(problem_with(watchers, pixels), iterations=40)
    with_it = adjust(
        problem_with([*watchers, KEYFRAMES - 1], np.vstack([pixels, [[300.0, 200.0]]])), iterations=40
    )
    np.testing.assert_allclose(with_it.translations, plain.translations, atol=1e-12)
    np.testing.assert_allclose(with_it.points, plain.points, atol=1e-9)
    assert with_it.cost == pytest.approx(plain.cost, rel=1e-12)
    assert with_it.chi2[-1] == np.inf
    assert np.isfinite(with_it.chi2[:-1]).all()


def test_no_step_takes_a_point_through_its_camera(make_world):
    """A point a hand's breadth before a camera, pulled towards it by a wrong pixel, stays before it."""
    world = make_world()
    problem = problem_of(world)
    near = world.poses[0].transform(np.array([[0.02, 0.01, 0.15]]))
    wider = replace(
        problem,
        points=np.vstack([problem.points, near]),
        keyframe_index=np.append(problem.keyframe_index, np.array([0, 0], np.int32)),
        point_index=np.append(problem.point_index, np.full(2, len(world.points), np.int32)),
        pixels=np.vstack([problem.pixels, [[0.0, 0.0], [600.0, 390.0]]]),
        sigmas_px=np.append(problem.sigmas_px, np.ones(2)),
    )
    adjusted = adjust(wider, iterations=30)
    assert world.poses[0].inverse().transform(adjusted.points[-1])[2] > 0.0
    assert np.isfinite(adjusted.cost)


def test_the_problem_is_left_as_it_was(make_world):
    problem = problem_of(misplaced(make_world()))
    copies = {name: getattr(problem, name).copy() for name in ("rotations", "translations", "points", "pixels")}
    adjust(problem)
    for name, copy in copies.items():
        np.testing.assert_array_equal(getattr(problem, name), copy)


def test_rotations_stay_rotations(make_world):
    adjusted = adjust(problem_of(misplaced(make_world())), iterations=30)
    for R in adjusted.rotations:
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)


def test_squared_errors_are_normalised_and_infinite_behind(make_world):
    world = make_world(noise=0.0)
    problem = problem_of(world)
    shifted = replace(
        problem, pixels=problem.pixels + np.array([3.0, -4.0]), sigmas_px=np.full(len(world.pixels), 2.0)
    )
    np.testing.assert_allclose(
        squared_errors(shifted, problem.rotations, problem.translations, problem.points), 25.0 / 4.0, rtol=1e-9
    )
    turned_back = Pose(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
    behind = [turned_back @ pose.inverse() for pose in world.poses]
    errors = squared_errors(
        problem, np.array([p.rotation for p in behind]), np.array([p.translation_m for p in behind]), world.points
    )
    assert np.all(errors == np.inf)
