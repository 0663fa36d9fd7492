"""UGBA: a known world is found again, and the form in print, with S as a variable of its own, costs the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, S, X

from fleetmap.geometry import Pose, Sim3, rotation_angle_rad, so3_exp, umeyama_alignment
from fleetmap_mapper.fix_terms import FixTerm
from fleetmap_mapper.georeferencing import HUBER_SIGMAS
from fleetmap_mapper.global_adjustment import GlobalOptimum, GlobalProblem, adjust_globally

SIGMA_M = 0.05
NO_LEVEL = 1e6  # rad: as good as no prior
ARM = np.array([0.3, -1.2, -0.8])
HUBER_PX = 2.4477
BEND = {"keyframes": 16, "points": 400, "step_m": 2.5}  # 37 m around a corner: positions see all of S


def fixes_along(world: Any, every: int, arm: np.ndarray, seed: int = 5) -> list[FixTerm]:
    rng = np.random.default_rng(seed)
    covariance = np.diag([1.0, 1.0, 2.0]) * SIGMA_M**2
    return [
        FixTerm(k, arm, pose.transform(arm) + rng.multivariate_normal(np.zeros(3), covariance), covariance)
        for k, pose in enumerate(world.poses)
        if k % every == 0
    ]


def problem_of(
    world: Any, fixes: Sequence[FixTerm], start: Any = None, level_sigma_rad: float = NO_LEVEL
) -> GlobalProblem:
    start = start or world
    return GlobalProblem(
        world.camera,
        start.poses,
        start.points,
        world.keyframe_index,
        world.point_index,
        world.pixels,
        world.sigmas_px,
        fixes,
        level_sigma_rad,
    )


def drifted(world: Any, turn_rad: float = 0.02, stretch: float = 1.03) -> Any:
    """The world as SLAM would have it: bent, stretched and shaken a little."""
    warp = Sim3(stretch, so3_exp(np.array([0.01, -0.02, turn_rad])), np.array([0.4, -0.3, 0.2]))
    poses = [warp.transform_pose(pose) for pose in world.poses]
    return replace(world, poses=poses, points=warp.transform(world.points)).moved(
        np.random.default_rng(3), 0.05, 0.003, 0.05
    )


def errors_m(poses: Sequence[Pose], world: Any) -> np.ndarray:
    return np.linalg.norm(np.array([p.translation_m for p in poses]) - world.centres, axis=1)


def errors_deg(poses: Sequence[Pose], world: Any) -> np.ndarray:
    turns = np.array([a.rotation.T @ b.rotation for a, b in zip(poses, world.poses, strict=True)])
    return np.degrees(rotation_angle_rad(turns))


def mean_rise_m(poses: Sequence[Pose], world: Any) -> float:
    return float((np.array([pose.translation_m for pose in poses]) - world.centres)[:, 2].mean())


def roll_deg(poses: Sequence[Pose]) -> float:
    """Mean tilt of the cameras' x axis out of the horizontal."""
    return float(np.degrees(np.arcsin([p.rotation[2, 0] for p in poses])).mean())


@pytest.mark.parametrize("arm", [np.zeros(3), ARM], ids=["antenna at the camera", "lever arm"])
def test_a_known_world_is_found_again(make_world, arm):
    world = make_world(**BEND)
    start = drifted(world)
    optimum = adjust_globally(problem_of(world, fixes_along(world, 1, arm), start))
    assert errors_m(start.poses, world).mean() > 0.3
    assert 0.005 < errors_m(optimum.poses, world).mean() < 0.06
    assert 0.001 < errors_deg(optimum.poses, world).mean() < 0.8
    median_m = np.median(np.linalg.norm(optimum.points_m - world.points, axis=1))
    assert 0.01 < median_m < 0.4
    assert optimum.cost < 0.5 * optimum.initial_cost


