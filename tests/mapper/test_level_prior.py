"""A level camera holds what the fixes leave free, and nothing of what they determine: banked roads stay banked."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Pose, so3_exp
from fleetmap_mapper.georeferencing import GnssTrack
from fleetmap_mapper.level_prior import LevelPrior, add_level_prior, missing_level

LEVEL_RAD = np.radians(0.5)
SIGMA_M = 0.05


def road(turns: tuple[tuple[float, float, float], ...], bank_deg: float, hills_m: float = 0.0) -> list[Pose]:
    """A pose every 5 m along 300 m: turns begin at (m), have a radius (m) and an angle (deg)."""
    way = np.arange(0.0, 300.0, 1.0)
    curvature = np.zeros(len(way))
    for at, radius, angle in turns:
        curvature[(way >= at) & (way < at + abs(np.radians(angle)) * radius)] = np.sign(angle) / radius
    heading = 0.4 + np.cumsum(curvature)
    height = hills_m * np.sin(2.0 * np.pi * way / 150.0)
    positions = np.stack([np.cumsum(np.cos(heading)), np.cumsum(np.sin(heading)), height], axis=1)
    poses = []
    for k in range(0, len(way), 5):
        cos, sin = np.cos(heading[k]), np.sin(heading[k])
        level = np.array([[sin, 0.0, cos], [-cos, 0.0, sin], [0.0, -1.0, 0.0]])
        slope = np.arctan(np.gradient(height)[k])
        turn = so3_exp(np.array([slope, 0.0, 0.0])) @ so3_exp(np.array([0.0, 0.0, np.radians(bank_deg)]))
        poses.append(Pose(level @ turn, positions[k]))
    return poses


def prior_of(poses: list[Pose], every: int = 2, about_axis_deg: float = 0.0) -> LevelPrior:
    """Of a road with an RTK fix at every second pose; the map may lie turned about the road's first direction."""
    rng = np.random.default_rng(2)
    nodes = np.arange(0, len(poses), every)
    positions = np.array([poses[k].translation_m for k in nodes])
    axis = poses[0].rotation[:, 2] * np.radians(about_axis_deg)
    turn = so3_exp(axis)
    turned = [Pose(turn @ p.rotation, turn @ p.translation_m) for p in poses]
    fixes = GnssTrack(
        UtmAnchor(32632, 0, 0, 0),
        np.arange(len(nodes), dtype=np.int64),
        positions + rng.normal(0.0, SIGMA_M, positions.shape),
        np.tile(np.eye(3) * SIGMA_M**2, (len(nodes), 1, 1)),
        np.zeros(3),
    )
    return missing_level(turned, nodes, fixes, LEVEL_RAD)


S_CURVE = ((60.0, 80.0, 25.0), (180.0, 80.0, -25.0))
CORNERS = ((60.0, 20.0, 90.0), (180.0, 20.0, -90.0))


def test_on_a_straight_road_the_prior_has_its_whole_weight():
    prior = prior_of(road((), 0.0))
    assert prior.sigma_rad == pytest.approx(LEVEL_RAD, rel=0.02)
    assert np.degrees(prior.tilt_by_fixes_sigma_rad) > 20.0


@pytest.mark.parametrize("bank_deg", [-5.0, 0.0, 5.0])
def test_where_corners_show_the_roll_the_prior_is_silent_or_weak(bank_deg):
    prior = prior_of(road(CORNERS, bank_deg))
    assert prior.sigma_rad > 1.5 * LEVEL_RAD
    assert 0.1 < np.degrees(prior.tilt_by_fixes_sigma_rad) < 0.8
    assert np.degrees(prior.tilt_by_fixes_rad) == pytest.approx(-bank_deg, abs=1.0)


@pytest.mark.parametrize("turns", [S_CURVE, CORNERS])
@pytest.mark.parametrize("hills_m", [0.0, 4.0])
def test_a_banked_or_hilly_road_is_not_flattened_where_the_fixes_contradict(turns, hills_m):
    """Five degrees over the whole drive: the fixes of a gentle S tell them to a degree, which is clear enough."""
    prior = prior_of(road(turns, 5.0, hills_m))
    assert prior.sigma_rad == np.inf
    level = prior_of(road(turns, 0.0, hills_m))
    assert abs(level.tilt_by_fixes_rad) < 3.0 * level.tilt_by_fixes_sigma_rad + LEVEL_RAD


def test_a_map_that_lies_tilted_is_told_from_a_road_that_is_banked():
    """The fixes see that the map is turned about the road, and the camera is level."""
    prior = prior_of(road(CORNERS, 0.0), about_axis_deg=4.0)
    assert abs(np.degrees(prior.tilt_by_fixes_rad)) < 3.0 * np.degrees(prior.tilt_by_fixes_sigma_rad)


def test_more_bends_leave_less_to_the_prior():
    sigmas = [prior_of(road(turns, 0.0)).tilt_by_fixes_sigma_rad for turns in ((), S_CURVE[:1], S_CURVE, CORNERS)]
    assert sigmas == sorted(sigmas, reverse=True)


def test_without_fixes_the_prior_stands_alone():
    prior = prior_of(road((), 2.0), every=10**6)
    assert prior.sigma_rad == pytest.approx(LEVEL_RAD, rel=0.02)


# --- in the graph


def graph_of(poses: list[Pose], sigma_rad: float) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    add_level_prior(graph, poses, sigma_rad)
    for i, pose in enumerate(poses):
        values.insert(X(i), gtsam.Pose3(gtsam.Rot3(pose.rotation), pose.translation_m))
    return graph, values


def test_the_mean_tilt_costs_as_one_observation_and_relief_costs_nothing():
    tilts_deg = 6.0 * np.sin(np.arange(40) * 2.0 * np.pi / 40.0)  # a road that leans to and fro, level on average
    straight = road((), 0.0)[0].rotation
    leaning = [Pose(straight @ so3_exp(np.array([0.0, 0.0, a])), np.zeros(3)) for a in np.radians(tilts_deg)]
    graph, values = graph_of(leaning, LEVEL_RAD)
    assert graph.error(values) == pytest.approx(0.0, abs=1e-6)
    banked = [Pose(straight @ so3_exp(np.array([0.0, 0.0, a])), np.zeros(3)) for a in np.radians(tilts_deg + 0.5)]
    graph, values = graph_of(banked, LEVEL_RAD)
    assert graph.error(values) == pytest.approx(0.5, rel=0.02)  # one sigma, over forty poses


def test_its_derivative_is_right():
    poses = [Pose(p.rotation @ so3_exp(np.array([0.1, -0.2, 0.05])), p.translation_m) for p in road(CORNERS, 3.0)]
    graph, values = graph_of(poses[:4], LEVEL_RAD)
    for k in range(graph.size()):
        analytic = graph.at(k).linearize(values).jacobian()[0]
        step = 1e-6
        for axis in range(3):
            delta = np.zeros(6)
            delta[axis] = step
            pose = values.atPose3(X(k))
            ahead, behind = gtsam.Values(values), gtsam.Values(values)
            ahead.update(X(k), pose.retract(delta))
            behind.update(X(k), pose.retract(-delta))
            errors = [graph.at(k).linearize(v).jacobian()[1] for v in (ahead, behind)]
            numeric = -(errors[0] - errors[1]) / (2.0 * step)
            np.testing.assert_allclose(analytic[:, axis], numeric, atol=1e-4)


def test_a_prior_without_weight_adds_nothing():
    assert graph_of(road((), 1.0), np.inf)[0].size() == 0
