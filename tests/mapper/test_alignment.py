"""Light alignment while mapping: keyframes are carried towards the fixes, evenly, and never without fixes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Pose, umeyama_alignment
from fleetmap.vision.features import Features
from fleetmap_mapper.alignment import GnssAligner, smooth_corrections
from fleetmap_mapper.georeferencing import HUBER_SIGMAS, GnssTrack
from fleetmap_mapper.growing_map import GrowingMap
from fleetmap_mapper.settings import GnssGroup, MapperSettings, MappingGroup
from fleetmap_mapper.slam import PosedFrame

KEYFRAMES, STEP_M = 60, 1.5
DRIFT_PER_M = 0.01  # the visual drift that the alignment reckons with


@pytest.fixture
def positions() -> np.ndarray:
    angle = np.linspace(0.0, 1.5, KEYFRAMES)
    radius = STEP_M * KEYFRAMES / 1.5
    return radius * np.stack([np.cos(angle), np.sin(angle), 0.1 * angle], axis=1)


def covariances(count: int, sigma_m: float = 0.05) -> np.ndarray:
    return np.tile(np.diag([1.0, 1.0, 4.0]) * sigma_m**2, (count, 1, 1))


def dense_solution(positions: np.ndarray, at: np.ndarray, residuals: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """The same sum of squares, stacked and handed to lstsq."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    solution = np.zeros_like(positions)
    for axis in range(3):
        differences = np.diff(np.eye(len(positions)), axis=0) / (DRIFT_PER_M * steps)[:, None]
        root = 1.0 / np.sqrt(cov[:, axis, axis])
        fixes = np.eye(len(positions))[at] * root[:, None]
        right = np.concatenate([np.zeros(len(steps)), root * residuals[:, axis]])
        solution[:, axis] = np.linalg.lstsq(np.vstack([differences, fixes]), right, rcond=None)[0]
    return solution


def test_it_is_the_least_squares_solution(positions):
    rng = np.random.default_rng(0)
    at = np.sort(rng.choice(KEYFRAMES, 20))  # some keyframes have two fixes
    residuals = rng.normal(0.0, 0.02, (20, 3)) + np.array([0.03, -0.02, 0.01])  # all within Huber's elbow
    cov = covariances(20)
    np.testing.assert_allclose(
        smooth_corrections(positions, at, residuals, cov), dense_solution(positions, at, residuals, cov), atol=1e-9
    )


def test_with_outliers_it_nears_the_least_of_hubers_sum(positions):
    rng = np.random.default_rng(1)
    at = np.arange(0, KEYFRAMES, 4)
    residuals = rng.normal(0.0, 0.04, (len(at), 3))
    residuals[5] += [1.0, -2.0, 0.5]
    cov = covariances(len(at))
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)

    def robust_cost(flat: np.ndarray) -> float:
        corrections = flat.reshape(-1, 3)
        smooth = (np.diff(corrections, axis=0) ** 2).sum(axis=1) @ (1.0 / (DRIFT_PER_M * steps) ** 2)
        errors = np.sqrt(((residuals - corrections[at]) ** 2 / np.diagonal(cov, axis1=1, axis2=2)).sum(axis=1))
        rho = np.where(errors < HUBER_SIGMAS, errors**2, HUBER_SIGMAS * (2 * errors - HUBER_SIGMAS))
        return float(smooth + rho.sum())

    ours = smooth_corrections(positions, at, residuals, cov)
    least = minimize(robust_cost, ours.ravel(), method="L-BFGS-B", options={"maxiter": 3000, "maxfun": 10**6})
    assert robust_cost(ours) == pytest.approx(least.fun, rel=0.02)


