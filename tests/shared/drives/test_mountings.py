"""Where the IMU and the vehicle's own frame are, and how we know."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from fleetmap.drives import open_drive
from fleetmap.geometry import CAM_FROM_BODY, Pose, quat_xyzw_from_rotations, so3_exp

T0_NS = 1_650_000_000_123_456_789
BASE_FROM_CAM = Pose(so3_exp(np.array([0.1, -1.2, 0.4])), np.array([1.5, 0.2, 1.4]))
BASE_FROM_IMU = Pose(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([0.3, 0.0, 0.5]))


@pytest.fixture
def drive_with(record, small_camera, pictures):
    def build(*links, camera_frame="cam", with_sensors=True):
        with record() as recorder:
            recorder.camera_info("/x/camera_info", T0_NS, small_camera, camera_frame)
            recorder.jpeg("/x/image", T0_NS, pictures[0], camera_frame)
            if with_sensors:
                recorder.imu("/imu", T0_NS, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))  # of frame "imu"
                recorder.twist("/speed", T0_NS, 3.0)  # of frame "base_link"
            for child, pose in links:
                turn = tuple(quat_xyzw_from_rotations(pose.rotation))
                recorder.transforms(T0_NS, ("base_link", child, tuple(pose.translation_m), turn))
        return open_drive(recorder.path)

    return build


def warnings_in(caplog):
    return [entry.getMessage() for entry in caplog.records if entry.levelno >= logging.WARNING]


def test_static_transforms_tell_where_both_are(drive_with, caplog):
    drive = drive_with(("cam", BASE_FROM_CAM), ("imu", BASE_FROM_IMU))
    cam_from_base = BASE_FROM_CAM.inverse()
    for mounting, expected in (
        (drive.imu_mounting(), cam_from_base @ BASE_FROM_IMU),
        (drive.wheel_mounting(), cam_from_base),
    ):
        assert mounting.source == "static transform"
        assert mounting.cam_from_sensor.rotation == pytest.approx(expected.rotation, abs=1e-9)
        assert mounting.cam_from_sensor.translation_m == pytest.approx(expected.translation_m, abs=1e-9)
    assert not warnings_in(caplog)


def test_an_imu_in_the_images_frame_is_the_cameras_own(drive_with):
    mounting = drive_with(camera_frame="imu").imu_mounting()
    assert mounting.source == "same frame"
    assert mounting.cam_from_sensor.rotation == pytest.approx(np.eye(3), abs=0)
    assert mounting.cam_from_sensor.translation_m == pytest.approx(np.zeros(3), abs=0)


def test_an_imu_that_hangs_nowhere_is_nowhere_and_told_once(drive_with, caplog):
    drive = drive_with()
    for _ in range(3):
        assert drive.imu_mounting() is None
    (warning,) = warnings_in(caplog)
    assert "IMU's frame 'imu'" in warning


def test_without_transform_the_wheels_are_those_of_a_camera_that_looks_forward(drive_with, caplog):
    drive = drive_with()
    for _ in range(3):
        assert drive.wheel_mounting().source == "assumed level and forward"
    assert drive.wheel_mounting().cam_from_sensor.rotation == pytest.approx(CAM_FROM_BODY, abs=0)
    (warning,) = warnings_in(caplog)
    assert "'base_link'" in warning


def test_what_is_not_there_is_not_mounted(drive_with, caplog):
    drive = drive_with(with_sensors=False)
    assert drive.imu_mounting() is None
    assert drive.wheel_mounting() is None
    assert not warnings_in(caplog)
