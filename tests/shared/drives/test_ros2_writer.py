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
from fleetmap.drive import GnssFix
from fleetmap.drives import open_drive
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.errors import OutputExistsError
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