def test_without_noise_the_world_is_found_exactly(make_world):
    world = make_world(keyframes=12, points=150, noise=0.0)
    fixes = [
        replace(fix, position_m=world.poses[fix.keyframe].transform(ARM)) for fix in fixes_along(world, 3, ARM)
    ]
    optimum = adjust_globally(problem_of(world, fixes, drifted(world)), max_iterations=100)
    assert errors_m(optimum.poses, world).max() < 1e-4
    assert errors_deg(optimum.poses, world).max() < 1e-3
    assert optimum.cost < 1e-4


def test_a_forgotten_lever_arm_shows(make_world):
    """The test above would pass with an arm that is ignored, if the arm did not matter: it does."""
    world = make_world(**BEND)
    fixes = [replace(fix, arm_in_cam_m=np.zeros(3)) for fix in fixes_along(world, 3, ARM)]
    assert errors_m(adjust_globally(problem_of(world, fixes)).poses, world).mean() > 0.8


def test_a_fix_that_is_far_off_is_resisted(make_world):
    world = make_world(**BEND)
    fixes = fixes_along(world, 2, ARM)
    fixes[3] = replace(fixes[3], position_m=fixes[3].position_m + np.array([4.0, -3.0, 2.0]))
    optimum = adjust_globally(problem_of(world, fixes, drifted(world)))
    assert 0.005 < errors_m(optimum.poses, world).mean() < 0.12


def test_wrong_matches_are_resisted(make_world):
    world = make_world(**BEND, outliers=0.03)
    optimum = adjust_globally(problem_of(world, fixes_along(world, 3, ARM), drifted(world)))
    assert 0.005 < errors_m(optimum.poses, world).mean() < 0.12


def test_fixes_pull_by_their_covariance(make_world):
    world = make_world(keyframes=8, points=100)
    fixes = fixes_along(world, 1, np.zeros(3))
    raised = [replace(fix, position_m=fix.position_m + np.array([0.0, 0.0, 1.0])) for fix in fixes]
    loose = [replace(fix, covariance_m2=fix.covariance_m2 * [1.0, 1.0, 1e6]) for fix in raised]
    assert 0.3 < mean_rise_m(adjust_globally(problem_of(world, [*fixes, *raised])).poses, world) < 0.7
    assert abs(mean_rise_m(adjust_globally(problem_of(world, [*fixes, *loose])).poses, world)) < 0.1


# --- the level prior


def test_on_a_straight_road_the_level_prior_takes_the_free_roll_away(make_world):
    world = make_world(keyframes=16, points=200, radius_m=None)
    fixes = fixes_along(world, 3, np.zeros(3))
    first, along = world.centres[0], world.centres[-1] - world.centres[0]
    turn = so3_exp(np.radians(6.0) * along / np.linalg.norm(along))
    rolled = Sim3(1.0, turn, first - turn @ first)
    start = replace(
        world,
        poses=[rolled.transform_pose(pose) for pose in world.poses],
        points=rolled.transform(world.points),
    )
    free = adjust_globally(problem_of(world, fixes, start))
    level = adjust_globally(problem_of(world, fixes, start, np.radians(0.5)))
    assert abs(roll_deg(start.poses)) > 5.9
    assert abs(roll_deg(free.poses)) > 2.0  # positions on a line do not see it
    assert abs(roll_deg(level.poses)) < 0.2
    assert errors_deg(level.poses, world).mean() < 0.5


def test_on_a_curved_road_a_banked_camera_stays_banked(make_world):
    """Fixes along a bend fix the roll; the prior's half degree must not flatten a camera mounted at two."""
    world = make_world(keyframes=24, points=500, step_m=2.5, radius_m=20.0, roll_rad=np.radians(2.0))
    truth_deg = roll_deg(world.poses)
    assert abs(truth_deg) == pytest.approx(2.0, abs=0.05)
    optimum = adjust_globally(
        problem_of(world, fixes_along(world, 2, np.zeros(3)), drifted(world), np.radians(0.5))
    )
    assert roll_deg(optimum.poses) == pytest.approx(truth_deg, abs=0.4)


def test_the_level_prior_weighs_as_one_however_many_keyframes_there_are(make_world):
    """Its cost for a drive tilted by one sigma is one half, short or long."""
    for keyframes in (6, 24):
        world = make_world(keyframes=keyframes, points=60, radius_m=None, noise=0.0, roll_rad=np.radians(0.5))
        problem = problem_of(world, [], level_sigma_rad=np.radians(0.5))
        assert adjust_globally(problem, max_iterations=0).initial_cost == pytest.approx(0.5, rel=1e-3)


