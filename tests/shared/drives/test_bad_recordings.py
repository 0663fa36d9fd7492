"""Each bad recording is refused with one clear line: what, where, what to do."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from mcap.writer import CompressionType
from rosbags.rosbag2.enums import CompressionMode
from rosbags.typesys import Stores, get_typestore

from fleetmap.drives import open_drive
from fleetmap.errors import CalibrationError, DriveError

T0_NS = 1_650_000_000_123_456_789
FRAME_NS = 100_000_000


def refusal_of(path, error=DriveError, **options):
    """The message of the error that opening and reading the whole recording raises."""
    with pytest.raises(error) as caught:
        for _ in open_drive(path, **options).frames():
            pass
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_a_recording_that_is_not_there(tmp_path):
    assert "there is no recording" in refusal_of(tmp_path / "nothing.mcap")


def test_an_empty_file(tmp_path):
    (tmp_path / "empty.mcap").touch()
    assert "is empty" in refusal_of(tmp_path / "empty.mcap")


def test_a_file_that_is_no_mcap(tmp_path):
    (tmp_path / "notes.mcap").write_text("not a recording at all, but long enough to be one")
    assert "not an MCAP" in refusal_of(tmp_path / "notes.mcap")


@pytest.mark.parametrize("kept", [0.1, 0.002])
def test_a_recording_truncated_before_its_first_message(street, kept):
    path = street()
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    assert "is truncated: no message in it can be read" in refusal_of(path)


def test_flipped_bits_in_the_only_chunk_are_found_by_the_checksum(street):
    path = street(compression=CompressionType.NONE, chunk_size=1_000_000)
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 0xFF
    path.write_bytes(bytes(data))
    assert "is damaged" in refusal_of(path)


def test_a_recording_without_messages(record):
    with record() as recorder:
        pass
    assert "holds no ROS 2 images" in refusal_of(recorder.path)


def test_a_recording_without_images_says_what_it_holds(record):
    with record() as recorder:
        recorder.fix("/gps/fix", T0_NS, (49.0, 8.0, 100.0), "gnss")
    assert "it holds /gps/fix (sensor_msgs/msg/NavSatFix)" in refusal_of(recorder.path)


def test_images_that_are_not_in_cdr_do_not_count(record, street):
    message = get_typestore(Stores.ROS2_JAZZY).types["sensor_msgs/msg/CompressedImage"]
    with record() as recorder:
        recorder.write("/image", message, T0_NS, encoding="json", data=b"{}")
    assert "holds no ROS 2 images" in refusal_of(recorder.path)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "neither JPEG nor PNG"),
        (b"no image at all", "neither JPEG nor PNG"),
        (b"\xff\xd8\xff\xe0 no more", "end in the middle"),
        ("truncated", "end in the middle"),
        (b"\xff\xd8\xff\xdanothing of use\xff\xd9", "refuses"),
    ],
)
def test_an_image_that_cannot_be_decoded_is_named(record, small_camera, pictures, data, reason):
    if data == "truncated":
        whole = cv2.imencode(".jpg", pictures[1])[1].tobytes()
        data = whole[: len(whole) // 2]
    with record() as recorder:
        recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
        recorder.jpeg("/x/image", T0_NS, pictures[0], "cam")
        recorder.compressed("/x/image", T0_NS + FRAME_NS, data, "jpeg", "cam")
    message = refusal_of(recorder.path)
    assert reason in message
    assert f"image 1 of /x/image in {recorder.path} (stamp {T0_NS + FRAME_NS} ns)" in message


def test_a_raw_image_of_an_unknown_encoding_is_named(record, small_camera):
    with record() as recorder:
        recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
        recorder.raw_image("/x/image", T0_NS, np.zeros(48 * 512, np.uint8), "64FC1", "cam", width=64, step=512)
    assert "encoding '64FC1'" in refusal_of(recorder.path)


def test_a_raw_image_shorter_than_its_size_is_named(record, small_camera):
    with record() as recorder:
        recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
        recorder.raw_image("/x/image", T0_NS, np.zeros(48 * 10, np.uint8), "mono8", "cam", width=64, step=10)
    assert "do not make 64x48" in refusal_of(recorder.path)


@pytest.mark.parametrize("late", [-FRAME_NS, 0])
def test_frames_out_of_order_are_refused_and_named(record, small_camera, pictures, late):
    with record() as recorder:
        recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
        recorder.jpeg("/x/image", T0_NS, pictures[0], "cam", log_ns=T0_NS)
        recorder.jpeg("/x/image", T0_NS + FRAME_NS, pictures[1], "cam", log_ns=T0_NS + FRAME_NS)
        recorder.jpeg("/x/image", T0_NS + FRAME_NS + late, pictures[2], "cam", log_ns=T0_NS + 2 * FRAME_NS)
    message = refusal_of(recorder.path)
    assert "frames out of order: image 2 of /x/image" in message


def test_images_that_contradict_their_calibration_are_refused_with_numbers(record, small_camera):
    with record() as recorder:
        recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
        recorder.jpeg("/x/image", T0_NS, np.zeros((24, 32), np.uint8), "cam")
    message = refusal_of(recorder.path, CalibrationError)
    assert "32x24" in message
    assert "64x48" in message


def test_a_message_that_does_not_fit_its_definition_is_refused(record, small_camera, pictures):
    message = get_typestore(Stores.ROS2_JAZZY).types["sensor_msgs/msg/CompressedImage"]
    with record() as recorder:
        recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
        recorder.jpeg("/x/image", T0_NS, pictures[0], "cam")
        recorder.write("/x/image", message, T0_NS + FRAME_NS, data=b"\x00\x01\x00\x00\xff\xff")
    assert "a message of /x/image" in refusal_of(recorder.path)


def test_a_static_transform_that_is_none_is_refused(record, small_camera, pictures):
    with record() as recorder:
        recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
        recorder.jpeg("/x/image", T0_NS, pictures[0], "cam")
        recorder.fix("/fix", T0_NS, (49.0, 8.0, 100.0), "gnss")
        recorder.transforms(T0_NS, ("cam", "gnss", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)))
    with pytest.raises(DriveError, match="from 'cam' to 'gnss' is no rigid transform"):
        open_drive(recorder.path).antenna()


@pytest.mark.parametrize(
    ("mode", "message"), [(CompressionMode.MESSAGE, "compressed one by one"), (CompressionMode.FILE, "zstd -d")]
)
def test_compression_that_is_not_read_names_the_way_out(street, mode, message):
    assert message in refusal_of(street("bag", rosbag2=True, compression_mode=mode))


@pytest.mark.parametrize("text", ["no definition", "uint8[ broken", "other_msgs/Thing thing"])
def test_a_message_definition_that_is_none_is_refused(record, small_camera, text):
    message = get_typestore(Stores.ROS2_JAZZY).types["sensor_msgs/msg/CompressedImage"]
    with record(idl={"sensor_msgs/msg/CompressedImage": text}) as recorder:
        recorder.write("/x/image", message, T0_NS, data=b"\x00\x01\x00\x00")
        recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
    assert "the message definition of /x/image" in refusal_of(recorder.path)


def test_a_folder_without_mcap_names_what_to_do(tmp_path):
    assert "fleetmap convert" in refusal_of(tmp_path)
    (tmp_path / "bag_0.db3").touch()
    assert "ros2 bag convert" in refusal_of(tmp_path)


def test_a_folder_with_two_recordings_asks_for_one(tmp_path):
    (tmp_path / "a.mcap").touch()
    (tmp_path / "b.mcap").touch()
    assert "a.mcap, b.mcap" in refusal_of(tmp_path)
