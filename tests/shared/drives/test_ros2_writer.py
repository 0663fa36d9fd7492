"""What the writer writes, this project's reader and other tools' readers read."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from fleetmap.camera import Camera
from fleetmap.drive import GnssFix, ImuSample, WheelSpeed
from fleetmap.drives import open_drive
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.errors import CalibrationError, OutputExistsError
from fleetmap.geometry import Pose, rotations_from_quat_xyzw, so3_exp

T0_NS = 1_650_000_000_123_456_789
FRAME_NS = 100_000_000
CAMERA = Camera(64, 48, 50.0, 51.0, 31.5, 23.5, (-0.3, 0.1, 0.001, -0.002, 0.01))
COVARIANCE = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, 0.2], [0.5, 0.2, 16.0]])


@pytest.fixture
def written(tmp_path, pictures) -> Path:
    path = tmp_path / "drive.mcap"
    with DriveWriter(path, CAMERA, camera_frame_id="cam") as writer:
        writer.write_static_transform(
            "cam", "gnss", Pose(so3_exp(np.array([0.1, 0.2, 0.3])), np.array([1.0, -2.0, 3.0]))
        )
        for index in (5, 0, 1, 9, 2, 3, 4, 6, 8, 7):
            writer.write_image(T0_NS + index * FRAME_NS, pictures[index], png=True)
        for index in (2, 0, 1):
            fix = GnssFix(T0_NS + index, 49.0 + index, -8.4321, 123.456 + index, COVARIANCE)
            writer.write_fix(fix, "gnss")
    return path


def test_everything_comes_back(written, pictures):
    drive = open_drive(written)
    frames = list(drive.frames())
    assert [frame.stamp_ns for frame in frames] == [T0_NS + index * FRAME_NS for index in range(10)]
    assert all(np.array_equal(frame.image, picture) for frame, picture in zip(frames, pictures, strict=True))
    assert drive.camera == CAMERA
    fixes = drive.gnss_fixes()
    assert [(f.stamp_ns, f.lat_deg, f.lon_deg, f.height_m) for f in fixes] == [
        (T0_NS + index, 49.0 + index, -8.4321, 123.456 + index) for index in range(3)
    ]
    assert fixes[0].covariance_enu_m2 == pytest.approx(COVARIANCE)
    assert drive.antenna().source == "static transform"
    assert drive.antenna().position_in_cam_m == pytest.approx([1.0, -2.0, 3.0])


def test_another_tool_reads_the_same(written):
    with AnyReader([written]) as reader:
        types = {topic: info.msgtype for topic, info in reader.topics.items()}
        assert types == {
            "/camera/image/compressed": "sensor_msgs/msg/CompressedImage",
            "/camera/camera_info": "sensor_msgs/msg/CameraInfo",
            "/gnss/fix": "sensor_msgs/msg/NavSatFix",
            "/tf_static": "tf2_msgs/msg/TFMessage",
        }
        messages = [
            (connection.topic, log_time, reader.deserialize(raw, connection.msgtype))
            for connection, log_time, raw in reader.messages()
        ]
    images = [message for topic, _, message in messages if topic == "/camera/image/compressed"]
    infos = [message for topic, _, message in messages if topic == "/camera/camera_info"]
    fixes = [message for topic, _, message in messages if topic == "/gnss/fix"]
    (mounting,) = [message for topic, _, message in messages if topic == "/tf_static"]
    assert [message.format for message in images] == ["png"] * 10
    assert (len(infos), infos[0].header.frame_id, infos[0].distortion_model) == (10, "cam", "plumb_bob")
    assert infos[0].k == pytest.approx(CAMERA.matrix.reshape(9))
    assert infos[0].p.reshape(3, 4)[:, :3] == pytest.approx(CAMERA.matrix)
    assert infos[0].d == pytest.approx(CAMERA.distortion)
    assert (fixes[0].status.status, fixes[0].position_covariance_type) == (0, 3)
    assert fixes[0].position_covariance == pytest.approx(COVARIANCE.reshape(9))
    transform = mounting.transforms[0]
    q = transform.transform.rotation
    assert (transform.header.frame_id, transform.child_frame_id) == ("cam", "gnss")
    turn = rotations_from_quat_xyzw(np.array([q.x, q.y, q.z, q.w]))
    assert turn == pytest.approx(so3_exp(np.array([0.1, 0.2, 0.3])))
    log_times = [log_time for _, log_time, _ in messages]
    assert log_times == sorted(log_times)
    assert log_times[0] == T0_NS


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("plumb_bob", (-0.3, 0.1, 0.001, -0.002, 0.01)),
        ("rational_polynomial", (-0.3, 0.1, 0.001, -0.002, 0.01, 0.02, -0.03, 0.004)),
        ("equidistant", (0.01, -0.02, 0.003, -0.0004)),
    ],
)
def test_every_distortion_model_is_written_by_its_ros_name(
    tmp_path, pictures, model, coefficients, read_by_rosbags
):
    camera = Camera(64, 48, 50.0, 51.0, 31.5, 23.5, coefficients, model)
    with DriveWriter(tmp_path / "drive.mcap", camera) as writer:
        writer.write_image(T0_NS, pictures[0])
    (info,) = read_by_rosbags(tmp_path / "drive.mcap")["/camera/camera_info"]
    assert (info.distortion_model, tuple(info.d)) == (model, coefficients)


def test_an_imu_measurement_is_read_by_another_tool(tmp_path, read_by_rosbags):
    gyro_covariance = np.diag([1e-4, 2e-4, 3e-4])
    with DriveWriter(tmp_path / "drive.mcap", None) as writer:
        sample = ImuSample(T0_NS, np.array([0.1, -0.2, 0.3]), np.array([0.5, -0.25, 9.81]))
        writer.write_imu(sample, "imu", angular_velocity_covariance=gyro_covariance)
    (imu,) = read_by_rosbags(tmp_path / "drive.mcap")["/imu/data"]
    gyro, accelerometer = imu.angular_velocity, imu.linear_acceleration
    assert (gyro.x, gyro.y, gyro.z) == (0.1, -0.2, 0.3)
    assert (accelerometer.x, accelerometer.y, accelerometer.z) == (0.5, -0.25, 9.81)
    assert imu.header.frame_id == "imu"
    assert imu.orientation_covariance[0] == -1.0  # it measures no orientation
    assert np.array_equal(imu.angular_velocity_covariance.reshape(3, 3), gyro_covariance)
    assert not imu.linear_acceleration_covariance.any()


def test_a_wheel_speed_is_the_twist_along_x(tmp_path, read_by_rosbags):
    with DriveWriter(tmp_path / "drive.mcap", None) as writer:
        writer.write_wheel_speed(WheelSpeed(T0_NS, -1.25))
    (speed,) = read_by_rosbags(tmp_path / "drive.mcap")["/vehicle/speed"]
    linear, angular = speed.twist.linear, speed.twist.angular
    assert speed.header.frame_id == "base_link"
    assert (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z) == (-1.25, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_a_depth_image_is_in_millimetres_with_zero_for_no_return(tmp_path, read_by_rosbags):
    depth_m = np.full((48, 64), 1.2344, dtype=np.float32)
    depth_m[0, :6] = [0.0, np.nan, np.inf, -1.0, 65.535, 65.6]
    with DriveWriter(tmp_path / "drive.mcap", CAMERA, camera_frame_id="cam", compress_chunks=True) as writer:
        writer.write_depth(T0_NS, depth_m)
    messages = read_by_rosbags(tmp_path / "drive.mcap")
    (depth,), (info,) = messages["/camera/depth/image"], messages["/camera/depth/camera_info"]
    assert (depth.encoding, depth.height, depth.width, depth.step) == ("16UC1", 48, 64, 128)
    millimetres = depth.data.view("<u2").reshape(48, 64)
    assert millimetres[0, :6].tolist() == [0, 0, 0, 0, 65535, 0]
    assert np.unique(millimetres[1:]).tolist() == [1234]
    assert (depth.header.frame_id, info.header.frame_id) == ("cam", "cam")
    assert info.k == pytest.approx(CAMERA.matrix.reshape(9))


def test_a_depth_image_of_another_size_is_refused_with_the_numbers(tmp_path):
    with (
        pytest.raises(CalibrationError, match=r"32x24 .* 64x48"),
        DriveWriter(tmp_path / "drive.mcap", CAMERA) as writer,
    ):
        writer.write_depth(T0_NS, np.ones((24, 32), dtype=np.float32))
    assert list(tmp_path.iterdir()) == []


def test_a_scan_is_read_by_another_tool(tmp_path, read_by_rosbags):
    ranges_m = np.array([1.0, np.inf, 3.5, 2.25, 0.5], dtype=np.float32)
    with DriveWriter(tmp_path / "drive.mcap", None) as writer:
        writer.write_scan(
            T0_NS, ranges_m, angle_min_rad=-1.0, angle_increment_rad=0.5, range_min_m=0.1, range_max_m=30.0,
            scan_time_s=0.1,
        )  # fmt: skip
    (scan,) = read_by_rosbags(tmp_path / "drive.mcap")["/scan"]
    assert np.array_equal(scan.ranges, ranges_m)
    assert (scan.angle_min, scan.angle_max, scan.angle_increment) == (-1.0, 1.0, 0.5)
    assert (scan.range_min, scan.range_max) == pytest.approx((0.1, 30.0))
    assert (scan.scan_time, scan.time_increment) == pytest.approx((0.1, 0.02))


def write_every_sensor(path: Path, pictures: list[np.ndarray], *, compress_chunks: bool) -> bytes:
    with DriveWriter(path, CAMERA, compress_chunks=compress_chunks) as writer:
        for index, picture in enumerate(pictures):
            stamp_ns = T0_NS + index * FRAME_NS
            writer.write_image(stamp_ns, picture)
            writer.write_depth(stamp_ns, picture / 20.0)
            writer.write_imu(ImuSample(stamp_ns + 1, np.zeros(3), np.array([0.0, 0.0, 9.8])), "imu")
            writer.write_wheel_speed(WheelSpeed(stamp_ns + 2, 5.0))
            writer.write_fix(GnssFix(stamp_ns + 3, 49.0, 8.0, 100.0, COVARIANCE), "camera")
    return path.read_bytes()


@pytest.mark.parametrize("compress_chunks", [False, True])
def test_the_same_calls_give_the_same_bytes(tmp_path, pictures, compress_chunks):
    first, second = (
        write_every_sensor(tmp_path / name, pictures, compress_chunks=compress_chunks)
        for name in ("a.mcap", "b.mcap")
    )
    assert first == second


def test_compressed_chunks_are_smaller_and_hold_the_same(tmp_path, pictures, read_by_rosbags):
    plain = write_every_sensor(tmp_path / "plain.mcap", pictures, compress_chunks=False)
    packed = write_every_sensor(tmp_path / "packed.mcap", pictures, compress_chunks=True)
    assert 0 < len(packed) < 0.6 * len(plain)
    before, after = read_by_rosbags(tmp_path / "plain.mcap"), read_by_rosbags(tmp_path / "packed.mcap")
    assert before.keys() == after.keys()
    for topic in ("/camera/depth/image", "/camera/image/compressed"):
        assert [m.data.tobytes() for m in before[topic]] == [m.data.tobytes() for m in after[topic]]


def test_depth_images_beside_the_camera_do_not_confuse_the_choice_of_topics(tmp_path, pictures):
    write_every_sensor(tmp_path / "drive.mcap", pictures, compress_chunks=True)
    drive = open_drive(tmp_path / "drive.mcap")
    assert drive.camera == CAMERA
    assert drive.frame_count == len(pictures)
    frames = list(drive.frames())
    assert np.abs(frames[3].image.astype(float) - pictures[3]).mean() < 2.0


def test_a_jpeg_passes_through_byte_by_byte(tmp_path, pictures):
    jpeg = cv2.imencode(".jpg", pictures[0])[1].tobytes()
    with DriveWriter(tmp_path / "drive.mcap", CAMERA) as writer:
        writer.write_jpeg(T0_NS, jpeg)
    with AnyReader([tmp_path / "drive.mcap"]) as reader:
        (image,) = [
            reader.deserialize(raw, connection.msgtype)
            for connection, _, raw in reader.messages()
            if connection.topic == "/camera/image/compressed"
        ]
    assert image.data.tobytes() == jpeg
    assert image.format == "jpeg"


def test_a_jpeg_of_the_writer_is_close_to_the_image(tmp_path, pictures):
    with DriveWriter(tmp_path / "drive.mcap", CAMERA) as writer:
        writer.write_image(T0_NS, pictures[0])
    (frame,) = open_drive(tmp_path / "drive.mcap").frames()
    assert 0.0 < np.abs(frame.image.astype(float) - pictures[0]).mean() < 1.0


def write_and_fail(unopened, picture):
    with unopened as writer:
        writer.write_image(T0_NS, picture)
        raise RuntimeError("on the way")


def test_an_error_in_the_block_leaves_nothing_behind(tmp_path, pictures):
    with pytest.raises(RuntimeError, match="on the way"):
        write_and_fail(DriveWriter(tmp_path / "drive.mcap", CAMERA), pictures[0])
    assert list(tmp_path.iterdir()) == []


def test_an_existing_recording_is_kept_unless_forced(written, pictures):
    before = written.read_bytes()
    with pytest.raises(OutputExistsError, match="--force"):
        DriveWriter(written, CAMERA)
    with pytest.raises(RuntimeError, match="on the way"):
        write_and_fail(DriveWriter(written, CAMERA, force=True), pictures[0])
    assert written.read_bytes() == before
    with DriveWriter(written, CAMERA, force=True) as writer:
        writer.write_image(T0_NS, pictures[0])
    assert open_drive(written).frame_count == 1


def test_a_disk_that_refuses_is_one_clear_error_and_leaves_nothing(tmp_path):
    script = """