# --- the form in print


def printed_form(problem: GlobalProblem, map_from_vis: Sim3) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """min over S, {T_i}, {X_j}: poses and points in the free-scale frame ``vis``, S to the map."""
    camera, vis_from_map = problem.camera, map_from_vis.inverse()
    calibration = gtsam.Cal3_S2(camera.fx_px, camera.fy_px, 0.0, camera.cx_px, camera.cy_px)
    robust = gtsam.noiseModel.mEstimator.Huber.Create
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, pose in enumerate(problem.poses):
        in_vis = vis_from_map.transform_pose(pose)
        values.insert(X(i), gtsam.Pose3(gtsam.Rot3(in_vis.rotation), in_vis.translation_m))
    for j, point in enumerate(vis_from_map.transform(problem.points_m)):
        values.insert(L(j), point)
    values.insert(  # GTSAM's Similarity3 is x -> s (R x + t)
        S(0),
        gtsam.Similarity3(
            gtsam.Rot3(map_from_vis.rotation), map_from_vis.translation_m / map_from_vis.scale, map_from_vis.scale
        ),
    )
    for i, j, pixel, sigma in zip(
        problem.keyframe_index.tolist(),
        problem.point_index.tolist(),
        problem.pixels,
        problem.sigmas_px.tolist(),
        strict=True,
    ):
        noise = gtsam.noiseModel.Robust.Create(robust(HUBER_PX), gtsam.noiseModel.Isotropic.Sigma(2, sigma))
        graph.push_back(gtsam.GenericProjectionFactorCal3_S2(pixel, noise, X(i), L(j), calibration, False, False))
    for fix in problem.fixes:
        covariance = gtsam.noiseModel.Gaussian.Covariance(fix.covariance_m2)
        noise = gtsam.noiseModel.Robust.Create(robust(HUBER_SIGMAS), covariance)
        graph.push_back(
            gtsam.CustomFactor(noise, [S(0), X(fix.keyframe)], partial(_s_of_trans_minus_u, fix.position_m))
        )
    return graph, values


def _s_of_trans_minus_u(
    u: np.ndarray, factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[np.ndarray] | None
) -> np.ndarray:
    """S o trans(T) - u. Tangents as GTSAM has them: S exp([w, v, l]) and T exp([w, v]), rotation first."""
    similarity, pose = values.atSimilarity3(factor.keys()[0]), values.atPose3(factor.keys()[1])
    t, s, R = pose.translation(), similarity.scale(), similarity.rotation().matrix()
    if jacobians is not None:
        cross = np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])
        jacobians[0] = s * R @ np.hstack([-cross, np.eye(3), t[:, None]])
        jacobians[1] = s * R @ np.hstack([np.zeros((3, 3)), pose.rotation().matrix()])
    return np.asarray(similarity.transformFrom(t) - u)


def fix_gauge_at_two_cameras(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, last: int) -> None:
    """Seven degrees: the first camera's pose, and how far the last one is from it."""
    graph.push_back(gtsam.NonlinearEqualityPose3(X(0), values.atPose3(X(0))))
    origin = values.atPose3(X(0)).translation()
    wanted = float(np.linalg.norm(values.atPose3(X(last)).translation() - origin))

    def distance(
        factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[np.ndarray] | None
    ) -> np.ndarray:
        pose = values.atPose3(factor.keys()[0])
        away = pose.translation() - origin
        if jacobians is not None:
            unit = away / np.linalg.norm(away)
            jacobians[0] = np.hstack([np.zeros(3), unit @ pose.rotation().matrix()])[None]
        return np.array([np.linalg.norm(away) - wanted])

    graph.push_back(gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, 1e-4), [X(last)], distance))


def fix_gauge_at_s(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, _last: int) -> None:
    graph.push_back(gtsam.NonlinearEqualitySimilarity3(S(0), values.atSimilarity3(S(0))))


