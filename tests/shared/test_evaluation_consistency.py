"""Covariances that promise what the errors keep, and others."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from fleetmap.covariances import PoseCovariances
from fleetmap.errors import InputError, TrajectoryError
from fleetmap.evaluation import (
    Consistency,
    Nees,
    TrajectoryErrors,
    evaluate_against_map,
    evaluate_consistency,
    evaluate_trajectory,
    judge,
    normalised_estimation_error_squared,
)
from fleetmap.geometry import so3_exp
from fleetmap.trajectory import Trajectory

START_NS = 1_700_000_000_000_000_000
CORNER_M = np.array([455_300.0, 5_425_500.0, 120.0])
COUNT = 4000


def truth() -> Trajectory:
    t = np.arange(COUNT) / 10.0
    stamps_ns = START_NS + np.arange(COUNT, dtype=np.int64) * 100_000_000
    positions_m = CORNER_M + np.stack([8.0 * t, 15.0 * np.sin(t / 3.0), 0.4 * np.cos(t / 2.0)], axis=1)
    headings = np.stack([np.full(COUNT, 0.3), np.zeros(COUNT), np.cos(t / 3.0)], axis=1)
    return Trajectory(32632, stamps_ns, positions_m, so3_exp(headings))


def claimed(seed: int = 0) -> PoseCovariances:
    """A covariance of its own for every pose: small turns, centimetres, one axis far worse, all correlated."""
    rng = np.random.default_rng(seed)
    mixing = np.eye(6) + 0.1 * rng.normal(size=(COUNT, 6, 6))
    roots = np.array([0.002, 0.003, 0.001, 0.02, 0.01, 0.15])[:, None] * mixing
    return PoseCovariances(truth().stamps_ns, roots @ roots.transpose(0, 2, 1))


def estimate(covariances: PoseCovariances, seed: int = 1) -> Trajectory:
    """Poses of which truth = estimate @ exp(xi), with xi drawn from the covariances."""
    true = truth()
    drawn = np.random.default_rng(seed).normal(size=(COUNT, 6, 1))
    xi = (np.linalg.cholesky(covariances.matrices) @ drawn)[..., 0]
    rotations = true.rotations @ so3_exp(-xi[:, :3])
    positions_m = true.positions_m - (rotations @ xi[:, 3:, None])[..., 0]
    return Trajectory(true.epsg, true.stamps_ns, positions_m, rotations)


def consistency_of(errors: TrajectoryErrors, covariances: PoseCovariances) -> Consistency:
    consistency = evaluate_consistency(errors, covariances)
    assert consistency is not None
    return consistency


def assert_consistent(consistency: Consistency) -> None:
    for nees, dof in ((consistency.pose, 6), (consistency.position, 3)):
        assert nees.dof == dof
        low, high = nees.band_95
        assert dof - 0.25 < low < nees.mean < high < dof + 0.25
        assert 0.94 < nees.inside_95 < 0.96


def test_errors_of_the_claimed_size_are_consistent() -> None:
    consistency = consistency_of(evaluate_trajectory(estimate(claimed()), truth()), claimed())
    assert len(consistency.rows) == COUNT
    assert_consistent(consistency)


def test_a_covariance_four_times_too_small_is_found_out() -> None:
    promised = PoseCovariances(claimed().stamps_ns, claimed().matrices / 4.0)
    errors = evaluate_trajectory(estimate(claimed()), truth())
    honest, boasting = consistency_of(errors, claimed()), consistency_of(errors, promised)
    assert boasting.pose.mean == pytest.approx(4.0 * honest.pose.mean, rel=1e-9)
    assert 23.0 < boasting.pose.mean < 25.0
    assert 11.5 < boasting.position.mean < 12.5
    assert boasting.pose.inside_95 < 0.5
    assert boasting.pose.mean > boasting.pose.band_95[1]


def test_a_covariance_of_other_axes_is_found_out() -> None:
    swapped = claimed().matrices[:, [3, 4, 5, 0, 1, 2]][:, :, [3, 4, 5, 0, 1, 2]]
    errors = evaluate_trajectory(estimate(claimed()), truth())
    assert consistency_of(errors, PoseCovariances(claimed().stamps_ns, swapped)).pose.mean > 20.0


@pytest.mark.parametrize(("align", "scale"), [("se3", 1.0), ("sim3", 0.25)])
def test_an_alignment_moves_the_claims_with_the_poses(align: str, scale: float) -> None:
    given = estimate(claimed())
    turn, units = so3_exp(np.array([0.2, -0.5, 1.4])), np.array([1.0, 1.0, 1.0, scale, scale, scale])
    moved = Trajectory(
        32632, given.stamps_ns, scale * (given.positions_m - CORNER_M) @ turn.T, turn @ given.rotations
    )
    claims = PoseCovariances(claimed().stamps_ns, claimed().matrices * np.outer(units, units))
    errors = evaluate_trajectory(moved, truth(), align=align)  # type: ignore[arg-type]
    assert_consistent(consistency_of(errors, claims))


def test_relative_to_a_map_the_mounting_between_the_cameras_is_no_error() -> None:
    query, mounting, offset_m = (
        estimate(claimed()),
        so3_exp(np.array([0.05, -0.2, 0.1])),
        np.array([0.5, 0.0, 0.1]),
    )
    seen = truth()
    survey_rotations = seen.rotations @ mounting.T
    survey = Trajectory(32632, seen.stamps_ns, seen.positions_m - survey_rotations @ offset_m, survey_rotations)
    errors = evaluate_against_map(query, survey, offset_m)
    assert_consistent(consistency_of(errors, claimed()))


def test_covariances_find_their_poses_by_stamps_that_lost_their_nanoseconds() -> None:
    exact = truth()
    rounded = Trajectory(32632, exact.stamps_ns + 499, exact.positions_m, exact.rotations)
    every_third = PoseCovariances(claimed().stamps_ns[::3], claimed().matrices[::3])
    consistency = consistency_of(evaluate_trajectory(rounded, exact), every_third)
    np.testing.assert_array_equal(consistency.rows, np.arange(0, COUNT, 3))


def test_covariances_of_another_drive_are_refused() -> None:
    other = PoseCovariances(claimed().stamps_ns + 50_000_000, claimed().matrices)
    with pytest.raises(TrajectoryError, match=f"none of {COUNT} covariances"):
        evaluate_consistency(evaluate_trajectory(truth(), truth()), other)


def test_a_covariance_that_is_none_is_refused() -> None:
    with pytest.raises(InputError, match="positive definite"):
        normalised_estimation_error_squared(np.ones((1, 2)), np.array([[[1.0, 2.0], [2.0, 1.0]]]))


def test_nees_is_the_squared_length_in_sigmas() -> None:
    errors = np.array([[3.0, 0.0], [3.0, 4.0]])
    covariances = np.array([np.diag([9.0, 1.0]), np.diag([1.0, 16.0])])
    np.testing.assert_allclose(normalised_estimation_error_squared(errors, covariances), [1.0, 10.0])


def test_the_band_is_chi_squares() -> None:
    nees = Nees(np.array([1.0, 6.0, 14.0, 12.0]), dof=6)
    expected = chi2.ppf([0.025, 0.975], 24) / 4
    np.testing.assert_allclose(nees.band_95, expected, rtol=1e-12)
    assert nees.inside_95 == 0.75  # chi-square's 95 % quantile with 6 degrees of freedom is 12.59


def test_a_judgement_tells_the_nees_and_its_interval() -> None:
    figures = judge(evaluate_trajectory(estimate(claimed()), truth()), covariances=claimed()).to_json()
    assert figures["nees"]["count"] == COUNT
    for name, dof in (("pose", 6), ("position", 3)):
        assert figures["nees"][name]["dof"] == dof
        low, high = figures["intervals"]["nees"][f"{name}_mean"]
        assert low < figures["nees"][name]["mean"] < high
        assert low < dof < high
        assert high - low < 0.6
