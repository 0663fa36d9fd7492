"""``fleetmap info`` as a user types it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.drive import GnssFix
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.geometry import Pose

T0_NS = 1_650_000_000_123_456_789


@pytest.fixture
def recording(tmp_path):
    camera = Camera(64, 48, 50.0, 51.0, 31.5, 23.5, (-0.3, 0.1, 0.001, -0.002, 0.01))
    with DriveWriter(tmp_path / "drive.mcap", camera) as writer:
        writer.write_static_transform("camera", "gnss", Pose(np.eye(3), np.array([0.1, -1.5, 0.2])))
        for index in range(11):
            writer.write_image(T0_NS + index * 100_000_000, np.full((48, 64), 100, np.uint8))
            fix = GnssFix(T0_NS + index * 100_000_000, 49.0 + 1e-5 * index, 8.4, 115.0, np.eye(3) * 0.0025)
            writer.write_fix(fix, "gnss")
    return tmp_path / "drive.mcap"


def test_a_report_names_topics_frames_calibration_gnss_antenna_and_length(fleetmap, recording):
    code, out, err = fleetmap("info", recording)
    assert (code, err) == (0, "")
    for text in (
        "1.0 s from 2022-04-15T05:20:00Z",
        "/camera/camera_info            11  sensor_msgs/msg/CameraInfo",
        "11 on /camera/image/compressed, 64x48 pixels, 10.00 Hz, longest gap 0.10 s",
        "fx 50 fy 51 cx 31.5 cy 23.5, distortion plumb_bob -0.3 0.1 0.001 -0.002 0.01",
        "11 valid fixes of 11 on /gnss/fix, 10.00 Hz",
        "reported sigma 0.05 m horizontal, 0.05 m vertical",
        "11 m (from GNSS)",
        "x 0.100 y -1.500 z 0.200 m in the camera's frame (static transform)",
        "missing    nothing",
    ):
        assert text in out


def test_json_holds_the_same_for_programs(fleetmap, recording):
    code, out, _ = fleetmap("info", recording, "--json")
    document = json.loads(out)
    assert code == 0
    assert document["images"]["count"] == 11
    assert document["camera"]["fx_px"] == 50.0
    assert document["gnss"]["length_m"] == pytest.approx(11.12, abs=0.01)
    assert document["antenna"]["source"] == "static transform"
    assert document["missing"] == []


def test_a_recording_with_parts_missing_is_reported(fleetmap, tmp_path):
    with DriveWriter(tmp_path / "bare.mcap", None) as writer:
        writer.write_image(T0_NS, np.full((48, 64), 100, np.uint8))
    code, out, _ = fleetmap("info", tmp_path / "bare.mcap")
    assert code == 0
    assert "missing    GNSS: no NavSatFix" in out
    assert "calibration: " in out


def test_a_recording_truncated_to_nothing_is_one_line_and_exit_code_2(fleetmap, recording):
    recording.write_bytes(recording.read_bytes()[:100])
    code, out, err = fleetmap("info", recording)
    assert (code, out) == (2, "")
    assert err.startswith("error: recording ")
    assert err.count("\n") == 1


def test_a_recording_that_is_not_there_is_exit_code_2(fleetmap, tmp_path):
    code, out, err = fleetmap("info", tmp_path / "nothing.mcap")
    assert (code, out) == (2, "")
    assert "there is no recording" in err


def test_help_teaches_by_example(fleetmap):
    code, out, _ = fleetmap("info", "--help")
    assert code == 0
    assert "Example: fleetmap info survey.mcap" in out


def test_a_constant_grey_street_is_not_good_enough_to_map(fleetmap, recording):
    code, out, _ = fleetmap("info", recording)
    assert code == 0
    assert "verdict    good enough to map: no, because of sharpness, texture" in out
    assert "offset of camera and GNSS unobservable" in out


def test_check_turns_the_verdict_into_an_exit_code(fleetmap, recording, survey):
    assert fleetmap("info", recording, "--check")[0] == 1
    code, out, _ = fleetmap("info", survey.recording, "--check", "--quick")
    assert code == 0
    assert "verdict    good enough to map: yes" in out


def test_the_judgement_in_json(fleetmap, survey):
    code, out, _ = fleetmap("info", survey.recording, "--json")
    document = json.loads(out)
    assert code == 0
    assert document["verdict"] in ("yes", "yes, with warnings")
    assert document["summary"].startswith(document["verdict"])
    assert {"aspect", "severity", "text", "value"} == set(document["findings"][0])
    assert {finding["severity"] for finding in document["findings"]} <= {"good", "poor", "bad", "unknown"}
    assert document["clock_offset_s"] == pytest.approx(0.0, abs=3.0 * document["clock_offset_sigma_s"])
    assert document["clock_offset_reason"] is None
    assert document["gnss_quality"]["kind"] == "RTK"
    assert document["image_quality"]["parallax_px_per_m"] > 2.0


def test_quick_leaves_the_images_alone(fleetmap, survey):
    document = json.loads(fleetmap("info", survey.recording, "--json", "--quick")[1])
    assert document["image_quality"] is None
    assert document["clock_offset_s"] is None
    assert document["clock_offset_reason"] == "the images were not looked at"


def test_topics_say_what_they_are_read_for(fleetmap, recording):
    _, out, _ = fleetmap("info", recording)
    assert "sensor_msgs/msg/NavSatFix (GNSS fixes, 10.0 Hz)" in out
    assert "tf2_msgs/msg/TFMessage (transforms)" in out