def optimize(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(300)
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


def adjust_to_the_end(problem: GlobalProblem) -> GlobalOptimum:
    """``adjust_globally`` is content when the cost falls by less than a millionth; here every digit is wanted."""
    for _ in range(6):
        optimum = adjust_globally(problem, max_iterations=100)
        problem = replace(problem, poses=optimum.poses, points_m=optimum.points_m)
    return optimum


@pytest.mark.parametrize("fix_gauge", [fix_gauge_at_two_cameras, fix_gauge_at_s])
def test_the_printed_form_reaches_the_same_cost_and_the_same_map(make_world, fix_gauge):
    world = make_world(keyframes=12, points=150, outliers=0.02)
    fixes = fixes_along(world, 2, np.zeros(3))  # each u_i has been carried to its keyframe: no arm
    fixes[2] = replace(
        fixes[2], position_m=fixes[2].position_m + np.array([0.3, -0.4, 0.2])
    )  # beyond Huber's elbow
    problem = problem_of(world, fixes, drifted(world))
    ours = adjust_to_the_end(problem)

    vis_from_map = Sim3(0.137, so3_exp(np.array([0.9, -1.3, 0.4])), np.array([2.0, 5.0, -1.0]))
    in_vis = vis_from_map.transform(np.array([pose.translation_m for pose in problem.poses]))
    map_from_vis = umeyama_alignment(in_vis[::2], np.array([fix.position_m for fix in fixes]))  # S as it begins
    begun = replace(
        problem,
        poses=[map_from_vis.transform_pose(vis_from_map.transform_pose(pose)) for pose in problem.poses],
        points_m=map_from_vis.transform(vis_from_map.transform(problem.points_m)),
    )
    graph, values = printed_form(begun, map_from_vis)
    printed = printed_form(begun, map_from_vis)[0]
    last = len(world.poses) - 1
    fix_gauge(graph, values, last)
    result = optimize(graph, values)

    assert printed.error(result) == pytest.approx(ours.cost, rel=1e-6)
    assert printed.error(values) > 1.2 * ours.cost
    similarity = result.atSimilarity3(S(0))
    placed = [similarity.transformFrom(result.atPose3(X(i)).translation()) for i in range(last + 1)]
    np.testing.assert_allclose(placed, [pose.translation_m for pose in ours.poses], atol=1e-3)
    turned = np.array(
        [
            similarity.rotation().matrix() @ result.atPose3(X(i)).rotation().matrix() @ pose.rotation.T
            for i, pose in enumerate(ours.poses)
        ]
    )
    assert np.degrees(rotation_angle_rad(turned)).max() < 0.01
    points = [similarity.transformFrom(result.atPoint3(L(j))) for j in range(len(ours.points_m))]
    assert np.median(np.linalg.norm(points - ours.points_m, axis=1)) < 1e-3


def test_the_printed_form_is_free_by_seven_degrees_and_no_more(make_world):
    """The Hessian of the printed form at its optimum has seven zero directions; with the gauge fixed, none."""
    world = make_world(keyframes=6, points=40)
    ours = adjust_to_the_end(problem_of(world, fixes_along(world, 1, np.zeros(3))))
    problem = problem_of(world, fixes_along(world, 1, np.zeros(3)))
    at_optimum = replace(problem, poses=ours.poses, points_m=ours.points_m)
    map_from_vis = Sim3(2.0, so3_exp(np.array([0.3, 0.1, -0.2])), np.array([1.0, -2.0, 0.5]))
    graph, values = printed_form(at_optimum, map_from_vis)
    assert zero_directions(graph, values) == 7
    fix_gauge_at_two_cameras(graph, values, len(world.poses) - 1)
    assert zero_directions(graph, values) == 0


def zero_directions(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> int:
    jacobian, _ = graph.linearize(values).jacobian()
    columns = jacobian / np.linalg.norm(jacobian, axis=0)
    singular = np.linalg.svd(columns, compute_uv=False)
    return int(columns.shape[1] - np.count_nonzero(singular > 1e-9 * singular[0]))
