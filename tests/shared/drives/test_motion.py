"""Inertial measurements and wheel speeds, in time order."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from fleetmap.drive import WheelSpeed
from fleetmap.drives import open_drive
from fleetmap.drives.time_order import in_time_order

T0_NS = 1_650_000_000_123_456_789
MS = 1_000_000
GRAVITY = (0.0, 0.0, 9.81)
NAN = float("nan")


@pytest.fixture
def drive_with(record, small_camera, pictures):
    def build(write):
        with record() as recorder:
            recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
            recorder.jpeg("/x/image", T0_NS, pictures[0], "cam")
            write(recorder)
        return open_drive(recorder.path)

    return build


def test_a_recording_without_either_gives_nothing(drive_with):
    drive = drive_with(lambda recorder: None)
    assert list(drive.imu_samples()) == []
    assert list(drive.wheel_speeds()) == []


def test_imu_samples_come_with_their_stamps_and_axes(drive_with):
    def write(recorder):
        for index in range(5):
            angular = 0.1 * index, 0.2 * index, -0.3 * index
            recorder.imu("/imu/data", T0_NS + index * 10 * MS, angular, (1.0, -2.0, 9.81 + index))

    samples = list(drive_with(write).imu_samples())
    assert [sample.stamp_ns for sample in samples] == [T0_NS + index * 10 * MS for index in range(5)]
    assert samples[4].angular_velocity_rad_s == pytest.approx([0.4, 0.8, -1.2])
    assert samples[4].linear_acceleration_m_s2 == pytest.approx([1.0, -2.0, 13.81])
    assert samples[4].angular_velocity_rad_s.dtype == np.float64


def test_samples_that_are_not_finite_or_not_measured_are_left_out(drive_with):
    def write(recorder):
        recorder.imu("/imu", T0_NS, (0.0, NAN, 0.0), GRAVITY)
        recorder.imu("/imu", T0_NS + 1, (0.0, 0.0, 0.0), (0.0, float("inf"), 0.0))
        recorder.imu("/imu", T0_NS + 2, (0.0, 0.0, 0.0), GRAVITY, angular_covariance=np.array([-1.0] + [0.0] * 8))
        recorder.imu("/imu", T0_NS + 3, (0.0, 0.0, 0.0), GRAVITY)

    assert [sample.stamp_ns - T0_NS for sample in drive_with(write).imu_samples()] == [3]


def test_samples_are_sorted_by_header_stamp_and_given_once(drive_with):
    def write(recorder):
        for order, late in enumerate((3, 1, 2, 2, 7, 5)):
            recorder.imu("/imu", T0_NS + late, (float(order), 0.0, 0.0), GRAVITY, log_ns=T0_NS + order)

    samples = list(drive_with(write).imu_samples())
    assert [sample.stamp_ns - T0_NS for sample in samples] == [1, 2, 3, 5, 7]
    assert samples[1].angular_velocity_rad_s[0] == 2.0  # the first of the two with one stamp


def test_of_several_topics_the_one_with_the_highest_rate_is_read(drive_with):
    def write(recorder):
        for index in range(8):
            recorder.imu("/imu/fast", T0_NS + index, (1.0, 0.0, 0.0), GRAVITY)
            recorder.twist("/wheel/fast", T0_NS + index, 3.0)
        for index in range(4):
            recorder.imu("/a/slow", T0_NS + index, (2.0, 0.0, 0.0), GRAVITY)
            recorder.odometry("/a/slow_odometry", T0_NS + index, 4.0)

    drive = drive_with(write)
    assert {sample.angular_velocity_rad_s[0] for sample in drive.imu_samples()} == {1.0}
    assert {speed.speed_mps for speed in drive.wheel_speeds()} == {3.0}


@pytest.mark.parametrize("kind", ["odometry", "twist"])
def test_the_forward_axis_of_the_vehicle_is_its_speed(drive_with, kind):
    def write(recorder):
        for index, speed in enumerate((5.0, -0.5, NAN, 0.0)):
            getattr(recorder, kind)("/speed", T0_NS + index, speed)

    found = list(drive_with(write).wheel_speeds())
    assert found == [WheelSpeed(T0_NS, 5.0), WheelSpeed(T0_NS + 1, -0.5), WheelSpeed(T0_NS + 3, 0.0)]


def test_a_commanded_speed_is_not_a_measured_one(drive_with):
    def write(recorder):
        for index in range(9):
            recorder.twist("/cmd_vel", T0_NS + index, 9.0)
        recorder.twist("/wheel/twist", T0_NS, 1.0)

    assert [speed.speed_mps for speed in drive_with(write).wheel_speeds()] == [1.0]


def test_a_receivers_velocity_east_is_not_the_vehicles_forward_speed(drive_with):
    def write(recorder):
        recorder.fix("/fix", T0_NS, (49.0, 8.0, 100.0), "gps")
        for index in range(9):
            recorder.twist("/vel", T0_NS + index, 9.0, frame_id="gps")
        recorder.twist("/wheel/twist", T0_NS, 1.0)

    assert [speed.speed_mps for speed in drive_with(write).wheel_speeds()] == [1.0]


def test_a_topic_without_one_usable_message_is_not_chosen(drive_with):
    def write(recorder):
        for index in range(9):
            recorder.twist("/broken", T0_NS + index, NAN)
        recorder.twist("/wheel/twist", T0_NS, 1.0)

    assert [speed.speed_mps for speed in drive_with(write).wheel_speeds()] == [1.0]


class TestTimeOrder:
    def speeds(self, stamps_ns):
        return (WheelSpeed(stamp_ns, 0.0) for stamp_ns in stamps_ns)

    def test_a_long_shuffled_recording_is_sorted_piece_by_piece(self):
        rng = np.random.default_rng(4)
        shuffled = [stamp for begin in range(0, 20_000, 400) for stamp in rng.permutation(400) + begin]
        found = [speed.stamp_ns for speed in in_time_order(self.speeds(shuffled), "test")]
        assert found == list(range(20_000))

    def test_samples_are_given_before_the_last_one_is_read(self):
        read = []

        def endless():
            for stamp_ns in range(10**9):
                read.append(stamp_ns)
                yield WheelSpeed(stamp_ns, 0.0)

        ordered = in_time_order(endless(), "test")
        assert [next(ordered).stamp_ns for _ in range(5)] == [0, 1, 2, 3, 4]
        assert len(read) < 2000

    def test_samples_that_come_far_too_late_are_counted_in_one_warning(self, caplog):
        stamps = [*range(5000, 8000), 10, 20, 30]
        with caplog.at_level(logging.WARNING):
            found = [speed.stamp_ns for speed in in_time_order(self.speeds(stamps), "drive.mcap: /imu")]
        assert found == list(range(5000, 8000))
        (warning,) = caplog.records
        assert "drive.mcap: /imu: 3 samples" in warning.getMessage()
