"""Recordings that other tools wrote."""

from __future__ import annotations

import logging
from dataclasses import replace

import cv2
import numpy as np
import pytest
from rosbags.rosbag2.enums import CompressionMode

from fleetmap.drives import open_drive
from fleetmap.drives.value_checks import UNKNOWN_COVARIANCE_SIGMA_M
from fleetmap.errors import CalibrationError, DriveError

T0_NS = 1_650_000_000_123_456_789
FRAME_NS = 100_000_000


def assert_is_the_street(drive, camera, pictures):
    frames = list(drive.frames())
    assert [frame.stamp_ns for frame in frames] == [T0_NS + index * FRAME_NS for index in range(10)]
    for frame, picture in zip(frames, pictures, strict=True):
        assert frame.image.shape == (48, 64)
        assert frame.image.dtype == np.uint8
        assert 0.0 < np.abs(frame.image.astype(float) - picture).mean() < 2.0
    assert drive.frame_count == 10
    assert drive.camera == camera
    fixes = drive.gnss_fixes()
    assert [fix.stamp_ns for fix in fixes] == [T0_NS + index * FRAME_NS + FRAME_NS // 3 for index in range(10)]
    assert [fix.lat_deg for fix in fixes] == [49.0 + 1e-6 * index for index in range(10)]
    assert fixes[0].covariance_enu_m2 == pytest.approx(np.eye(3) * 0.04)
    assert drive.antenna().source == "static transform"
    assert drive.antenna().position_in_cam_m == pytest.approx([0.1, -1.5, -0.4])


def test_every_kind_of_mcap_file_gives_the_same_drive(street, kind_of_file, small_camera, pictures):
    assert_is_the_street(open_drive(street(**kind_of_file)), small_camera, pictures)


def test_a_rosbag2_folder_is_opened_by_its_folder(street, small_camera, pictures):
    folder = street("bag", rosbag2=True)
    assert folder.is_dir()
    drive = open_drive(folder)
    assert_is_the_street(drive, small_camera, pictures)
    assert drive.name == "bag.mcap"


COMPRESSED_IMAGE_IDL = f"""{"=" * 80}
IDL: sensor_msgs/msg/CompressedImage
#include "std_msgs/msg/Header.idl"
module sensor_msgs {{ module msg {{
  struct CompressedImage {{ std_msgs::msg::Header header; string format; sequence<uint8> data; }};
}}; }};
{"=" * 80}
IDL: std_msgs/msg/Header
#include "builtin_interfaces/msg/Time.idl"
module std_msgs {{ module msg {{ struct Header {{ builtin_interfaces::msg::Time stamp; string frame_id; }}; }}; }};
{"=" * 80}
IDL: builtin_interfaces/msg/Time
module builtin_interfaces {{ module msg {{ struct Time {{ int32 sec; uint32 nanosec; }}; }}; }};
"""


def test_definitions_in_idl_are_understood(street, small_camera, pictures):
    path = street(idl={"sensor_msgs/msg/CompressedImage": COMPRESSED_IMAGE_IDL})
    assert_is_the_street(open_drive(path), small_camera, pictures)


def test_a_rosbag2_folder_with_compressed_chunks_is_read(street, small_camera, pictures):
    folder = street("bag", rosbag2=True, compression_mode=CompressionMode.STORAGE)
    assert_is_the_street(open_drive(folder), small_camera, pictures)


def test_frames_can_be_read_twice_and_side_by_side(street):
    drive = open_drive(street())
    stamps = [(a.stamp_ns, b.stamp_ns) for a, b in zip(drive.frames(), drive.frames(), strict=True)]
    assert len(stamps) == 10
    assert all(first == second for first, second in stamps)


def test_messages_stored_out_of_order_come_in_log_time_order(record, small_camera, pictures):
    with record() as recorder:
        recorder.camera_info("/camera_info", T0_NS, small_camera, "cam")
        for index in (3, 0, 9, 1, 2, 7, 8, 4, 6, 5):
            recorder.jpeg("/image", T0_NS + index * FRAME_NS, pictures[index], "cam")
    stamps = [frame.stamp_ns for frame in open_drive(recorder.path).frames()]
    assert stamps == [T0_NS + index * FRAME_NS for index in range(10)]


@pytest.mark.parametrize("padding", [0, 12])
@pytest.mark.parametrize("encoding", ["mono8", "8UC1", "bgr8", "rgb8", "bgra8", "rgba8"])
def test_raw_images_become_grey(record, small_camera, pictures, encoding, padding):
    grey = pictures[0]
    channels = {"mono8": 1, "8UC1": 1}.get(encoding, 4 if "a" in encoding else 3)
    pixels = np.repeat(grey[:, :, None], channels, axis=2).reshape(48, -1)
    rows = np.pad(pixels, ((0, 0), (0, padding)), constant_values=255)
    with record() as recorder:
        recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
        recorder.raw_image("/x/image_raw", T0_NS, rows, encoding, "cam", width=64, step=rows.shape[1])
    (frame,) = open_drive(recorder.path).frames()
    assert np.abs(frame.image.astype(int) - grey).max() <= 1


def test_red_and_blue_are_told_apart(record, small_camera):
    red = np.zeros((48, 64, 3), np.uint8)
    red[:, :, 0] = 255
    with record() as recorder:
        recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
        recorder.raw_image("/x/image", T0_NS, red.reshape(48, -1), "rgb8", "cam", width=64, step=192)
        recorder.raw_image("/x/image", T0_NS + 1, red.reshape(48, -1), "bgr8", "cam", width=64, step=192)
    as_rgb, as_bgr = (frame.image[0, 0] for frame in open_drive(recorder.path).frames())
    assert as_rgb == 76  # 0.299 of 255, the weight of red in Rec. 601
    assert as_bgr == 29  # 0.114 of 255, that of blue


def test_a_png_arrives_without_loss(record, small_camera, pictures):
    with record() as recorder:
        recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
        png = cv2.imencode(".png", pictures[0])[1].tobytes()
        recorder.compressed("/x/image/compressed", T0_NS, png, "mono8; png compressed", "cam")
    (frame,) = open_drive(recorder.path).frames()
    assert np.array_equal(frame.image, pictures[0])


class TestTwoCameras:
    @pytest.fixture
    def two_cameras(self, record, small_camera, pictures):
        right = replace(small_camera, fx_px=60.0)
        with record() as recorder:
            for name, camera, frame_id in (("left", small_camera, "cam_l"), ("right", right, "cam_r")):
                recorder.camera_info(f"/{name}/camera_info", T0_NS, camera, frame_id)
                recorder.jpeg(f"/{name}/image/compressed", T0_NS, pictures[0], frame_id)
        return recorder.path

    def test_none_chosen_lists_them_and_names_the_option(self, two_cameras):
        with pytest.raises(DriveError, match=r"/left/image/compressed, /right/image/compressed.*--image-topic"):
            open_drive(two_cameras)

    def test_each_gets_its_own_calibration(self, two_cameras):
        assert open_drive(two_cameras, image_topic="/left/image/compressed").camera.fx_px == 50.0
        assert open_drive(two_cameras, image_topic="/right/image/compressed").camera.fx_px == 60.0

    def test_an_unknown_choice_lists_what_there_is(self, two_cameras):
        with pytest.raises(DriveError, match=r"no images on /rear; it has /left/image/compressed, /right"):
            open_drive(two_cameras, image_topic="/rear")


class TestCalibration:
    def write(self, recorder, infos, pictures, image="/x/image/compressed", frame_id="cam"):
        with recorder:
            for topic, camera, info_frame_id in infos:
                recorder.camera_info(topic, T0_NS, camera, info_frame_id)
            recorder.jpeg(image, T0_NS, pictures[0], frame_id)
        return open_drive(recorder.path)

    @pytest.fixture
    def wide(self, small_camera):
        return replace(small_camera, fx_px=20.0)

    def test_the_same_frame_wins_over_the_sibling_name(self, record, small_camera, wide, pictures):
        infos = [("/x/camera_info", wide, "other"), ("/calibration", small_camera, "cam")]
        assert self.write(record(), infos, pictures).camera == small_camera

    @pytest.mark.parametrize("image", ["/x/image/compressed", "/x/image_raw", "/x/image"])
    def test_without_the_same_frame_the_sibling_is_taken(self, record, small_camera, wide, pictures, image):
        infos = [("/y/camera_info", wide, "b"), ("/x/camera_info", small_camera, "a")]
        assert self.write(record(), infos, pictures, image).camera == small_camera

    def test_two_of_the_same_frame_are_told_apart_by_name(self, record, small_camera, wide, pictures):
        infos = [("/a/camera_info", wide, "cam"), ("/x/camera_info", small_camera, "cam")]
        assert self.write(record(), infos, pictures).camera == small_camera

    def test_the_only_one_is_taken_with_a_warning(self, record, small_camera, pictures, caplog):
        drive = self.write(record(), [("/elsewhere/camera_info", small_camera, "b")], pictures)
        with caplog.at_level(logging.WARNING):
            assert drive.camera == small_camera
        assert len(caplog.records) == 1

    def test_several_that_do_not_belong_are_an_error(self, record, small_camera, wide, pictures):
        infos = [("/y/camera_info", wide, "b"), ("/z/camera_info", small_camera, "c")]
        drive = self.write(record(), infos, pictures)
        with pytest.raises(CalibrationError, match=r"/y/camera_info, /z/camera_info.*/x/camera_info"):
            _ = drive.camera

    def test_none_is_an_error_that_says_so(self, record, pictures):
        drive = self.write(record(), [], pictures)
        with pytest.raises(CalibrationError, match="no calibration"):
            _ = drive.camera
        with pytest.raises(CalibrationError, match="no calibration"):
            next(drive.frames())

    @pytest.mark.parametrize(
        ("model", "d", "expected_model", "expected"),
        [
            ("plumb_bob", (), "plumb_bob", (0.0,) * 5),
            ("", (0.0,) * 5, "plumb_bob", (0.0,) * 5),
            ("plumb_bob", (0.1, 0.2, 0.3, 0.4), "plumb_bob", (0.1, 0.2, 0.3, 0.4, 0.0)),
            (
                "plumb_bob",
                (0.1, 0.2, 0.0, 0.0, 0.1, 0.3, 0.0, 0.0),
                "rational_polynomial",
                (0.1, 0.2, 0, 0, 0.1, 0.3, 0, 0),
            ),
            (
                "rational_polynomial",
                (0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0),
                "rational_polynomial",
                (0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0),
            ),
            ("equidistant", (0.1, -0.02, 0.003, 0.0), "equidistant", (0.1, -0.02, 0.003, 0.0)),
            ("equidistant", (0.0,) * 4, "equidistant", (0.0,) * 4),
            ("fisheye", (0.1, 0.0, 0.0, 0.0), "equidistant", (0.1, 0.0, 0.0, 0.0)),
        ],
    )
    def test_every_distortion_model_of_ros_is_read(
        self, record, small_camera, pictures, model, d, expected_model, expected
    ):
        with record() as recorder:
            recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam", model=model, d=d)
            recorder.jpeg("/x/image", T0_NS, pictures[0], "cam")
        camera = open_drive(recorder.path).camera
        assert (camera.distortion_model, camera.distortion) == (expected_model, expected)

    @pytest.mark.parametrize(
        ("model", "d"),
        [("thin_prism_fisheye", (0.1,) * 4), ("rational_polynomial", (0.1,) * 12), ("equidistant", (0.1,) * 5)],
    )
    def test_other_models_are_refused_with_topic_and_model(self, record, small_camera, pictures, model, d):
        with record() as recorder:
            recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam", model=model, d=d)
            recorder.jpeg("/x/image", T0_NS, pictures[0], "cam")
        with pytest.raises(CalibrationError, match=f"/x/camera_info: .*{model}"):
            _ = open_drive(recorder.path).camera

    def test_an_uncalibrated_camera_is_refused(self, record, small_camera, pictures):
        with record() as recorder:
            recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam", k=np.zeros((3, 3)))
            recorder.jpeg("/x/image", T0_NS, pictures[0], "cam")
        with pytest.raises(CalibrationError, match="not calibrated"):
            _ = open_drive(recorder.path).camera

    def test_rectified_images_use_the_projection_matrix_without_distortion(self, record, small_camera, pictures):
        P = np.array([[40.0, 0, 30, 0], [0, 41, 20, 0], [0, 0, 1, 0]])
        with record() as recorder:
            recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam", p=P)
            recorder.jpeg("/x/image_rect/compressed", T0_NS, pictures[0], "cam")
        camera = open_drive(recorder.path).camera
        assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (40.0, 41.0, 30.0, 20.0)
        assert not any(camera.distortion)


class TestFixes:
    @pytest.fixture
    def fixes_of(self, record, small_camera, pictures):
        def read(*arguments, gnss_topic=None):
            with record() as recorder:
                recorder.camera_info("/x/camera_info", T0_NS, small_camera, "cam")
                recorder.jpeg("/x/image", T0_NS, pictures[0], "cam")
                for index, options in enumerate(arguments):
                    options = {
                        "position": (49.0, 8.0, 100.0),
                        "stamp_ns": T0_NS + index,
                        "topic": "/fix",
                        **options,
                    }
                    recorder.fix(frame_id="cam", **options)
            return open_drive(recorder.path, gnss_topic=gnss_topic)

        return read

    def test_no_fix_and_positions_that_are_not_finite_are_dropped(self, fixes_of):
        nan = float("nan")
        drive = fixes_of(
            {},
            {"status": -1},
            {"position": (nan, 8.0, 100.0)},
            {"position": (49.0, 8.0, nan)},
            {"position": (95.0, 8.0, 100.0)},
            {"status": 2},
        )
        assert [fix.stamp_ns - T0_NS for fix in drive.gnss_fixes()] == [0, 5]

    def test_an_unknown_or_senseless_covariance_counts_as_a_consumer_receivers(self, fixes_of):
        known = np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 0.0], [0.0, 0.0, 16.0]])
        drive = fixes_of(
            {"covariance": known},
            {"covariance": known, "covariance_type": 0},
            {"covariance": np.zeros((3, 3))},
            {"covariance": np.full((3, 3), np.nan)},
            {"covariance": -np.eye(3)},
        )
        covariances = [fix.covariance_enu_m2 for fix in drive.gnss_fixes()]
        assert covariances[0] == pytest.approx(known)
        for covariance in covariances[1:]:
            assert covariance == pytest.approx(np.eye(3) * UNKNOWN_COVARIANCE_SIGMA_M**2)

    def test_fixes_come_in_time_order_and_once_per_stamp(self, fixes_of):
        drive = fixes_of(*({"stamp_ns": T0_NS + late} for late in (5, 3, 9, 3)))
        assert [fix.stamp_ns - T0_NS for fix in drive.gnss_fixes()] == [3, 5, 9]

    def test_two_receivers_matter_only_when_gnss_is_read(self, fixes_of):
        drive = fixes_of({"topic": "/a/fix"}, {"topic": "/b/fix"})
        assert len(list(drive.frames())) == 1
        with pytest.raises(DriveError, match=r"/a/fix, /b/fix.*--gnss-topic"):
            drive.gnss_fixes()

    def test_one_of_two_receivers_can_be_chosen(self, fixes_of):
        drive = fixes_of({"topic": "/a/fix"}, {"topic": "/b/fix"}, gnss_topic="/b/fix")
        assert [fix.stamp_ns for fix in drive.gnss_fixes()] == [T0_NS + 1]

    def test_an_unknown_gnss_topic_is_refused_at_once(self, fixes_of):
        with pytest.raises(DriveError, match=r"no GNSS fixes on /c; it has /a/fix"):
            fixes_of({"topic": "/a/fix"}, gnss_topic="/c")

    def test_a_recording_without_gnss_has_no_fixes_and_no_warning(self, fixes_of, caplog):
        drive = fixes_of()
        assert drive.gnss_fixes() == []
        assert drive.antenna().position_in_cam_m == pytest.approx(np.zeros(3))
        assert not caplog.records