def test_drift_is_removed_also_between_the_fixes(positions):
    """One per cent of the way, sideways: what odometry loses; a fix every eighth keyframe."""
    drift = np.linspace(0.0, DRIFT_PER_M * STEP_M * KEYFRAMES, KEYFRAMES)[:, None] * np.array([0.6, -0.8, 0.2])
    at = np.arange(0, KEYFRAMES, 8)
    noise = np.random.default_rng(2).normal(0.0, 0.05, (len(at), 3))
    moved = smooth_corrections(positions + drift, at, -drift[at] + noise, covariances(len(at)))
    before = np.linalg.norm(drift, axis=1)
    after = np.linalg.norm(drift + moved, axis=1)
    assert before.mean() > 0.4
    assert 0.005 < after.mean() < 0.1
    assert after.max() < 0.25


def test_white_noise_of_single_fixes_does_not_shake_the_map(positions):
    noise = np.random.default_rng(3).normal(0.0, 0.05, (KEYFRAMES, 3))
    moved = smooth_corrections(positions, np.arange(KEYFRAMES), noise, covariances(KEYFRAMES))
    assert 0.0 < np.diff(moved, axis=0).std() < 0.3 * np.diff(noise, axis=0).std()


def test_one_fix_that_is_far_off_moves_little(positions):
    at = np.arange(0, KEYFRAMES, 4)
    residuals = np.zeros((len(at), 3))
    residuals[7] = [30.0, 0.0, 0.0]
    moved = smooth_corrections(positions, at, residuals, covariances(len(at)))
    assert 0.0 < np.linalg.norm(moved, axis=1).max() < 0.3


def test_a_keyframe_without_fixes_follows_its_neighbours(positions):
    moved = smooth_corrections(positions, np.array([10]), np.array([[1.0, 2.0, 3.0]]), covariances(1))
    np.testing.assert_allclose(moved, np.tile([1.0, 2.0, 3.0], (KEYFRAMES, 1)), rtol=1e-6)


def test_a_car_that_stands_does_not_break_the_system(positions):
    standing = positions.copy()
    standing[20:30] = standing[20]
    at = np.arange(0, KEYFRAMES, 5)
    moved = smooth_corrections(standing, at, np.full((len(at), 3), 0.2), covariances(len(at)))
    np.testing.assert_allclose(moved, 0.2, atol=1e-6)


# --- after a keyframe of a growing map


@pytest.fixture
def growing_with_path(make_world):
    world = make_world(keyframes=10, points=200, step_m=2.0)
    return world, *growing_along(world)


def growing_along(world):
    """A map whose scale is a fifth of the world's, and its keyframes as posed frames."""
    growing = GrowingMap(world.camera)
    for k, pose in enumerate(world.poses):
        rows = np.flatnonzero(world.keyframe_index == k)
        features = Features(
            world.pixels[rows],
            np.zeros(len(rows), np.uint8),
            np.zeros((len(rows), 32), np.uint8),
            1.2,
        )
        in_vis = Pose(pose.rotation, pose.translation_m / 5.0)
        growing.add_keyframe(k, k * 10**9, in_vis, features, world.point_index[rows])
    count = len(world.points)
    growing.reserve(count)
    growing.landmark_count = count
    growing.points[:count] = world.points / 5.0
    growing.alive[:count] = True
    growing.merged_into[:count] = np.arange(count)
    for k in range(len(world.poses)):
        growing.reference[growing.keyframes[k].landmark_of] = k
    posed = [
        PosedFrame(
            k.frame_index, k.stamp_ns, k, Pose.identity(), np.zeros(0, np.int32), np.zeros((0, 2)), np.zeros(0)
        )
        for k in growing.keyframes
    ]
    return growing, posed


def track_of(positions: np.ndarray, stamps_ns: np.ndarray) -> GnssTrack:
    return GnssTrack(
        UtmAnchor(32632, 0, 0, 0), stamps_ns, positions, covariances(len(positions), 0.01), np.zeros(3)
    )


