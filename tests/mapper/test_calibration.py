"""A calibration that is wrong on purpose is refined or told with numbers; a right one is left in peace."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap_mapper.calibration_check import (
    CalibrationEstimate,
    calibration_record,
    calibration_remarks,
    estimate_calibration,
    is_contradicted,
)
from fleetmap_mapper.calibration_parameters import calibration_prior
from fleetmap_mapper.calibration_refinement import Refined, refine_calibration, seen_anew
from fleetmap_mapper.fix_terms import FixTerm
from fleetmap_mapper.global_adjustment import GlobalProblem, adjust_globally
from fleetmap_mapper.settings import CalibrationGroup

Array = NDArray[np.float64]
SETTINGS = CalibrationGroup()
BROWN = Camera(960, 600, 600.0, 602.0, 481.0, 297.0, (-0.2, 0.05, 0.001, -0.0005, 0.0))
RATIONAL = replace(
    BROWN, distortion=(0.4, 0.03, 0.0004, -0.0003, 0.001, 0.6, 0.1, 0.01), distortion_model="rational_polynomial"
)
FISHEYE = replace(
    BROWN, fx_px=430.0, fy_px=431.0, distortion=(0.02, -0.004, 0.0, 0.0), distortion_model="equidistant"
)
CAMERAS = pytest.mark.parametrize("recorded", [BROWN, RATIONAL, FISHEYE], ids=lambda c: c.distortion_model)


def off(camera: Camera) -> Camera:
    """Focal length 2 % longer, centre 8 px to the right, the lens bent less."""
    k1, *others = camera.distortion
    return replace(
        camera,
        fx_px=1.02 * camera.fx_px,
        fy_px=1.02 * camera.fy_px,
        cx_px=camera.cx_px + 8.0,
        distortion=(k1 + 0.03, *others),
    )


def driven(
    true: Camera, recorded: Camera, seed: int, *, straight: bool = False, correlated_px: float = 0.0
) -> GlobalProblem:
    """A drive past points, seen by the true camera and adjusted as if by the recorded one.

    Noise of one sigma for each observation, and ``correlated_px`` that all observations of a point share.
    """
    rng = np.random.default_rng(seed)
    keyframes, count = 30, 500
    poses, position, heading = [], np.array([0.0, 0.0, 1.6]), 0.4
    for k in range(keyframes):
        cos, sin = np.cos(heading), np.sin(heading)
        poses.append(Pose(np.array([[sin, 0.0, cos], [-cos, 0.0, sin], [0.0, -1.0, 0.0]]), position))
        position = position + 2.0 * np.array([cos, sin, 0.0])
        heading += 0.0 if straight else (2.0 / 25.0 if k // 10 % 2 == 0 else -2.0 / 25.0)
    low, high = np.array([-15.0, -7.0, 5.0]), np.array([15.0, 1.6, 35.0])
    home = rng.integers(0, keyframes, count)
    cloud = np.array(
        [poses[k].transform(p) for k, p in zip(home, rng.uniform(low, high, (count, 3)), strict=True)]
    )
    shared_px = rng.normal(0.0, 1.0, (count, 2)) * correlated_px
    keyframe_index, point_index, pixels = [], [], []
    for k, pose in enumerate(poses):
        in_cam = pose.inverse().transform(cloud)
        recorded_px = true.project(in_cam)
        seen = np.flatnonzero(true.is_inside(recorded_px) & (in_cam[:, 2] > 2.0) & (in_cam[:, 2] < 45.0))
        keyframe_index.append(np.full(len(seen), k, np.int32))
        point_index.append(seen)
        pixels.append(recorded_px[seen] + shared_px[seen])
    k, p, z = np.concatenate(keyframe_index), np.concatenate(point_index), np.concatenate(pixels)
    often = np.bincount(p, minlength=count)[p] >= 2
    kept, p = np.unique(p[often], return_inverse=True)
    k, z = k[often], z[often]
    sigmas = 1.2 ** rng.integers(0, 5, len(z)).astype(np.float64)
    ideal = recorded.undistort(z + sigmas[:, None] * rng.normal(0.0, 1.0, z.shape))
    covariance, arm = np.diag([1.0, 1.0, 2.0]) * 0.05**2, np.array([0.3, -1.2, -0.8])
    fixes = [
        FixTerm(i, arm, poses[i].transform(arm) + rng.multivariate_normal(np.zeros(3), covariance), covariance)
        for i in range(0, keyframes, 3)
    ]
    start = GlobalProblem(
        recorded,
        poses,
        cloud[kept],
        k,
        p.astype(np.int32),
        ideal,
        sigmas * recorded.magnification(ideal),
        fixes,
        np.radians(0.5),
    )
    optimum = adjust_globally(start)
    return replace(start, poses=optimum.poses, points_m=optimum.points_m)


def checked(problem: GlobalProblem) -> CalibrationEstimate:
    estimate = estimate_calibration(problem, SETTINGS, problem.camera)
    assert estimate is not None
    return estimate


def refined(problem: GlobalProblem, recorded: Camera) -> Refined:
    return refine_calibration(problem, calibration_prior(recorded, SETTINGS))


def largest_shift_px(a: Camera, b: Camera, reach: float = 0.7) -> float:
    """Between the recorded pixels of two calibrations, within ``reach`` of the half image."""
    x, y = np.meshgrid(np.linspace(-reach, reach, 9), np.linspace(-reach, reach, 9))
    pixels = np.stack([a.cx_px + x.ravel() * 480.0, a.cy_px + y.ravel() * 300.0], axis=1)
    rays = a.unproject(pixels)
    return float(np.linalg.norm(b.project(rays) - pixels, axis=1).max())


@CAMERAS
def test_a_wrong_calibration_is_refined(recorded):
    true = off(recorded)
    problem = driven(true, recorded, seed=1)
    result = refined(problem, recorded)
    camera = result.problem.camera
    assert result.cost < result.initial_cost
    assert camera.fx_px / true.fx_px == pytest.approx(1.0, abs=0.008)
    assert camera.fx_px / recorded.fx_px == pytest.approx(1.02, abs=0.008)
    assert camera.fx_px / camera.fy_px == pytest.approx(recorded.fx_px / recorded.fy_px, abs=0.003)
    assert camera.cx_px - recorded.cx_px == pytest.approx(8.0, abs=5.0)
    assert camera.cy_px - recorded.cy_px == pytest.approx(0.0, abs=5.0)
    assert largest_shift_px(true, recorded) > 10.0
    assert largest_shift_px(true, camera) < 6.0


@CAMERAS
def test_refining_ends_in_the_joint_optimum_wherever_it_starts(recorded):
    true = off(recorded)
    here = driven(true, recorded, seed=2)
    pixels = seen_anew(here.pixels, recorded, true)
    there = replace(
        here,
        camera=true,
        pixels=pixels,
        sigmas_px=here.sigmas_px * true.magnification(pixels) / recorded.magnification(here.pixels),
    )
    a, b = refined(here, recorded), refined(there, recorded)
    assert a.cost == pytest.approx(b.cost, rel=1e-5)
    assert largest_shift_px(a.problem.camera, b.problem.camera) < 0.2
    again = refined(a.problem, recorded)
    assert again.cost == pytest.approx(a.cost, rel=1e-5)


def test_on_a_straight_road_what_the_drive_does_not_determine_stays_where_it_was():
    camera = refined(driven(BROWN, BROWN, seed=3, straight=True), BROWN).problem.camera
    prior_px = SETTINGS.focal_sigma_ratio * BROWN.fx_px
    assert abs(camera.fx_px - BROWN.fx_px) < prior_px
    estimate = checked(driven(BROWN, BROWN, seed=3, straight=True))
    assert 0.7 * prior_px < estimate.focal_sigma_px < 1.2 * prior_px


def test_a_calibration_that_is_held_stays_to_the_last_bit_while_poses_and_points_move():
    problem = driven(off(BROWN), BROWN, seed=4)
    shifted = replace(problem, points_m=problem.points_m + np.random.default_rng(0).normal(0.0, 0.1, (1, 3)))
    result = refine_calibration(shifted, replace(calibration_prior(BROWN, SETTINGS), is_held=True))
    assert result.problem.camera == BROWN
    assert np.array_equal(result.problem.pixels, problem.pixels)
    assert result.cost < 0.9 * result.initial_cost


def test_the_refined_pixels_are_the_recorded_ones_undistorted_anew():
    problem = driven(off(BROWN), BROWN, seed=4)
    result = refined(problem, BROWN).problem
    recorded_before = BROWN.distort(problem.pixels)
    assert np.abs(result.camera.distort(result.pixels) - recorded_before).max() < 1e-6
    assert np.abs(seen_anew(result.pixels, result.camera, BROWN) - problem.pixels).max() < 1e-6


@CAMERAS
def test_a_wrong_calibration_is_told_with_numbers(recorded):
    true = off(recorded)
    estimate = checked(driven(true, recorded, seed=5))
    mean_px = float(np.sqrt(true.fx_px * true.fy_px))
    fitted_px = float(np.sqrt(estimate.fitted.fx_px * estimate.fitted.fy_px))
    assert abs(fitted_px - mean_px) < 4.0 * estimate.focal_sigma_px
    assert 0.0005 * mean_px < estimate.focal_sigma_px < 0.01 * mean_px
    remarks = calibration_remarks(estimate, recorded, SETTINGS)
    assert remarks
    assert all(line.endswith("recalibrate, or map with --refine-calibration") for line in remarks)
    assert all(
        "the drive's own calibration; recalibrate" in r for r in calibration_remarks(estimate, true, SETTINGS)
    )
    assert is_contradicted(estimate, SETTINGS)
    if recorded is BROWN:
        assert remarks[0].startswith(
            f"the recorded focal length 601.0 px disagrees with the drive: {fitted_px:.1f} +- "
            f"{estimate.focal_sigma_px:.1f} px fits"
        )


def test_what_few_stretches_of_road_agree_on_is_less_clear_than_its_sigmas():
    estimate = checked(driven(off(BROWN), BROWN, seed=5))
    for part in (estimate.focal, estimate.centre, estimate.lens):
        assert 0.4 * part.sigmas < part.normal_sigmas < part.sigmas
    assert estimate.focal.sigmas > SETTINGS.adopt_sigmas > estimate.focal.normal_sigmas


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("correlated_px", [0.0, 1.0], ids=["white noise", "noise along tracks"])
def test_a_right_calibration_is_left_in_peace(seed, correlated_px):
    estimate = checked(driven(BROWN, BROWN, seed=10 + seed, correlated_px=correlated_px))
    assert calibration_remarks(estimate, BROWN, SETTINGS) == []
    assert not is_contradicted(estimate, SETTINGS)
    assert abs(estimate.fitted.fx_px - BROWN.fx_px) < 4.0 * estimate.focal_sigma_px


@pytest.mark.parametrize("seed", range(3))
def test_on_a_straight_road_a_wrong_focal_length_cannot_be_told(seed):
    longer = replace(BROWN, fx_px=1.02 * BROWN.fx_px, fy_px=1.02 * BROWN.fy_px)
    estimate = checked(driven(longer, BROWN, seed=20 + seed, straight=True))
    assert not any("focal length" in line for line in calibration_remarks(estimate, BROWN, SETTINGS))


def test_the_sigmas_told_are_those_of_the_spread_over_many_drives():
    estimates = [checked(driven(BROWN, BROWN, seed=100 + seed)) for seed in range(8)]
    misses = [(e.fitted.fx_px - BROWN.fx_px) / e.focal_sigma_px for e in estimates]
    assert 0.4 < float(np.sqrt(np.mean(np.square(misses)))) < 1.6


def test_once_refined_nothing_is_remarked_and_the_record_tells_before_and_after():
    settings = CalibrationGroup(mode="refined")
    estimate = checked(driven(off(BROWN), BROWN, seed=6))
    assert calibration_remarks(estimate, off(BROWN), settings) == []
    record = calibration_record(estimate, off(BROWN))
    assert record is not None
    assert record.refined
    assert (record.recorded.to_camera(), record.fitted.to_camera()) == (BROWN, off(BROWN))
    untouched = calibration_record(estimate, BROWN)
    assert untouched is not None
    assert not untouched.refined
    assert untouched.fitted.to_camera() == estimate.fitted
    assert calibration_record(None, BROWN) is None
