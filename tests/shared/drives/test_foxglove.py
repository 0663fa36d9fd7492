"""Foxglove's messages in protobuf, alone and beside ROS 2's."""

from __future__ import annotations

import logging

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.LocationFixes_pb2 import LocationFixes
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from google.protobuf.timestamp_pb2 import Timestamp

from fleetmap.drives import open_drive
from fleetmap.drives.value_checks import UNKNOWN_COVARIANCE_SIGMA_M
from fleetmap.errors import CalibrationError, DriveError

T0_NS = 1_650_000_000_123_456_789
FRAME_NS = 100_000_000
QUARTER_TURN = Quaternion(z=np.sqrt(0.5), w=np.sqrt(0.5))


def time(stamp_ns):
    seconds, nanos = divmod(stamp_ns, 1_000_000_000)
    return Timestamp(seconds=seconds, nanos=nanos)


def compressed(stamp_ns, image, suffix="jpeg", frame_id="cam"):
    data = cv2.imencode(f".{suffix}", image)[1].tobytes()
    return CompressedImage(timestamp=time(stamp_ns), frame_id=frame_id, data=data, format=suffix)


def calibration(stamp_ns, camera, frame_id="cam", **changes):
    K = camera.matrix
    fields = {
        "timestamp": time(stamp_ns),
        "frame_id": frame_id,
        "width": camera.width_px,
        "height": camera.height_px,
        "distortion_model": camera.distortion_model,
        "D": camera.distortion,
        "K": K.ravel(),
        "R": np.eye(3).ravel(),
        "P": np.hstack([K, np.zeros((3, 1))]).ravel(),
    }
    return CameraCalibration(**{**fields, **changes})


def fix(stamp_ns, latitude=49.0, frame_id="gnss", **changes):
    fields = {
        "timestamp": time(stamp_ns),
        "frame_id": frame_id,
        "latitude": latitude,
        "longitude": 8.4,
        "altitude": 120.0,
        "position_covariance": (np.eye(3) * 0.04).ravel(),
        "position_covariance_type": LocationFix.KNOWN,
    }
    return LocationFix(**{**fields, **changes})


