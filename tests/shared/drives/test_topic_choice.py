"""Which topics count, and what is said about those that do not."""

from __future__ import annotations

import logging

import cv2
import numpy as np
import pytest

from fleetmap.drives import open_drive
from fleetmap.drives.mcap_file import McapFile
from fleetmap.drives.topic_reading import kind_of
from fleetmap.errors import CalibrationError, DriveError

T0_NS = 1_650_000_000_123_456_789


@pytest.fixture
def with_colour(record, small_camera, pictures):
    """A recording with one good camera, and whatever a test writes besides."""

    def build(write):
        with record() as recorder:
            recorder.camera_info("/camera/color/camera_info", T0_NS, small_camera, "cam")
            recorder.jpeg("/camera/color/image/compressed", T0_NS, pictures[0], "cam")
            write(recorder)
        return recorder.path

    return build


def raw_depth(recorder, encoding):
    data = np.zeros((48, 64), "<u2" if encoding == "16UC1" else "<f4").view(np.uint8)
    recorder.raw_image("/camera/depth/image", T0_NS, data, encoding, "depth", width=64, step=data.shape[1])


def compressed_depth(recorder, recorded_format):
    png = cv2.imencode(".png", np.zeros((48, 64), np.uint16))[1].tobytes()
    recorder.compressed("/camera/depth/image/compressedDepth", T0_NS, png, recorded_format, "depth")


DEPTH = [
    (raw_depth, "16UC1"),
    (raw_depth, "32FC1"),
    (compressed_depth, "16UC1; compressedDepth png"),
    (compressed_depth, "32FC1; compressedDepth"),
    (compressed_depth, "16UC1; png compressed "),
]


@pytest.mark.parametrize(("write_depth", "encoding"), DEPTH)
def test_a_depth_topic_does_not_compete_with_the_camera(with_colour, write_depth, encoding):
    drive = open_drive(with_colour(lambda recorder: write_depth(recorder, encoding)))
    assert drive.frame_count == 1
    assert next(drive.frames()).image.shape == (48, 64)


@pytest.mark.parametrize(("write_depth", "encoding"), DEPTH)
def test_a_recording_of_depth_alone_has_no_images(record, write_depth, encoding):
    with record() as recorder:
        write_depth(recorder, encoding)
    with pytest.raises(DriveError, match=r"holds depth images only \(/camera/depth/image"):
        open_drive(recorder.path)


@pytest.mark.parametrize(("write_depth", "encoding"), DEPTH)
def test_depth_is_no_camera_also_when_it_is_asked_for(with_colour, write_depth, encoding):
    path = with_colour(lambda recorder: write_depth(recorder, encoding))
    topic = "/camera/depth/image" if write_depth is raw_depth else "/camera/depth/image/compressedDepth"
    with pytest.raises(DriveError, match=f"{topic} in .* holds depth images"):
        open_drive(path, image_topic=topic)


def test_a_second_camera_has_to_be_chosen_also_beside_depth(with_colour, pictures):
    def write(recorder):
        raw_depth(recorder, "16UC1")
        recorder.jpeg("/camera/rear/image/compressed", T0_NS, pictures[0], "rear")

    with pytest.raises(DriveError, match=r"holds 2 image topics: /camera/color.*, /camera/rear.*--image-topic"):
        open_drive(with_colour(write))


UNKNOWN = [
    ("vendor.Lidar", "protobuf", ("protobuf", b"broken descriptors"), b"\x01\x02"),
    ("vendor.Imu", "protobuf", ("protobuf", b"broken descriptors"), b"\x01\x02"),
    ("foxglove.RawImage", "json", ("jsonschema", b"{}"), b"{}"),
    ("foxglove.RawImage", "flatbuffer", ("flatbuffer", b"\0\0"), b"\0\0"),
    ("vendor_msgs/msg/Radar", "cdr", ("ros2msg", b"int32 x"), b"\0\1\0\0"),
    ("", "json", ("", b""), b"{}"),
    ("sensor_msgs/msg/Image", "x-secret", ("ros2msg", b""), b"?"),
]


@pytest.mark.parametrize(("type_name", "encoding", "schema", "data"), UNKNOWN)
def test_unknown_types_and_encodings_beside_good_topics_do_no_harm(with_colour, type_name, encoding, schema, data):
    path = with_colour(lambda recorder: recorder.other("/unknown", type_name, encoding, schema, data))
    drive = open_drive(path)
    assert len(list(drive.frames())) == 1
    assert drive.gnss_fixes() == []
    assert list(drive.imu_samples()) == []
    assert list(drive.wheel_speeds()) == []
    assert drive.antenna().source == "assumed at the camera"
    topics = McapFile(path).topics
    assert topics["/unknown"].message_count == 1
    assert kind_of(topics["/unknown"]) is None