import resource, signal, sys
from pathlib import Path
import numpy as np
from fleetmap.camera import Camera
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.errors import StorageError
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
image = np.random.default_rng(0).integers(0, 256, (480, 640), dtype=np.uint8)
try:
    with DriveWriter(Path(sys.argv[1]), Camera(640, 480, 500.0, 500.0, 320.0, 240.0)) as writer:
        for index in range(10):
            writer.write_image(10**18 + index, image)
except StorageError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "drive.mcap")],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ},
    )
    assert f"cannot write {tmp_path / 'drive.mcap'}" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_a_long_recording_is_written_in_bounded_memory(tmp_path):
    """200 MB of images and depth pass through the writer while the process grows by less than 20 MB."""
    script = """
import resource, sys
from pathlib import Path
import numpy as np
from fleetmap.camera import Camera
from fleetmap.drives.ros2_writer import DriveWriter
png, depth_m = np.random.default_rng(0).bytes(300_000), np.ones((480, 640), dtype=np.float32)
with DriveWriter(Path(sys.argv[1]), Camera(640, 480, 500.0, 500.0, 320.0, 240.0), compress_chunks=True) as writer:
    for index in range(220):
        if index == 20:
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        writer.write_png(10**18 + index, png)
        writer.write_depth(10**18 + index, depth_m)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e3)
"""
    path = tmp_path / "long.mcap"
    done = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=True)
    assert path.stat().st_size > 40e6
    assert float(done.stdout) < 20.0


