"""Where the antenna is, and how we know."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleetmap.drives import open_drive
from fleetmap.drives.static_transforms import StaticTransforms
from fleetmap.geometry import Pose, quat_xyzw_from_rotations, so3_exp

T0_NS = 1_650_000_000_123_456_789
OPTICAL_FROM_BODY = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


@pytest.fixture
def drive_with(record, small_camera, pictures):
    def build(*links, gnss_frame_id="gnss", topic="/tf_static", **options):
        with record() as recorder:
            recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
            recorder.jpeg("/x/image", T0_NS, pictures[0], "cam")
            recorder.fix("/fix", T0_NS, (49.0, 8.0, 100.0), gnss_frame_id)
            for link in links:
                recorder.transforms(T0_NS, link, topic=topic)
        return open_drive(recorder.path, **options)

    return build


def link(parent, child, pose):
    return parent, child, tuple(pose.translation_m), tuple(quat_xyzw_from_rotations(pose.rotation))


def warnings_in(caplog):
    return [entry for entry in caplog.records if entry.levelno >= logging.WARNING]


def test_a_fix_in_the_images_frame_has_no_lever_arm(drive_with, caplog):
    antenna = drive_with(gnss_frame_id="cam").antenna()
    assert antenna.source == "same frame"
    assert antenna.position_in_cam_m == pytest.approx(np.zeros(3), abs=0)
    assert not warnings_in(caplog)


def test_a_chain_of_transforms_in_mixed_directions_is_walked(drive_with, caplog):
    rng = np.random.default_rng(3)
    base_from_mast, mast_from_gnss, base_from_rig, cam_from_rig = (
        Pose(so3_exp(rng.normal(0, 1, 3)), rng.normal(0, 2, 3)) for _ in range(4)
    )
    drive = drive_with(
        link("base", "mast", base_from_mast),
        link("mast", "gnss", mast_from_gnss),
        link("base", "rig", base_from_rig),
        link("cam", "rig", cam_from_rig),
    )
    expected = cam_from_rig @ base_from_rig.inverse() @ base_from_mast @ mast_from_gnss
    antenna = drive.antenna()
    assert antenna.source == "static transform"
    assert antenna.position_in_cam_m == pytest.approx(expected.translation_m)
    assert not warnings_in(caplog)


def test_a_usual_body_to_optical_mounting_gives_the_arm_by_hand(drive_with):
    # Camera 2 m ahead of base, 1 m up, looking forward; antenna 0.5 m left of base, 3 m up.
    base_from_cam = Pose(OPTICAL_FROM_BODY.T, np.array([2.0, 0.0, 1.0]))
    base_from_gnss = Pose(np.eye(3), np.array([0.0, 0.5, 3.0]))
    drive = drive_with(link("base", "cam", base_from_cam), link("base", "gnss", base_from_gnss))
    assert drive.antenna().position_in_cam_m == pytest.approx([-0.5, -2.0, -2.0])


def test_leading_slashes_of_old_frame_names_do_not_matter(drive_with):
    arm = Pose(np.eye(3), np.array([1.0, 2.0, 3.0]))
    assert drive_with(link("/cam", "/gnss", arm)).antenna().position_in_cam_m == pytest.approx([1.0, 2.0, 3.0])


def test_the_option_is_in_body_axes_and_used_where_no_path_is(drive_with, caplog):
    unconnected = link("base", "gnss", Pose.identity())
    antenna = drive_with(unconnected, antenna_offset_m=(1.0, 2.0, 3.0)).antenna()
    assert antenna.source == "option"
    assert antenna.position_in_cam_m == pytest.approx([-2.0, -3.0, 1.0])  # right, down, forward
    assert not warnings_in(caplog)


def test_without_path_and_option_it_is_assumed_at_the_camera_with_one_warning(drive_with, caplog):
    drive = drive_with()
    for _ in range(3):
        assert drive.antenna().source == "assumed at the camera"
    assert drive.antenna().position_in_cam_m == pytest.approx(np.zeros(3), abs=0)
    (warning,) = warnings_in(caplog)
    assert "--antenna-offset" in warning.getMessage()


def test_the_recording_knows_better_than_the_option(drive_with, caplog):
    arm = Pose(np.eye(3), np.array([1.0, 2.0, 3.0]))
    antenna = drive_with(link("cam", "gnss", arm), antenna_offset_m=(9.0, 9.0, 9.0)).antenna()
    assert antenna.position_in_cam_m == pytest.approx([1.0, 2.0, 3.0])
    (warning,) = warnings_in(caplog)
    assert "--antenna-offset is not used" in warning.getMessage()


def test_moving_transforms_are_no_mounting(drive_with):
    arm = link("cam", "gnss", Pose(np.eye(3), np.ones(3)))
    assert drive_with(arm, topic="/tf").antenna().source == "assumed at the camera"


def test_a_fix_without_a_frame_is_nowhere(drive_with):
    assert drive_with(gnss_frame_id="", antenna_offset_m=(1.0, 0.0, 0.0)).antenna().source == "option"


def test_a_later_transform_of_the_same_frames_replaces_the_earlier(drive_with):
    first, second = (link("cam", "gnss", Pose(np.eye(3), np.full(3, value))) for value in (1.0, 2.0))
    assert drive_with(first, second).antenna().position_in_cam_m == pytest.approx([2.0, 2.0, 2.0])


vectors = st.lists(st.floats(-3, 3), min_size=3, max_size=3).map(np.array)
poses = st.builds(lambda turn, shift: Pose(so3_exp(turn), shift), vectors, vectors)


@given(st.lists(st.tuples(poses, st.integers(0, 100), st.booleans()), min_size=1, max_size=8))
def test_any_tree_of_transforms_agrees_with_the_frames_true_places(tree):
    world_from_frame = [Pose.identity()]
    transforms = StaticTransforms()
    for child, (parent_from_child, pick, upside_down) in enumerate(tree, start=1):
        parent = pick % child
        world_from_frame.append(world_from_frame[parent] @ parent_from_child)
        if upside_down:
            transforms.add(str(child), str(parent), parent_from_child.inverse())
        else:
            transforms.add(str(parent), str(child), parent_from_child)
    last = len(tree)
    found = transforms.between("0", str(last))
    assert found is not None
    assert np.allclose(found.translation_m, world_from_frame[last].translation_m, atol=1e-9)
    assert np.allclose(found.rotation, world_from_frame[last].rotation, atol=1e-9)
    assert transforms.between("0", "elsewhere") is None
