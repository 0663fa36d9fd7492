"""The survey drive, recorded once more as a Foxglove tool does it, goes the whole way like the ROS 2 recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.writer import Writer

from fleetmap.drives import open_drive
from fleetmap.drives.mcap_file import McapFile
from fleetmap.drives.messages import FIXES, IMAGES, TRANSFORMS
from fleetmap.drives.topic_reading import read_values, topics_of
from fleetmap.geometry import quat_xyzw_from_rotations


def time(stamp_ns):
    return Timestamp(seconds=stamp_ns // 10**9, nanos=stamp_ns % 10**9)


@pytest.fixture(scope="module")
def foxglove_survey(survey, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("foxglove") / "survey.mcap"
    mcap, camera = McapFile(survey.recording), open_drive(survey.recording).camera
    with path.open("wb") as file, Writer(file) as writer:

        def write(topic, stamp_ns, message):
            writer.write_message(topic, message, stamp_ns, stamp_ns)

        (image_topic,) = topics_of(mcap, IMAGES)
        for image in read_values(mcap, IMAGES, image_topic):
            stamp = {"timestamp": time(image.stamp_ns), "frame_id": image.frame_id}
            jpeg = CompressedImage(**stamp, data=image.picture.data, format="jpeg")
            write("/front/image", image.stamp_ns, jpeg)
            calibration = CameraCalibration(
                **stamp, width=camera.width_px, height=camera.height_px, K=camera.matrix.ravel(),
                distortion_model=camera.distortion_model, D=camera.distortion,
            )  # fmt: skip
            write("/front/calibration", image.stamp_ns, calibration)
            for topic in topics_of(mcap, TRANSFORMS):
                for mounting in read_values(mcap, TRANSFORMS, topic):
                    write("/tf", image.stamp_ns, transform(image.stamp_ns, mounting))
        for message in read_values(mcap, FIXES, *topics_of(mcap, FIXES)):
            fix = message.fix
            location = LocationFix(
                timestamp=time(fix.stamp_ns), frame_id=message.frame_id, latitude=fix.lat_deg,
                longitude=fix.lon_deg, altitude=fix.height_m, position_covariance_type=LocationFix.KNOWN,
                position_covariance=fix.covariance_enu_m2.ravel(),
            )  # fmt: skip
            write("/gps", fix.stamp_ns, location)
    return path


def transform(stamp_ns, mounting):
    x, y, z = mounting.parent_from_child.translation_m
    qx, qy, qz, qw = quat_xyzw_from_rotations(mounting.parent_from_child.rotation)
    return FrameTransform(
        timestamp=time(stamp_ns), parent_frame_id=mounting.parent, child_frame_id=mounting.child,
        translation=Vector3(x=x, y=y, z=z), rotation=Quaternion(x=qx, y=qy, z=qz, w=qw),
    )  # fmt: skip


def test_it_is_the_same_drive(survey, foxglove_survey):
    ours, theirs = open_drive(survey.recording), open_drive(foxglove_survey)
    count = 0
    for our_frame, their_frame in zip(ours.frames(), theirs.frames(), strict=True):
        assert our_frame.stamp_ns == their_frame.stamp_ns
        assert np.array_equal(our_frame.image, their_frame.image)
        count += 1
    assert count == ours.frame_count > 50
    assert theirs.camera == ours.camera
    assert len(ours.gnss_fixes()) > 5
    for our_fix, their_fix in zip(ours.gnss_fixes(), theirs.gnss_fixes(), strict=True):
        assert our_fix.stamp_ns == their_fix.stamp_ns
        assert (our_fix.lat_deg, our_fix.lon_deg, our_fix.height_m) == (
            their_fix.lat_deg,
            their_fix.lon_deg,
            their_fix.height_m,
        )
        assert np.array_equal(our_fix.covariance_enu_m2, their_fix.covariance_enu_m2)
    assert theirs.antenna().source == ours.antenna().source
    assert theirs.antenna().position_in_cam_m == pytest.approx(ours.antenna().position_in_cam_m, abs=1e-12)


def test_info_finds_nothing_missing_in_it(fleetmap, foxglove_survey):
    code, out, err = fleetmap("info", foxglove_survey)
    assert code == 0, err
    for part in ("foxglove.CompressedImage", "/front/image", "640x320", "foxglove.LocationFix", "/gps"):
        assert part in out


def test_mapping_it_gives_the_same_trajectory(fleetmap, foxglove_survey, mapped_survey, tmp_path):
    assert mapped_survey.run.returncode == 0, mapped_survey.run.stderr
    trajectory = tmp_path / "foxglove.tum"
    code, _, err = fleetmap("map", foxglove_survey, "--output", tmp_path / "map", "--trajectory", trajectory)
    assert code == 0, err
    ours, theirs = np.loadtxt(mapped_survey.trajectory), np.loadtxt(trajectory)
    assert np.abs(ours - theirs).max() < 1e-3


def test_a_vehicle_that_records_so_is_localised(fleetmap, foxglove_survey, mapped_survey, tmp_path):
    poses = tmp_path / "poses.tum"
    code, out, err = fleetmap("localize", foxglove_survey, "--map", mapped_survey.package, "--trajectory", poses)
    assert code == 0, err
    localised = len(np.loadtxt(poses))
    assert localised > 0.9 * open_drive(foxglove_survey).frame_count, out