def test_a_recording_can_lack_calibration(tmp_path, pictures):
    with DriveWriter(tmp_path / "drive.mcap", None) as writer:
        writer.write_image(T0_NS, pictures[0])
    with AnyReader([tmp_path / "drive.mcap"]) as reader:
        assert list(reader.topics) == ["/camera/image/compressed"]


def test_a_long_recording_is_not_read_into_memory(tmp_path):
    """200 MB of images pass through the reader while the process grows by less than 60 MB."""
    script = """
import resource, sys
from pathlib import Path
import numpy as np
from fleetmap.camera import Camera
from fleetmap.drives import open_drive
from fleetmap.drives.ros2_writer import DriveWriter
image = np.random.default_rng(0).integers(0, 256, (1000, 1000), dtype=np.uint8)
path = Path(sys.argv[1])
from fleetmap.drives.image_codec import encode_image
png = encode_image(image, png=True)
with DriveWriter(path, Camera(1000, 1000, 500.0, 500.0, 320.0, 240.0)) as writer:
    for index in range(200):
        writer.write_png(10**18 + index, png)
drive = open_drive(path)
frames = drive.frames()
next(frames)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
count = 1 + sum(1 for _ in frames)
print(count, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e3)
"""
    path = tmp_path / "long.mcap"
    done = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=True)
    count, growth_mb = done.stdout.split()
    assert int(count) == 200
    assert path.stat().st_size > 190e6
    assert float(growth_mb) < 60.0
