from __future__ import annotations

import copy
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics, sync, trajectory
from hypothesis import given, settings
from hypothesis import strategies as st

from fleetmap.errors import TrajectoryError
from fleetmap.evaluation import (
    Alignment,
    ErrorStatistics,
    associate,
    evaluate_against_map,
    evaluate_trajectory,
    interpolate_trajectory,
)
from fleetmap.geometry import (
    Pose,
    interpolate_pose,
    quat_xyzw_from_rotations,
    rotations_from_quat_xyzw,
    so3_exp,
    so3_log,
)
from fleetmap.trajectory import Trajectory

START_NS = 1_700_000_000_000_000_000
CORNER_M = np.array([455_300.0, 5_425_500.0, 120.0])
EVO_ROWS = ("max", "mean", "median", "min", "rmse", "sse", "std")


def winding_drive(count: int = 120, interval_ns: int = 100_000_000) -> Trajectory:
    """A camera along an S-shaped road, looking forward, in UTM."""
    t = np.arange(count) * interval_ns / 1e9
    positions_m = np.stack([8.0 * t, 15.0 * np.sin(t / 3.0), 0.4 * np.cos(t / 2.0)], axis=1)
    headings = np.stack([np.zeros(count), np.zeros(count), np.cos(t / 3.0)], axis=1)
    level_camera = so3_exp(np.array([-np.pi / 2.0, 0.0, 0.0]))
    stamps_ns = START_NS + np.arange(count, dtype=np.int64) * interval_ns
    return Trajectory(32632, stamps_ns, CORNER_M + positions_m, so3_exp(headings) @ level_camera)