@pytest.mark.parametrize("fixes", [1, 2])
def test_while_fixes_do_not_determine_s_nothing_moves(growing_with_path, fixes):
    world, growing, posed = growing_with_path
    before = [k.vis_from_cam for k in growing.keyframes], growing.points.copy()
    track = track_of(world.centres[:fixes], np.arange(fixes) * 10**9)
    GnssAligner(track, MapperSettings())(growing, posed)
    assert [k.vis_from_cam for k in growing.keyframes] == before[0]
    np.testing.assert_array_equal(growing.points, before[1])


def test_between_two_alignments_nothing_moves(growing_with_path):
    world, growing, posed = growing_with_path
    growing.keyframes.pop()
    before = [k.vis_from_cam for k in growing.keyframes]
    GnssAligner(track_of(world.centres * 1.1, np.arange(10) * 10**9), MapperSettings())(growing, posed[:9])
    assert [k.vis_from_cam for k in growing.keyframes] == before


def test_every_fifth_keyframe_the_map_is_carried_towards_its_fixes(growing_with_path):
    """The path has drifted up and down by 0.3 m; the fixes know better, and landmarks follow."""
    world, growing, posed = growing_with_path
    bend = 0.3 / 5.0 * np.sin(np.arange(10) * 2.0 * np.pi / 9.0)
    for keyframe, rise in zip(growing.keyframes, bend, strict=True):
        pose = keyframe.vis_from_cam
        keyframe.vis_from_cam = Pose(pose.rotation, pose.translation_m + np.array([0.0, 0.0, rise]))
    growing.points[: growing.landmark_count, 2] += bend[growing.reference[: growing.landmark_count]]

    def misfit_m() -> float:
        centres = np.array([k.vis_from_cam.translation_m for k in growing.keyframes])
        S = umeyama_alignment(centres, world.centres)
        return float(np.linalg.norm(S.transform(centres) - world.centres, axis=1).mean())

    before_m = misfit_m()
    GnssAligner(track_of(world.centres, np.arange(10) * 10**9), MapperSettings())(growing, posed)
    assert before_m > 0.1
    assert 0.0 < misfit_m() < 0.6 * before_m


def test_keyframes_before_the_window_stay_and_the_window_joins_them_smoothly():
    positions = np.stack([np.arange(20.0), np.zeros(20), np.zeros(20)], axis=1)
    residuals = np.array([[0.0, 0.2, 0.0]])
    fix = np.array([19]), residuals, covariances(1, 0.01)
    free, held = (smooth_corrections(positions, *fix, is_start_free=is_free)[:, 1] for is_free in (True, False))
    np.testing.assert_allclose(free, 0.2, atol=1e-6)  # nothing holds it back
    assert 0.0 < held[0] < 0.02
    assert np.all(np.diff(held) > 0.0)
    assert 0.1 < held[-1] < 0.2


def test_only_the_latest_keyframes_and_their_landmarks_move(make_world):
    world = make_world(keyframes=40, points=800, step_m=2.0)
    growing, posed = growing_along(world)
    centres = np.array([k.vis_from_cam.translation_m for k in growing.keyframes])
    points = growing.points.copy()
    bent = world.centres + 0.3 * np.sin(np.arange(40) / 3.0)[:, None] * np.array([0.0, 0.0, 1.0])
    settings = MapperSettings(gnss=GnssGroup(align_window=10), mapping=MappingGroup(window=4))
    GnssAligner(track_of(bent, np.arange(40) * 10**9), settings)(growing, posed)
    moved = np.linalg.norm([k.vis_from_cam.translation_m for k in growing.keyframes] - centres, axis=1)
    assert np.all(moved[:30] == 0.0)
    assert np.all(moved[32:] > 0.0)
    behind = np.setdiff1d(
        growing.landmarks_of(growing.keyframes[:20]), growing.landmarks_of(growing.keyframes[20:])
    )
    assert len(behind) > 20
    np.testing.assert_array_equal(growing.points[behind], points[behind])
