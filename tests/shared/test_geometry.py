from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fleetmap.errors import InputError
from fleetmap.geometry import (
    Pose,
    Sim3,
    interpolate_pose,
    quat_xyzw_from_rotations,
    rotation_angle_rad,
    rotations_from_quat_xyzw,
    so3_exp,
    so3_log,
    umeyama_alignment,
)

vectors = st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3).map(np.array)  # turns shorter than pi
shifts = st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3).map(np.array)
poses = st.builds(lambda turn, shift: Pose(so3_exp(turn), shift), vectors, shifts)
sims = st.builds(lambda s, turn, shift: Sim3(s, so3_exp(turn), shift), st.floats(0.01, 100.0), vectors, shifts)

QUARTER_LEFT = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def same_pose(a: Pose, b: Pose) -> bool:
    return np.allclose(a.rotation, b.rotation, atol=1e-9) and np.allclose(
        a.translation_m, b.translation_m, atol=1e-8
    )


def test_a_pose_takes_points_of_the_source_frame_into_the_target_frame():
    target_from_source = Pose(QUARTER_LEFT, np.array([10.0, 0.0, 0.0]))
    assert target_from_source.transform(np.array([1.0, 2.0, 3.0])) == pytest.approx([8.0, 1.0, 3.0])
    many = target_from_source.transform(np.array([[[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]]))
    assert many == pytest.approx(np.array([[[8.0, 1.0, 3.0], [10.0, 0.0, 0.0]]]))


@given(poses, poses, shifts)
def test_poses_chain_by_their_inner_names(a_from_b, b_from_c, point_in_c):
    through_b = a_from_b.transform(b_from_c.transform(point_in_c))
    assert np.allclose((a_from_b @ b_from_c).transform(point_in_c), through_b, atol=1e-8)


@given(poses)
def test_a_pose_and_its_inverse_cancel(pose):
    assert same_pose(pose @ pose.inverse(), Pose.identity())
    assert same_pose(pose.inverse() @ pose, Pose.identity())


@given(sims, sims, shifts)
def test_similarities_chain_and_cancel(a_from_b, b_from_c, point):
    through_b = a_from_b.transform(b_from_c.transform(point))
    assert np.allclose((a_from_b @ b_from_c).transform(point), through_b, rtol=1e-9, atol=1e-6)
    there_and_back = a_from_b.inverse().transform(a_from_b.transform(point))
    assert np.allclose(there_and_back, point, rtol=1e-9, atol=1e-6)


@given(sims, poses, shifts)
def test_a_similarity_moves_a_camera_so_that_it_sees_the_same(target_from_source, source_from_cam, point_in_cam):
    """A point seen under a direction stays under that direction: depths scale, rays do not."""
    target_from_cam = target_from_source.transform_pose(source_from_cam)
    moved = target_from_source.transform(source_from_cam.transform(point_in_cam))
    assert np.allclose(
        target_from_cam.inverse().transform(moved), target_from_source.scale * point_in_cam, rtol=1e-6, atol=1e-6
    )


class TestUmeyama:
    @given(sims, st.integers(0, 2**31))
    def test_a_known_similarity_is_recovered(self, truth, seed):
        source = np.random.default_rng(seed).normal(0.0, 10.0, (12, 3))
        found = umeyama_alignment(source, truth.transform(source))
        assert found.scale == pytest.approx(truth.scale, rel=1e-9)
        assert np.allclose(found.rotation, truth.rotation, atol=1e-8)
        assert np.allclose(found.transform(source), truth.transform(source), atol=1e-6 * (1 + truth.scale))

    def test_a_mirrored_target_never_gives_a_mirror(self):
        source = np.random.default_rng(0).normal(0.0, 1.0, (20, 3))
        found = umeyama_alignment(source, source * [1.0, 1.0, -1.0])
        assert np.linalg.det(found.rotation) == pytest.approx(1.0)

    def test_points_of_one_plane_are_aligned_without_a_mirror(self):
        source = np.random.default_rng(1).normal(0.0, 1.0, (20, 3)) * [1.0, 1.0, 0.0]
        truth = Sim3(2.0, QUARTER_LEFT, np.array([1.0, 2.0, 3.0]))
        found = umeyama_alignment(source, truth.transform(source))
        assert np.allclose(found.rotation, truth.rotation, atol=1e-9)

    def test_without_scale_the_scale_is_one(self):
        source = np.random.default_rng(2).normal(0.0, 1.0, (20, 3))
        found = umeyama_alignment(source, 3.0 * source, with_scale=False)
        assert found.scale == 1.0
        assert np.allclose(found.rotation, np.eye(3))

    def test_noise_leaves_less_error_than_any_near_alignment(self):
        rng = np.random.default_rng(3)
        source = rng.normal(0.0, 10.0, (50, 3))
        truth = Sim3(1.5, so3_exp(np.array([0.1, -0.4, 0.8])), np.array([5.0, 6.0, 7.0]))
        target = truth.transform(source) + rng.normal(0.0, 0.1, (50, 3))
        found = umeyama_alignment(source, target)
        least = ((found.transform(source) - target) ** 2).sum()
        assert 0.0 < least < ((truth.transform(source) - target) ** 2).sum()
        for axis in range(3):
            turned = Sim3(found.scale, found.rotation @ so3_exp(1e-3 * np.eye(3)[axis]), found.translation_m)
            assert least < ((turned.transform(source) - target) ** 2).sum()

    @pytest.mark.parametrize(
        ("source", "target"),
        [
            (np.zeros((2, 3)), np.zeros((2, 3))),
            (np.zeros((4, 3)), np.zeros((5, 3))),
            (np.ones((5, 3)), np.zeros((5, 3))),
            (np.zeros((5, 2)), np.zeros((5, 2))),
        ],
    )
    def test_what_cannot_be_aligned_is_refused(self, source, target):
        with pytest.raises(InputError, match="alignment needs"):
            umeyama_alignment(source, target)


@given(vectors)
def test_exponential_and_logarithm_are_inverses(vector):
    rotation = so3_exp(vector)
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert np.allclose(so3_log(rotation), vector, atol=1e-7)
    assert rotation_angle_rad(rotation) == pytest.approx(np.linalg.norm(vector), abs=1e-7)


def test_the_exponential_turns_right_handed():
    assert so3_exp(np.array([0.0, 0.0, np.pi / 2])) == pytest.approx(QUARTER_LEFT)


@given(vectors)
def test_rotations_and_quaternions_are_inverses(vector):
    rotation = so3_exp(vector)
    quat = quat_xyzw_from_rotations(rotation)
    assert quat[3] >= 0.0
    assert np.allclose(rotations_from_quat_xyzw(quat), rotation, atol=1e-12)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-300, 1e-12, 9.99e-4, 1.01e-3, 1.0, np.pi - 1e-3, np.pi - 1e-12])