def test_a_file_of_unknown_things_only_is_one_error_that_lists_them(record):
    with record() as recorder:
        for number, (type_name, encoding, schema, data) in enumerate(UNKNOWN):
            recorder.other(f"/unknown/{number}", type_name, encoding, schema, data)
    with pytest.raises(DriveError) as caught:
        open_drive(recorder.path)
    message = str(caught.value)
    assert "\n" not in message
    for part in (
        "/unknown/0 (vendor.Lidar)",
        "/unknown/2 (foxglove.RawImage in json)",
        "/unknown/3 (foxglove.RawImage in flatbuffer)",
        "/unknown/5 (no type in json)",
        "/unknown/6 (sensor_msgs/msg/Image in x-secret)",
    ):
        assert part in message


def test_a_second_image_topic_that_cannot_be_read_is_left_out_with_a_warning(with_colour, caplog):
    def write(recorder):
        recorder.other("/broken", "sensor_msgs/msg/Image", "cdr", ("ros2msg", b"uint8[ broken"), b"\0\1\0\0")

    path = with_colour(write)
    with caplog.at_level(logging.WARNING):
        assert len(list(open_drive(path).frames())) == 1
    (warning,) = caplog.records
    assert "/broken is left out" in warning.getMessage()
    with pytest.raises(DriveError, match="message definition of /broken"):
        list(open_drive(path, image_topic="/broken").frames())


class TestRegionOfTheSensor:
    """The calibration is of the whole sensor; images may be a part of it, or binned."""

    @pytest.fixture
    def camera_of(self, record, small_camera, pictures):
        def read(shape, **options):
            with record() as recorder:
                recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam", **options)
                recorder.jpeg("/x/image", T0_NS, np.zeros(shape, np.uint8), "cam")
            drive = open_drive(recorder.path)
            list(drive.frames())
            return drive.camera

        return read

    def test_binned_images_see_the_same_rays(self, camera_of, small_camera):
        binned = camera_of((24, 32), binning=(2, 2))
        assert (binned.width_px, binned.height_px) == (32, 24)
        # The superpixel (10, 5) is made of the pixels (20..21, 10..11), whose middle is (20.5, 10.5).
        ray, expected = binned.unproject(np.array([[10.0, 5.0]])), small_camera.unproject(np.array([[20.5, 10.5]]))
        assert ray == pytest.approx(expected, abs=1e-12)

    def test_a_region_sees_the_same_rays(self, camera_of, small_camera):
        part = camera_of((20, 30), region=(8, 16, 20, 30))
        assert (part.width_px, part.height_px) == (30, 20)
        ray, expected = part.unproject(np.array([[3.0, 4.0]])), small_camera.unproject(np.array([[11.0, 20.0]]))
        assert ray == pytest.approx(expected, abs=1e-12)

    def test_a_region_may_be_binned(self, camera_of, small_camera):
        part = camera_of((10, 10), region=(8, 16, 20, 30), binning=(3, 2))
        ray, expected = part.unproject(np.array([[2.0, 4.0]])), small_camera.unproject(np.array([[15.0, 24.5]]))
        assert ray == pytest.approx(expected, abs=1e-12)

    def test_the_whole_sensor_as_a_region_changes_nothing(self, camera_of, small_camera):
        assert camera_of((48, 64), region=(0, 0, 48, 64), binning=(1, 1)) == small_camera

    def test_images_that_contradict_their_region_are_refused_with_the_numbers(self, camera_of):
        with pytest.raises(CalibrationError, match="has 64x48 pixels, its calibration says 32x24"):
            camera_of((48, 64), binning=(2, 2))

    def test_a_region_outside_the_sensor_is_refused_with_the_numbers(self, camera_of):
        with pytest.raises(CalibrationError, match=r"region of 60x20 pixels from \(8, 16\) is not inside 64x48"):
            camera_of((20, 60), region=(8, 16, 20, 60))


@pytest.mark.parametrize(
    ("topic", "is_rectified"),
    [
        ("/x/image_rect/compressed", True),
        ("/x/image_rect_color", True),
        ("/zed/left/rect/image", True),
        ("/x/image_rectified", True),
        ("/x/image_raw", False),
        ("/x/direct/image", False),
        ("/rectangle/image", False),
    ],
)
def test_rectified_images_are_recognised_by_their_topic(record, small_camera, pictures, topic, is_rectified):
    P = np.array([[40.0, 0, 30, -12.0], [0, 41, 20, 0], [0, 0, 1, 0]])  # with the shift of a right stereo camera
    with record() as recorder:
        recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam", p=P)
        recorder.jpeg(topic, T0_NS, pictures[0], "cam")
    camera = open_drive(recorder.path).camera
    assert camera.fx_px == (40.0 if is_rectified else small_camera.fx_px)
    assert camera.has_distortion != is_rectified
