"""What ROS 1 bags become in MCAP, and Foxglove's messages as ROS messages."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from fleetmap.drives import open_drive
from fleetmap.errors import DriveError

T0_NS = 1_650_000_000_123_456_789
FRAME_NS = 100_000_000


def jpeg_of(picture):
    return np.frombuffer(cv2.imencode(".jpg", picture)[1].tobytes(), np.uint8)


class Ros1Recorder:
    """Writes ROS 1 messages with what ``mcap convert`` makes of a bag: encoding ros1, schemas ros1msg."""

    def __init__(self, recorder, *, definitions=True):
        self.types = get_typestore(Stores.ROS1_NOETIC)
        self.recorder, self.definitions = recorder, definitions

    def write(self, topic, message):
        name = message.__msgtype__
        text = self.types.generate_msgdef(name, ros_version=1)[0] if self.definitions else ""
        data = bytes(self.types.serialize_ros1(message, name))
        self.recorder.other(topic, name.replace("/msg/", "/"), "ros1", ("ros1msg", text.encode()), data)

    def make(self, name, *fields):
        return self.types.types[name](*fields)

    def header(self, stamp_ns, frame_id):
        time = self.make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 1_000_000_000))
        return self.make("std_msgs/msg/Header", 7, time, frame_id)


@pytest.mark.parametrize("definitions", [True, False])
def test_a_ros_1_recording_is_a_drive(record, small_camera, pictures, definitions):
    P = np.hstack([small_camera.matrix, np.zeros((3, 1))])
    with record() as recorder:
        ros1 = Ros1Recorder(recorder, definitions=definitions)
        roi = ros1.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        ros1.write(
            "/x/camera_info",
            ros1.make(
                "sensor_msgs/msg/CameraInfo", ros1.header(T0_NS, "/cam"), 48, 64, "plumb_bob",
                np.array(small_camera.distortion), small_camera.matrix.ravel(), np.eye(3).ravel(), P.ravel(),
                0, 0, roi,
            ),
        )  # fmt: skip
        for index in range(3):
            header = ros1.header(T0_NS + index * FRAME_NS, "/cam")
            image = ros1.make("sensor_msgs/msg/CompressedImage", header, "jpeg", jpeg_of(pictures[index]))
            ros1.write("/x/image/compressed", image)
        status = ros1.make("sensor_msgs/msg/NavSatStatus", 0, 1)
        fix = ("sensor_msgs/msg/NavSatFix", ros1.header(T0_NS, "/cam"), status, 49.0, 8.4, 120.0)
        ros1.write("/fix", ros1.make(*fix, (np.eye(3) * 0.04).ravel(), 3))
    drive = open_drive(recorder.path)
    frames = list(drive.frames())
    assert [frame.stamp_ns for frame in frames] == [T0_NS + index * FRAME_NS for index in range(3)]
    for frame, picture in zip(frames, pictures[:3], strict=True):
        assert 0.0 < np.abs(frame.image.astype(float) - picture).mean() < 2.0
    assert drive.camera == small_camera
    assert drive.gnss_fixes()[0].lat_deg == 49.0
    assert drive.antenna().source == "same frame"


def test_a_damaged_ros_1_message_is_refused(record):
    with record() as recorder:
        recorder.other("/image", "sensor_msgs/CompressedImage", "ros1", ("ros1msg", b""), b"\xff\xff\xff")
    with pytest.raises(DriveError, match=r"a message of /image .* is no sensor_msgs/CompressedImage in ROS 1"):
        list(open_drive(recorder.path).frames())


FOXGLOVE_IMAGE = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
FOXGLOVE_CALIBRATION = """builtin_interfaces/Time timestamp
string frame_id
uint32 width
uint32 height
string distortion_model
float64[] d
float64[9] k
float64[9] r
float64[12] p
"""


def test_foxglove_messages_in_ros_2_are_read(record, small_camera, pictures):
    store = get_typestore(Stores.ROS2_HUMBLE)
    image_type, calibration_type = "foxglove_msgs/msg/CompressedImage", "foxglove_msgs/msg/CameraCalibration"
    store.register(get_types_from_msg(FOXGLOVE_IMAGE, image_type))
    store.register(get_types_from_msg(FOXGLOVE_CALIBRATION, calibration_type))

    def write(recorder, topic, message):
        text = store.generate_msgdef(message.__msgtype__, ros_version=2)[0].encode()
        data = bytes(store.serialize_cdr(message, message.__msgtype__))
        recorder.other(topic, message.__msgtype__, "cdr", ("ros2msg", text), data)

    K, P = small_camera.matrix, np.hstack([small_camera.matrix, np.zeros((3, 1))])
    with record() as recorder:
        time = store.types["builtin_interfaces/msg/Time"](*divmod(T0_NS, 1_000_000_000))
        calibration = store.types[calibration_type](
            time,
            "cam",
            64,
            48,
            "plumb_bob",
            np.array(small_camera.distortion),
            K.ravel(),
            np.eye(3).ravel(),
            P.ravel(),
        )
        write(recorder, "/calibration", calibration)
        write(recorder, "/image", store.types[image_type](time, "cam", jpeg_of(pictures[0]), "jpeg"))
    drive = open_drive(recorder.path)
    (frame,) = drive.frames()
    assert frame.stamp_ns == T0_NS
    assert 0.0 < np.abs(frame.image.astype(float) - pictures[0]).mean() < 2.0
    assert drive.camera == small_camera