def test_rotations_of_every_size_about_every_axis_are_those_of_scipy(angle_rad):
    axes = np.random.default_rng(1).normal(size=(200, 3))
    vectors = angle_rad * np.vstack([np.eye(3), -np.eye(3), axes / np.linalg.norm(axes, axis=1, keepdims=True)])
    expected = Rotation.from_rotvec(vectors)
    rotations = so3_exp(vectors)
    assert np.abs(rotations - expected.as_matrix()).max() < 1e-15
    assert np.allclose(so3_log(rotations), expected.as_rotvec(), rtol=1e-9, atol=1e-15)
    assert np.abs(quat_xyzw_from_rotations(rotations) - expected.as_quat(canonical=True)).max() < 1e-15
    assert np.abs(rotations_from_quat_xyzw(-3.0 * expected.as_quat()) - expected.as_matrix()).max() < 2e-15


def test_half_a_turn_has_an_angle_and_a_quaternion_without_length_is_refused():
    assert rotation_angle_rad(np.diag([1.0, -1.0, -1.0])) == pytest.approx(np.pi)
    assert np.abs(so3_log(np.diag([-1.0, -1.0, 1.0]))) == pytest.approx([0.0, 0.0, np.pi])
    with pytest.raises(InputError, match="quaternion"):
        rotations_from_quat_xyzw(np.zeros((2, 4)))


def test_quaternions_are_in_the_order_x_y_z_w():
    half = np.sqrt(0.5)
    assert quat_xyzw_from_rotations(QUARTER_LEFT) == pytest.approx([0.0, 0.0, half, half])


@given(poses, poses)
def test_interpolation_starts_and_ends_at_its_poses(first, second):
    assert same_pose(interpolate_pose(first, second, 0.0), first)
    assert same_pose(interpolate_pose(first, second, 1.0), second)


@given(poses, vectors, shifts, st.floats(0.0, 1.0))
def test_interpolation_turns_evenly_and_moves_straight(first, turn, shift, fraction):
    second = Pose(first.rotation @ so3_exp(turn), first.translation_m + shift)
    between = interpolate_pose(first, second, fraction)
    assert np.allclose(between.rotation, first.rotation @ so3_exp(fraction * turn), atol=1e-6)
    assert np.allclose(between.translation_m, first.translation_m + fraction * shift, atol=1e-6)


def test_the_adjoint_carries_a_small_motion_to_the_other_side_of_a_pose() -> None:
    pose = Pose(so3_exp(np.array([0.4, -1.1, 0.3])), np.array([3.0, -2.0, 7.0]))
    xi = 1e-6 * np.array([1.0, -2.0, 0.5, 3.0, 1.0, -2.0])
    carried = pose.adjoint() @ xi
    before = pose @ Pose(so3_exp(xi[:3]), xi[3:])
    after = Pose(so3_exp(carried[:3]), carried[3:]) @ pose
    np.testing.assert_allclose(before.rotation, after.rotation, atol=1e-11)
    np.testing.assert_allclose(before.translation_m, after.translation_m, atol=1e-10)
    assert np.abs(carried - xi).max() > 1e-6  # it is not the identity
