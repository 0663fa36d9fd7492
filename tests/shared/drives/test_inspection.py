"""What a recording holds and what it lacks."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.drive import GnssFix
from fleetmap.drives.inspection import look_through
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.errors import DriveError
from fleetmap.geodesy import UtmGrid

T0_NS = 1_650_000_000_123_456_789
FRAME_NS = 100_000_000


def test_a_complete_recording_lacks_nothing(street, small_camera):
    found = look_through(street()).info
    assert found.missing == ()
    assert {(t.name, t.message_type, t.message_count) for t in found.topics} == {
        ("/front/image/compressed", "sensor_msgs/msg/CompressedImage", 10),
        ("/front/camera_info", "sensor_msgs/msg/CameraInfo", 10),
        ("/gps/fix", "sensor_msgs/msg/NavSatFix", 10),
        ("/tf_static", "tf2_msgs/msg/TFMessage", 1),
    }
    assert found.images is not None
    assert (found.images.count, found.images.width_px, found.images.height_px) == (10, 64, 48)
    assert found.images.rate_hz == pytest.approx(10.0)
    assert found.images.longest_gap_s == pytest.approx(0.1)
    assert found.camera == small_camera
    assert found.gnss is not None
    assert (found.gnss.fix_count, found.gnss.message_count) == (10, 10)
    assert found.gnss.horizontal_sigma_m == pytest.approx(0.2)
    assert found.gnss.length_m == pytest.approx(9e-6 * 111_200, abs=0.01)
    assert found.antenna is not None
    assert found.antenna.source == "static transform"
    assert (found.start_ns, found.duration_s) == (T0_NS, pytest.approx(0.9))


def test_the_length_of_a_noisy_drive_is_the_way_driven(tmp_path, small_camera, pictures):
    """A circle of 500 m circumference at 10 Hz under 5 cm noise: summing every step would give about 8 % more."""
    rng = np.random.default_rng(0)
    angles = np.linspace(0.0, 2 * np.pi, 2001)
    radius = 500.0 / (2 * np.pi)
    points = np.array([455_000.0, 5_425_000.0, 115.0]) + np.stack(
        [radius * np.cos(angles), radius * np.sin(angles), np.zeros(2001)], axis=1
    )
    lat, lon, height = UtmGrid(32632).to_geodetic(points + rng.normal(0.0, 0.05, points.shape))
    with DriveWriter(tmp_path / "circle.mcap", small_camera) as writer:
        writer.write_image(T0_NS, pictures[0])
        for index in range(2001):
            fix = GnssFix(T0_NS + index * FRAME_NS, lat[index], lon[index], height[index], np.eye(3) * 0.0025)
            writer.write_fix(fix, "camera")
    found = look_through(tmp_path / "circle.mcap").info
    assert found.gnss is not None
    assert found.gnss.length_m == pytest.approx(500.0 / 0.99962, rel=0.005)


def test_the_longest_gaps_are_found(record, small_camera, pictures):
    with record() as recorder:
        recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
        for index in (0, 1, 2, 7):
            recorder.jpeg("/x/image", T0_NS + index * FRAME_NS, pictures[0], "cam")
        for index in (0, 1, 4):
            recorder.fix("/fix", T0_NS + index * FRAME_NS, (49.0, 8.0, 100.0), "cam")
    found = look_through(recorder.path).info
    assert found.images is not None
    assert found.gnss is not None
    assert found.images.longest_gap_s == pytest.approx(0.5)
    assert found.gnss.longest_gap_s == pytest.approx(0.3)


def lacks(found, what):
    return [line for line in found.missing if line.startswith(what + ":")]


def test_an_empty_recording_lacks_everything(record):
    with record() as recorder:
        pass
    found = look_through(recorder.path).info
    assert lacks(found, "images")
    assert lacks(found, "GNSS")
    assert (found.images, found.camera, found.gnss, found.antenna, found.start_ns) == (None,) * 5


def test_fixes_without_images_are_reported(record):
    with record() as recorder:
        recorder.fix("/fix", T0_NS, (49.0, 8.0, 100.0), "gnss")
        recorder.fix("/fix", T0_NS + FRAME_NS, (49.0, 8.0, 100.0), "gnss", status=-1)
    found = look_through(recorder.path).info
    assert lacks(found, "images")
    assert found.gnss is not None
    assert (found.gnss.fix_count, found.gnss.message_count) == (1, 2)
    assert found.start_ns == T0_NS


def test_images_without_the_rest_are_reported(record, pictures):
    with record() as recorder:
        recorder.jpeg("/x/image", T0_NS, pictures[0], "cam")
    found = look_through(recorder.path).info
    assert lacks(found, "calibration")
    assert lacks(found, "GNSS")
    assert found.images is not None
    assert found.images.rate_hz is None


def test_each_fault_is_listed_in_one_report(record, small_camera, pictures):
    with record() as recorder:
        recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
        recorder.jpeg("/x/image", T0_NS, np.zeros((24, 32), np.uint8), "cam", log_ns=T0_NS)
        recorder.jpeg("/x/image", T0_NS - 1, pictures[0], "cam", log_ns=T0_NS + 1)
        recorder.fix("/fix", T0_NS, (49.0, 8.0, 100.0), "gnss", status=-1)
    found = look_through(recorder.path).info
    assert "32x24" in lacks(found, "calibration for the images' size")[0]
    assert "image 1" in lacks(found, "images in time order")[0]
    assert "none of the 1 messages" in lacks(found, "GNSS")[0]
    assert "--antenna-offset" in lacks(found, "antenna")[0]


def test_an_unreadable_image_is_listed(record, small_camera):
    with record() as recorder:
        recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
        recorder.compressed("/x/image", T0_NS, b"nothing", "jpeg", "cam")
    found = look_through(recorder.path).info
    assert lacks(found, "readable images")
    assert found.images is not None
    assert found.images.width_px is None


def test_two_cameras_are_listed_unless_one_is_chosen(record, small_camera, pictures):
    with record() as recorder:
        for name in ("a", "b"):
            recorder.camera_info(f"/{name}/camera_info", T0_NS, small_camera, name)
            recorder.jpeg(f"/{name}/image", T0_NS, pictures[0], name)
    assert "--image-topic" in lacks(look_through(recorder.path).info, "images")[0]
    assert not lacks(look_through(recorder.path, image_topic="/b/image").info, "images")
    with pytest.raises(DriveError, match="no images on /c"):
        look_through(recorder.path, image_topic="/c")


def test_a_file_that_cannot_be_read_is_an_error(street):
    path = street()
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DriveError, match="truncated"):
        look_through(path)