def transform(parent, child, translation, rotation=QUARTER_TURN, stamp_ns=T0_NS):
    return FrameTransform(
        timestamp=time(stamp_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=Vector3(x=translation[0], y=translation[1], z=translation[2]),
        rotation=rotation,
    )


@pytest.fixture
def drive_with(record, small_camera, pictures):
    """A drive of one calibrated image and what else a test writes as (topic, message)."""

    def build(*messages, **options):
        with record() as recorder:
            recorder.protobuf("/front/calibration", calibration(T0_NS, small_camera), T0_NS)
            recorder.protobuf("/front/image", compressed(T0_NS, pictures[0]), T0_NS)
            for number, (topic, message) in enumerate(messages):
                recorder.protobuf(topic, message, T0_NS + number)
        return open_drive(recorder.path, **options)

    return build


def assert_is_the_street(drive, camera, pictures):
    frames = list(drive.frames())
    assert [frame.stamp_ns for frame in frames] == [T0_NS + index * FRAME_NS for index in range(10)]
    assert drive.frame_stamps_ns() == [frame.stamp_ns for frame in frames]
    for frame, picture in zip(frames, pictures, strict=True):
        assert 0.0 < np.abs(frame.image.astype(float) - picture).mean() < 2.0
    assert drive.camera == camera
    assert [found.lat_deg for found in drive.gnss_fixes()] == [49.0 + 1e-6 * index for index in range(10)]
    assert [found.stamp_ns for found in drive.gnss_fixes()] == [T0_NS + index * FRAME_NS for index in range(10)]
    assert drive.gnss_fixes()[0].covariance_enu_m2 == pytest.approx(np.eye(3) * 0.04)
    assert drive.antenna().source == "static transform"
    assert drive.antenna().position_in_cam_m == pytest.approx([0.1, -1.5, -0.4])


def test_a_recording_of_foxglove_messages_is_a_drive(record, small_camera, pictures):
    with record() as recorder:
        for index, picture in enumerate(pictures):
            stamp_ns = T0_NS + index * FRAME_NS
            recorder.protobuf("/front/calibration", calibration(stamp_ns, small_camera), stamp_ns)
            recorder.protobuf("/front/image", compressed(stamp_ns, picture), stamp_ns)
            recorder.protobuf("/gps", fix(stamp_ns, 49.0 + 1e-6 * index), stamp_ns)
            recorder.protobuf("/tf", transform("cam", "gnss", (0.1, -1.5, -0.4)), stamp_ns)
            recorder.protobuf("/log", Log(message="nothing that a map needs"), stamp_ns)
    assert_is_the_street(open_drive(recorder.path), small_camera, pictures)


def test_foxglove_and_ros_messages_may_be_mixed_in_one_file(record, small_camera, pictures):
    with record() as recorder:
        recorder.transforms(T0_NS, ("cam", "mast", (0.1, -1.5, -0.4), (0.0, 0.0, 0.0, 1.0)))
        recorder.protobuf("/tf", transform("mast", "gnss", (0.0, 0.0, 0.0)), T0_NS)
        recorder.protobuf("/front/calibration", calibration(T0_NS, small_camera), T0_NS)
        for index, picture in enumerate(pictures):
            stamp_ns = T0_NS + index * FRAME_NS
            recorder.jpeg("/front/image/compressed", stamp_ns, picture, "cam")
            recorder.protobuf("/gps", fix(stamp_ns, 49.0 + 1e-6 * index), stamp_ns)
    assert_is_the_street(open_drive(recorder.path), small_camera, pictures)


@pytest.mark.parametrize("suffix", ["png", "webp"])
def test_compressed_images_without_loss_arrive_as_they_were(record, small_camera, pictures, suffix):
    colour = cv2.cvtColor(pictures[0], cv2.COLOR_GRAY2BGR)
    options = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == "webp" else []  # above 100: lossless
    data = cv2.imencode(f".{suffix}", colour, options)[1].tobytes()
    message = CompressedImage(timestamp=time(T0_NS), frame_id="cam", data=data, format=suffix)
    with record() as recorder:
        recorder.protobuf("/front/calibration", calibration(T0_NS, small_camera), T0_NS)
        recorder.protobuf("/front/image", message, T0_NS)
    (frame,) = open_drive(recorder.path).frames()
    assert np.abs(frame.image.astype(int) - pictures[0]).max() <= 1


@pytest.mark.parametrize("padding", [0, 16])
def test_raw_images_are_read(record, small_camera, pictures, padding):
    rows = np.pad(np.repeat(pictures[0], 3, axis=1), ((0, 0), (0, padding)))
    message = RawImage(
        timestamp=time(T0_NS), frame_id="cam", width=64, height=48, encoding="rgb8",
        step=rows.shape[1], data=rows.tobytes(),
    )  # fmt: skip
    with record() as recorder:
        recorder.protobuf("/front/calibration", calibration(T0_NS, small_camera), T0_NS)
        recorder.protobuf("/front/image", message, T0_NS)
    (frame,) = open_drive(recorder.path).frames()
    assert np.abs(frame.image.astype(int) - pictures[0]).max() <= 1


class TestCalibration:
    @pytest.fixture
    def camera_of(self, record, small_camera, pictures):
        def read(image_topic="/front/image", **changes):
            with record() as recorder:
                recorder.protobuf("/front/calibration", calibration(T0_NS, small_camera, **changes), T0_NS)
                recorder.protobuf(image_topic, compressed(T0_NS, pictures[0]), T0_NS)
            return open_drive(recorder.path).camera

        return read

    @pytest.mark.parametrize(
        ("model", "coefficients"),
        [
            ("rational_polynomial", (0.1, 0.2, 0.01, 0.02, 0.1, 0.3, 0.2, 0.1)),
            ("equidistant", (0.1, -0.02, 0.003, 0.0)),
        ],
    )
    def test_every_distortion_model_is_read(self, camera_of, model, coefficients):
        camera = camera_of(distortion_model=model, D=coefficients)
        assert (camera.distortion_model, camera.distortion) == (model, coefficients)

    def test_rectified_images_use_the_projection_matrix(self, camera_of):
        P = (40.0, 0.0, 30.0, 0.0, 0.0, 41.0, 20.0, 0.0, 0.0, 0.0, 1.0, 0.0)
        camera = camera_of("/front/image_rect", P=P)
        assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (40.0, 41.0, 30.0, 20.0)
        assert not camera.has_distortion

    @pytest.mark.parametrize("K", [(), (40.0, 0.0, 30.0, 0.0, 41.0, 20.0, 0.0, 0.0, 1.0)])
    def test_a_calibration_without_coefficients_and_other_intrinsics_is_of_rectified_images(self, camera_of, K):
        P = (40.0, 0.0, 30.0, 0.0, 0.0, 41.0, 20.0, 0.0, 0.0, 0.0, 1.0, 0.0)
        camera = camera_of(P=P, K=K, D=(), distortion_model="equidistant")
        assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (40.0, 41.0, 30.0, 20.0)
        assert not camera.has_distortion

    def test_nothing_said_is_not_calibrated(self, camera_of):
        with pytest.raises(CalibrationError, match="/front/calibration: the camera is not calibrated"):
            camera_of(K=(), P=(), D=())

    def test_half_a_matrix_is_refused(self, camera_of):
        with pytest.raises(DriveError, match=r"no foxglove\.CameraCalibration as fleetmap knows it"):
            camera_of(K=(1.0, 2.0, 3.0, 4.0))

    def test_an_image_of_another_size_is_refused_with_the_numbers(self, record, small_camera, pictures):
        with record() as recorder:
            recorder.protobuf("/front/calibration", calibration(T0_NS, small_camera, width=640, height=480), T0_NS)
            recorder.protobuf("/front/image", compressed(T0_NS, pictures[0]), T0_NS)
        with pytest.raises(CalibrationError, match=r"has 64x48 pixels, its calibration says 640x480"):
            next(open_drive(recorder.path).frames())


class TestFixes:
    def test_only_places_on_the_globe_are_fixes(self, drive_with):
        nan = float("nan")
        drive = drive_with(
            ("/gps", fix(T0_NS)),
            ("/gps", fix(T0_NS + 1, latitude=nan)),
            ("/gps", fix(T0_NS + 2, altitude=nan)),
            ("/gps", fix(T0_NS + 3, latitude=95.0)),
            ("/gps", LocationFix(timestamp=time(T0_NS + 4), frame_id="gnss")),  # nothing was set
            ("/gps", fix(T0_NS + 5, latitude=-33.9)),
        )
        assert [found.stamp_ns - T0_NS for found in drive.gnss_fixes()] == [0, 5]

    def test_an_unknown_covariance_counts_as_a_consumer_receivers(self, drive_with):
        drive = drive_with(
            ("/gps", fix(T0_NS, position_covariance_type=LocationFix.UNKNOWN)),
            ("/gps", fix(T0_NS + 1, position_covariance=())),
            ("/gps", fix(T0_NS + 2, position_covariance_type=LocationFix.APPROXIMATED)),
        )
        sigmas = [np.sqrt(found.covariance_enu_m2[0, 0]) for found in drive.gnss_fixes()]
        assert sigmas == pytest.approx([UNKNOWN_COVARIANCE_SIGMA_M, UNKNOWN_COVARIANCE_SIGMA_M, 0.2])

    def test_a_bundle_of_fixes_is_unpacked(self, drive_with):
        bundle = LocationFixes(fixes=[fix(T0_NS, 49.1), fix(T0_NS + 1, 49.2)])
        assert [found.lat_deg for found in drive_with(("/gps", bundle)).gnss_fixes()] == [49.1, 49.2]


class TestTransforms:
    def antenna(self, drive_with, *transforms):
        messages = [("/tf", found) for found in transforms]
        return drive_with(("/gps", fix(T0_NS)), *messages).antenna()

    def test_a_chain_of_constant_transforms_is_walked(self, drive_with):
        found = self.antenna(
            drive_with,
            transform("base", "cam", (2.0, 0.0, 1.0)),
            transform("base", "gnss", (0.0, 0.5, 3.0), Quaternion(w=1.0)),
            transform("base", "cam", (2.0, 0.0, 1.0)),
        )
        assert found.source == "static transform"
        assert found.position_in_cam_m == pytest.approx([0.5, 2.0, 2.0])  # (-2, 0.5, 2) turned back by 90 degrees

    def test_a_bundle_of_transforms_is_unpacked(self, drive_with):
        links = [transform("cam", "mast", (1.0, 0.0, 0.0)), transform("mast", "gnss", (1.0, 0.0, 0.0))]
        bundle = FrameTransforms(transforms=links)
        found = self.antenna(drive_with, bundle)
        assert found.position_in_cam_m == pytest.approx([1.0, 1.0, 0.0])

    def test_a_transform_that_changes_is_no_mounting(self, drive_with, caplog):
        with caplog.at_level(logging.INFO):
            found = self.antenna(
                drive_with, transform("cam", "gnss", (1.0, 0.0, 0.0)), transform("cam", "gnss", (1.001, 0.0, 0.0))
            )
        assert found.source == "assumed at the camera"
        assert any("'gnss' moves in 'cam'" in entry.getMessage() for entry in caplog.records)

    def test_a_turning_frame_is_no_mounting(self, drive_with):
        turned = transform("cam", "gnss", (1.0, 0.0, 0.0), Quaternion(w=1.0))
        found = self.antenna(drive_with, transform("cam", "gnss", (1.0, 0.0, 0.0)), turned)
        assert found.source == "assumed at the camera"

    def test_a_moving_vehicle_does_not_hide_its_mountings(self, drive_with):
        moves = [transform("map", "base", (float(step), 0.0, 0.0)) for step in range(5)]
        mountings = [transform("base", "cam", (2.0, 0.0, 1.0)), transform("base", "gnss", (2.0, 0.0, 4.0))]
        assert self.antenna(drive_with, *moves, *mountings).position_in_cam_m == pytest.approx([0.0, 0.0, 3.0])

    def test_a_transform_without_rotation_does_not_turn(self, drive_with):
        found = self.antenna(drive_with, transform("cam", "gnss", (1.0, 2.0, 3.0), None))
        assert found.position_in_cam_m == pytest.approx([1.0, 2.0, 3.0])

    def test_a_rotation_that_is_none_is_refused(self, drive_with):
        with pytest.raises(DriveError, match="from 'cam' to 'gnss' is no rigid transform"):
            self.antenna(drive_with, transform("cam", "gnss", (1.0, 2.0, 3.0), Quaternion(x=3.0)))


class TestMotion:
    def test_odometry_gives_forward_speeds(self, drive_with):
        messages = [
            Odometry(timestamp=time(T0_NS + late), body_frame_id="base", linear_velocity=Vector3(x=speed, y=9.0))
            for late, speed in ((5, 2.0), (3, -1.0), (7, float("nan")))
        ]
        without_velocity = Odometry(timestamp=time(T0_NS + 9), body_frame_id="base")
        drive = drive_with(*(("/odometry", message) for message in [*messages, without_velocity]))
        found = [(speed.stamp_ns - T0_NS, speed.speed_mps) for speed in drive.wheel_speeds()]
        assert found == [(3, -1.0), (5, 2.0)]

    @pytest.mark.parametrize("name", ["foxglove.Imu", "foxglove.IMU", "vehicle.ImuMeasurement"])
    def test_a_message_that_calls_itself_an_imu_is_read_by_its_fields(self, drive_with, name):
        imu = imu_class(name, "angular_velocity", "linear_acceleration")
        messages = [
            imu(
                timestamp=time(T0_NS + number),
                angular_velocity=Vector3(x=0.1 * number, y=0.2, z=0.3),
                linear_acceleration=Vector3(z=9.81 if number else float("nan")),
            )
            for number in range(3)
        ]
        samples = list(drive_with(*(("/imu", message) for message in messages)).imu_samples())
        assert [sample.stamp_ns - T0_NS for sample in samples] == [1, 2]
        assert samples[1].angular_velocity_rad_s == pytest.approx([0.2, 0.2, 0.3])
        assert samples[1].linear_acceleration_m_s2 == pytest.approx([0.0, 0.0, 9.81])

    def test_one_with_other_fields_is_left_alone(self, drive_with):
        imu = imu_class("vendor.Imu", "gyro", "accelerometer")
        drive = drive_with(("/imu", imu(timestamp=time(T0_NS), gyro=Vector3(x=1.0))))
        assert list(drive.imu_samples()) == []
        assert len(list(drive.frames())) == 1


def imu_class(full_name, *vectors):
    """A message type with a time and vectors, as somebody would write it into a .proto of his own."""
    package, _, name = full_name.rpartition(".")
    pool = DescriptorPool()
    for source in (Timestamp.DESCRIPTOR.file, Vector3.DESCRIPTOR.file):
        pool.AddSerializedFile(source.serialized_pb)
    file = FileDescriptorProto(name=f"{name}.proto", package=package, syntax="proto3")
    file.dependency.extend([Timestamp.DESCRIPTOR.file.name, Vector3.DESCRIPTOR.file.name])
    message = file.message_type.add(name=name)
    kinds = [".google.protobuf.Timestamp"] + [".foxglove.Vector3"] * len(vectors)
    for number, (field, kind) in enumerate(zip(("timestamp", *vectors), kinds, strict=True), start=1):
        message.field.add(
            name=field, number=number, type_name=kind,
            type=FieldDescriptorProto.TYPE_MESSAGE, label=FieldDescriptorProto.LABEL_OPTIONAL,
        )  # fmt: skip
    pool.Add(file)
    made = GetMessageClass(pool.FindMessageTypeByName(full_name))

    def build(**fields):
        built = made()
        for field, value in fields.items():
            getattr(built, field).MergeFromString(value.SerializeToString())
        return built

    return build


class TestBadMessages:
    def refusal_of(self, recorder):
        with pytest.raises(DriveError) as caught:
            list(open_drive(recorder.path).frames())
        assert "\n" not in str(caught.value)
        return str(caught.value)

    @pytest.mark.parametrize("kept", [1, 5, 20, 200])
    def test_a_truncated_message_is_refused_and_named(self, record, small_camera, pictures, kept):
        whole = compressed(T0_NS + FRAME_NS, pictures[1])
        with record() as recorder:
            recorder.protobuf("/front/calibration", calibration(T0_NS, small_camera), T0_NS)
            recorder.protobuf("/front/image", compressed(T0_NS, pictures[0]), T0_NS)
            recorder.protobuf("/front/image", whole, T0_NS + 1, data=whole.SerializeToString()[:kept])
        message = self.refusal_of(recorder)
        assert f"a message of /front/image (log time {T0_NS + 1} ns) is no foxglove.CompressedImage" in message

    def test_a_truncated_jpeg_is_refused_and_named(self, record, small_camera, pictures):
        whole = compressed(T0_NS, pictures[0])
        whole.data = whole.data[: len(whole.data) // 2]
        with record() as recorder:
            recorder.protobuf("/front/calibration", calibration(T0_NS, small_camera), T0_NS)
            recorder.protobuf("/front/image", whole, T0_NS)
        assert "image 0 of /front/image" in (message := self.refusal_of(recorder))
        assert "end in the middle" in message

    def test_an_image_that_holds_nothing_is_refused(self, record, small_camera):
        with record() as recorder:
            recorder.protobuf("/front/calibration", calibration(T0_NS, small_camera), T0_NS)
            recorder.protobuf("/front/image", CompressedImage(), T0_NS)
        assert "neither JPEG nor PNG nor WebP" in self.refusal_of(recorder)

    @pytest.mark.parametrize("descriptors", [b"", b"not descriptors at all", b"\x0a\x02\x0a\x00"])
    def test_descriptors_that_are_none_are_refused(self, record, descriptors):
        with record() as recorder:
            recorder.other("/image", "foxglove.CompressedImage", "protobuf", ("protobuf", descriptors), b"")
        assert "the message definition of /image (foxglove.CompressedImage)" in self.refusal_of(recorder)

    def test_a_schema_in_another_language_is_refused(self, record):
        with record() as recorder:
            recorder.other("/image", "foxglove.CompressedImage", "protobuf", ("jsonschema", b"{}"), b"")
        assert "its schema is in jsonschema, not in protobuf" in self.refusal_of(recorder)

    def test_a_type_of_that_name_with_other_fields_is_refused(self, record):
        made = imu_class("foxglove.RawImage", "pixels")
        with record() as recorder:
            recorder.protobuf("/image", made(pixels=Vector3(x=1.0)), T0_NS)
        assert "no foxglove.RawImage as fleetmap knows it" in self.refusal_of(recorder)