def disturbed(truth: Trajectory, seed: int, stamp_jitter_ns: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    count = len(truth)
    return Trajectory(
        truth.epsg,
        truth.stamps_ns + rng.integers(-stamp_jitter_ns, stamp_jitter_ns + 1, count),
        truth.positions_m + np.cumsum(rng.normal(0.0, 0.05, (count, 3)), axis=0),
        truth.rotations @ so3_exp(rng.normal(0.0, 0.02, (count, 3))),
    )


def without(truth: Trajectory, gone: slice) -> Trajectory:
    keep = np.ones(len(truth), dtype=bool)
    keep[gone] = False
    return Trajectory(truth.epsg, truth.stamps_ns[keep], truth.positions_m[keep], truth.rotations[keep])


def moved(truth: Trajectory, scale: float, rotation: np.ndarray, translation_m: np.ndarray) -> Trajectory:
    positions_m = scale * (truth.positions_m - CORNER_M) @ rotation.T + translation_m
    return Trajectory(truth.epsg, truth.stamps_ns, positions_m, rotation @ truth.rotations)


def as_evo(own: Trajectory, origin_m: np.ndarray) -> trajectory.PoseTrajectory3D:
    xyzw = quat_xyzw_from_rotations(own.rotations)
    return trajectory.PoseTrajectory3D(
        positions_xyz=own.positions_m - origin_m,
        orientations_quat_wxyz=np.roll(xyzw, 1, axis=1),
        timestamps=own.stamps_ns / 1e9,
    )


def evo_statistics(
    estimate: Trajectory,
    reference: Trajectory,
    align: Alignment,
    relation: metrics.PoseRelation,
    max_offset_ns: int = 5_000_000,
    horizontal: bool = False,
) -> dict[str, float]:
    origin_m = reference.positions_m[0]
    true, estimated = sync.associate_trajectories(
        as_evo(reference, origin_m), as_evo(estimate, origin_m), max_diff=max_offset_ns / 1e9
    )
    estimated = copy.deepcopy(estimated)
    if align != "none":
        estimated.align(true, correct_scale=align == "sim3")
    if horizontal:
        true.project(trajectory.Plane.XY)
        estimated.project(trajectory.Plane.XY)
    ape = metrics.APE(relation)
    ape.process_data((true, estimated))
    return {name: float(value) for name, value in ape.get_all_statistics().items()}


def assert_equal_to_evo(ours: ErrorStatistics, evos: dict[str, float], tolerance: float = 1e-9) -> None:
    assert set(EVO_ROWS) == set(evos)
    for row in EVO_ROWS:
        # A sum of hundreds of squares keeps relative, not absolute digits.
        allowed = tolerance * max(1.0, evos["sse"]) if row == "sse" else tolerance
        assert abs(getattr(ours, row) - evos[row]) <= allowed, row


@pytest.mark.parametrize("align", ["none", "se3", "sim3"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_all_statistics_equal_evos(align: Alignment, seed: int) -> None:
    reference = winding_drive()
    estimate = without(disturbed(reference, seed, stamp_jitter_ns=3_000_000), slice(40, 55))
    errors = evaluate_trajectory(estimate, reference, align=align)
    relation = metrics.PoseRelation
    assert errors.matched == 105
    assert_equal_to_evo(errors.position_m, evo_statistics(estimate, reference, align, relation.translation_part))
    assert_equal_to_evo(
        errors.horizontal_m,
        evo_statistics(estimate, reference, align, relation.translation_part, horizontal=True),
    )
    assert errors.rotation is not None
    assert_equal_to_evo(
        ErrorStatistics.of(errors.rotation.angles_deg),
        evo_statistics(estimate, reference, align, relation.rotation_angle_deg),
    )


def test_a_map_in_another_frame_and_scale_is_aligned_like_evo_aligns_it() -> None:
    reference = winding_drive()
    turn = so3_exp(np.array([0.4, -1.1, 2.0]))
    estimate = moved(disturbed(reference, 5), 0.31, turn, np.array([3.0, -7.0, 11.0]))
    errors = evaluate_trajectory(estimate, reference, align="sim3")
    assert_equal_to_evo(
        errors.position_m,
        evo_statistics(estimate, reference, "sim3", metrics.PoseRelation.translation_part),
        # evo aligns positions that lie a whole UTM northing from the reference.
        tolerance=1e-7,
    )
    assert errors.scale == pytest.approx(1.0 / 0.31, rel=0.02)


@pytest.mark.parametrize("align", ["none", "se3", "sim3"])
def test_published_golden_trajectories_score_as_published(align: Alignment, data_folder: Path) -> None:
    reference, estimate = (
        _read_tum_without_zone(data_folder / "rgbd" / "evo_ate_golden" / f"freiburg1_xyz-{name}.txt")
        for name in ("groundtruth", "rgbdslam")
    )
    errors = evaluate_trajectory(estimate, reference, align=align, max_offset_ns=10_000_000)
    for ours, relation in (
        (errors.position_m, metrics.PoseRelation.translation_part),
        (ErrorStatistics.of(errors.rotation.angles_deg), metrics.PoseRelation.rotation_angle_deg),  # type: ignore[union-attr]
    ):
        assert_equal_to_evo(ours, evo_statistics(estimate, reference, align, relation, 10_000_000))
    if align == "se3":
        assert errors.position_m.rmse == pytest.approx(0.013470, abs=5e-7)


def _read_tum_without_zone(path: Path) -> Trajectory:
    rows = np.loadtxt(path)
    stamps_ns = np.round(rows[:, 0] * 1e6).astype(np.int64) * 1000
    return Trajectory(32632, stamps_ns, rows[:, 1:4], rotations_from_quat_xyzw(rows[:, 4:]))


def test_sim3_recovers_scale_and_pose_exactly_at_utm_coordinates() -> None:
    reference = winding_drive()
    estimate = moved(reference, 1.7, so3_exp(np.array([0.2, 0.1, -2.5])), CORNER_M)
    errors = evaluate_trajectory(estimate, reference, align="sim3")
    assert errors.scale == pytest.approx(1.0 / 1.7, rel=1e-9)
    assert errors.position_m.max < 1e-7
    assert errors.rotation is not None
    assert errors.rotation.angles_deg.max() < 1e-5
    np.testing.assert_allclose(errors.positions_m, reference.positions_m, atol=1e-7)


def test_without_alignment_a_shift_is_an_error() -> None:
    reference = winding_drive()
    shifted = Trajectory(
        32632, reference.stamps_ns, reference.positions_m + np.array([0.3, 0.4, 1.2]), reference.rotations
    )
    errors = evaluate_trajectory(shifted, reference)
    assert errors.position_m.mean == pytest.approx(1.3, abs=1e-8)
    assert errors.horizontal_m.mean == pytest.approx(0.5, abs=1e-8)
    assert errors.position_m.sse == pytest.approx(1.3**2 * 120, abs=1e-6)
    assert errors.position_m.std < 1e-8
    assert errors.scale is None
    assert errors.over_2m == 0


def test_only_poses_more_than_two_metres_off_are_counted() -> None:
    reference = winding_drive()
    positions_m = reference.positions_m.copy()
    positions_m[:7, 1] += 2.1
    positions_m[7:20, 1] += 1.9
    errors = evaluate_trajectory(
        Trajectory(32632, reference.stamps_ns, positions_m, reference.rotations), reference
    )
    assert errors.over_2m == 7


def test_a_constant_roll_is_split_off_from_the_rotation_error() -> None:
    reference = winding_drive()
    noise = so3_exp(np.random.default_rng(0).normal(0.0, 0.001, (len(reference), 3)))
    roll = so3_exp(np.array([0.0, 0.0, np.radians(6.0)]))
    rolled = Trajectory(32632, reference.stamps_ns, reference.positions_m, reference.rotations @ roll @ noise)
    rotation = evaluate_trajectory(rolled, reference).rotation
    assert rotation is not None
    assert rotation.offset_deg == pytest.approx(6.0, abs=0.05)
    assert np.median(rotation.angles_deg) == pytest.approx(6.0, abs=0.1)
    assert 0.02 < np.median(rotation.spread_deg) < 0.2


def test_poses_more_than_five_milliseconds_apart_are_not_compared() -> None:
    reference = winding_drive()
    offsets_ns = np.where(np.arange(len(reference)) % 2 == 0, 4_999_999, 5_000_001)
    estimate = Trajectory(32632, reference.stamps_ns + offsets_ns, reference.positions_m, reference.rotations)
    errors = evaluate_trajectory(estimate, reference)
    assert errors.matched == 60
    assert errors.coverage == 0.5


def test_coverage_counts_the_reference_poses_without_an_estimate() -> None:
    reference = winding_drive(100)
    errors = evaluate_trajectory(without(disturbed(reference, 0), slice(10, 35)), reference)
    assert (errors.matched, errors.comparable, errors.coverage) == (75, 100, 0.75)


def test_each_pose_is_matched_once_and_with_the_nearest() -> None:
    first = np.array([0, 100, 103, 200], dtype=np.int64)
    second = np.array([2, 102, 195, 204], dtype=np.int64)
    of_first, of_second = associate(first, second, 5)
    assert of_first.tolist() == [0, 2, 3]
    assert of_second.tolist() == [0, 1, 3]


@given(
    st.lists(st.integers(0, 400), unique=True, max_size=40),
    st.lists(st.integers(0, 400), unique=True, max_size=40),
    st.integers(0, 20),
)
@settings(deadline=None)
def test_association_is_one_to_one_near_symmetric_and_leaves_no_close_pair(
    first: list[int], second: list[int], limit: int
) -> None:
    one, other = np.array(sorted(first), dtype=np.int64), np.array(sorted(second), dtype=np.int64)
    of_one, of_other = associate(one, other, limit)
    assert len(set(of_one.tolist())) == len(of_one) == len(set(of_other.tolist()))
    assert np.all(np.abs(one[of_one] - other[of_other]) <= limit)
    swapped_other, swapped_one = associate(other, one, limit)
    assert swapped_one.tolist() == of_one.tolist()
    assert swapped_other.tolist() == of_other.tolist()
    if len(one) and len(other):
        closest = np.abs(one[:, None] - other[None, :]).min()
        assert (len(of_one) > 0) == (closest <= limit)


def test_different_zones_are_refused() -> None:
    one = winding_drive()
    other = Trajectory(32633, one.stamps_ns, one.positions_m, one.rotations)
    with pytest.raises(TrajectoryError, match=r"EPSG:32632.*EPSG:32633"):
        evaluate_trajectory(one, other)
    with pytest.raises(TrajectoryError, match=r"EPSG:32632.*EPSG:32633"):
        evaluate_against_map(one, other, np.zeros(3))


@pytest.mark.parametrize("count", [0, 5])
def test_drives_of_different_days_have_nothing_to_compare(count: int) -> None:
    one = winding_drive()
    late = winding_drive(count)
    other = Trajectory(32632, late.stamps_ns + 86_400_000_000_000, late.positions_m, late.rotations)
    with pytest.raises(TrajectoryError, match="within 5 ms") as refusal:
        evaluate_trajectory(other, one)
    assert "\n" not in str(refusal.value)
    with pytest.raises(TrajectoryError, match=r"at most 0\.5 s apart"):
        evaluate_against_map(other, one, np.zeros(3))


def test_two_matched_poses_cannot_be_aligned() -> None:
    with pytest.raises(TrajectoryError, match="cannot align 2 matched poses"):
        evaluate_trajectory(winding_drive(2), winding_drive(100), align="sim3")


def test_a_second_camera_is_expected_at_its_offset_from_the_survey_camera() -> None:
    survey = winding_drive(60)
    fine = winding_drive(600, 10_000_000)  # the true path between the survey's images
    offset_m = np.array([0.54, -0.02, 0.1])
    mounting = so3_exp(np.array([0.01, 0.03, -0.02]))
    query = Trajectory(
        32632, fine.stamps_ns + 0, fine.positions_m + fine.rotations @ offset_m, fine.rotations @ mounting
    )
    errors = evaluate_against_map(query, survey, offset_m)
    # Between images 0.8 m apart a chord stays within millimetres of this road.
    assert 0.0 <= errors.position_m.min < 1e-8
    assert 1e-4 < errors.position_m.max < 0.01
    assert errors.rotation is not None
    assert errors.rotation.offset_deg == pytest.approx(np.degrees(np.linalg.norm(so3_log(mounting))), abs=0.01)
    assert errors.rotation.spread_deg.max() < 0.1
    known = evaluate_against_map(query, survey, offset_m, mounting)
    assert known.rotation is not None
    assert known.rotation.angles_deg.max() < 0.1
    assert known.tangents == pytest.approx(errors.tangents, abs=1e-9)
    forgotten = evaluate_against_map(query, survey, np.zeros(3))
    assert forgotten.position_m.median == pytest.approx(np.linalg.norm(offset_m), abs=0.01)


def test_nothing_is_interpolated_over_more_than_half_a_second_or_beyond_the_survey() -> None:
    survey = without(winding_drive(60), slice(20, 24))  # 0.5 s between the poses 19 and 24
    query = winding_drive(140, 50_000_000)
    errors = evaluate_against_map(query, survey, np.zeros(3))
    assert (errors.matched, errors.comparable) == (119, 140)
    wider = without(winding_drive(60), slice(20, 25))  # 0.6 s
    errors = evaluate_against_map(query, wider, np.zeros(3))
    inside = (query.stamps_ns > wider.stamps_ns[19]) & (query.stamps_ns < wider.stamps_ns[20])
    assert errors.matched == 119 - inside.sum()
    assert not set(errors.stamps_ns.tolist()) & set(query.stamps_ns[inside].tolist())


def test_interpolation_follows_the_geodesic_between_neighbours() -> None:
    drive = winding_drive(10)
    compared, between = interpolate_trajectory(drive, drive.stamps_ns[:-1] + 30_000_000)
    assert compared.all()
    for index in range(9):
        expected: Pose = interpolate_pose(drive.pose(index), drive.pose(index + 1), 0.3)
        np.testing.assert_allclose(between.positions_m[index], expected.translation_m, atol=1e-8)
        np.testing.assert_allclose(between.rotations[index], expected.rotation, atol=1e-12)


def test_interpolation_at_the_poses_gives_the_poses() -> None:
    drive = winding_drive(10)
    compared, same = interpolate_trajectory(drive, drive.stamps_ns)
    assert compared.all()
    np.testing.assert_array_equal(same.positions_m, drive.positions_m)
    np.testing.assert_allclose(same.rotations, drive.rotations, atol=1e-14)


def test_an_empty_trajectory_has_nothing_to_interpolate() -> None:
    compared, nothing = interpolate_trajectory(winding_drive(0), np.array([START_NS], dtype=np.int64))
    assert not compared.any()
    assert len(nothing) == 0


def test_the_json_form_holds_every_documented_key_as_plain_values() -> None:
    reference = winding_drive()
    figures = json.loads(json.dumps(evaluate_trajectory(disturbed(reference, 1), reference).to_json()))
    assert set(figures) == {
        "position_m", "horizontal_m", "rotation_deg", "rotation_offset_deg", "rotation_spread_deg",
        "matched", "comparable", "coverage", "over_2m", "scale",
    }  # fmt: skip
    for name in ("position_m", "horizontal_m", "rotation_deg", "rotation_spread_deg"):
        assert set(figures[name]) == {*EVO_ROWS, "p95"}
    assert figures["position_m"] == asdict(evaluate_trajectory(disturbed(reference, 1), reference).position_m)
