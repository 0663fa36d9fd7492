"""Whole recordings judged: the simulated survey drive, and what can be wrong with it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fleetmap.drive import Frame
from fleetmap.errors import DriveError
from fleetmap.gnss import RTK, sample_fixes
from fleetmap.inspection.judging import judge_drive

DAY_NS = 86_400_000_000_000


@pytest.fixture(scope="module")
def fixes(survey):
    return sample_fixes(survey.truth, RTK, interval_s=0.2, seed=5)


@pytest.fixture
def judge(tmp_path, write_drive, survey_frames, fixes):
    """Writes a recording of the survey drive with something changed, and judges it."""

    def write_and_judge(frames=survey_frames, fixes=fixes, look_at_images=True, **options):
        path = tmp_path / "drive.mcap"
        path.unlink(missing_ok=True)
        write_drive(path, frames, fixes=fixes, **options)
        return judge_drive(path, look_at_images=look_at_images)

    return write_and_judge


def severities(judgement):
    return {finding.aspect: finding.severity for finding in judgement.findings}


def text_of(judgement, aspect):
    return next(finding.text for finding in judgement.findings if finding.aspect == aspect)


def test_a_good_drive_is_good_in_every_aspect(judge):
    judgement = judge()
    assert set(severities(judgement).values()) == {"good"}
    assert (judgement.verdict, judgement.summary) == ("yes", "yes")
    assert judgement.images is not None
    assert judgement.images.followed_corners > 150
    assert judgement.images.parallax_px_per_m > 3.0
    assert judgement.clock_offset.offset_s == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("shift_ms", [-150, 90])
def test_clocks_that_differ_are_a_warning_with_the_number(judge, fixes, shift_ms):
    """Fixes stamped too late: the camera's stamps are the earlier ones, and the offset is negative."""
    judgement = judge(fixes=[replace(fix, stamp_ns=fix.stamp_ns + shift_ms * 1_000_000) for fix in fixes])
    assert judgement.clock_offset.offset_s == pytest.approx(-shift_ms * 1e-3, abs=0.02)
    assert judgement.verdict == "yes, with warnings"
    assert severities(judgement)["clocks"] == "poor"
    later = "receiver's" if shift_ms > 0 else "camera's"
    assert f"the {later} stamps are later" in text_of(judgement, "clocks")


def test_the_images_can_be_left_out(judge):
    judgement = judge(look_at_images=False)
    assert judgement.images is None
    assert "sharpness" not in severities(judgement)
    assert severities(judgement)["clocks"] == "unknown"
    assert judgement.verdict == "yes"


def test_blurred_images_are_bad(judge, survey_frames):
    blurred = [Frame(frame.stamp_ns, cv2.GaussianBlur(frame.image, (0, 0), 2.5)) for frame in survey_frames]
    judgement = judge(blurred)
    assert severities(judgement)["sharpness"] == "bad"
    assert judgement.verdict == "no"
    assert "sharpness" in judgement.summary


def test_motion_blur_now_and_then_is_a_warning(judge, survey_frames):
    some = [
        Frame(frame.stamp_ns, cv2.blur(frame.image, (13, 1))) if index % 4 == 1 else frame
        for index, frame in enumerate(survey_frames)
    ]
    assert severities(judge(some))["sharpness"] == "poor"


def test_a_dark_drive_is_told_from_a_white_one(judge, survey_frames):
    dark = judge([Frame(frame.stamp_ns, (frame.image * 0.04).astype(np.uint8)) for frame in survey_frames])
    white = [Frame(frame.stamp_ns, cv2.convertScaleAbs(frame.image, alpha=6.0)) for frame in survey_frames]
    assert severities(dark)["exposure"] == "bad"
    assert severities(judge(white))["exposure"] == "bad"


def test_a_camera_that_sees_nothing_but_sky_is_bad(judge, survey_frames):
    sky = np.full((320, 640), 210, np.uint8)
    judgement = judge([Frame(frame.stamp_ns, sky) for frame in survey_frames])
    assert severities(judgement)["texture"] == "bad"
    assert severities(judgement)["clocks"] == "unknown"


def test_a_camera_that_sees_its_own_bonnet_shows_no_parallax(judge, survey_frames):
    judgement = judge([Frame(frame.stamp_ns, survey_frames[0].image) for frame in survey_frames])
    assert severities(judgement)["parallax"] == "bad"


def test_a_parked_vehicle_is_not_good_enough(judge, survey_frames, fixes):
    parked = [replace(fixes[0], stamp_ns=fix.stamp_ns) for fix in fixes]
    judgement = judge([Frame(frame.stamp_ns, survey_frames[0].image) for frame in survey_frames], fixes=parked)
    assert severities(judgement)["way"] == "bad"
    assert severities(judgement)["parallax"] == "unknown"


def test_lost_images_are_counted(judge, survey_frames):
    kept = [frame for index, frame in enumerate(survey_frames) if not 20 <= index < 26]
    judgement = judge(kept, look_at_images=False)
    assert severities(judgement)["image gaps"] == "poor"
    assert "1, 7.9 %" in text_of(judgement, "image gaps")
    assert "longest gap is 0.70 s" in text_of(judgement, "image gaps")


def test_few_images_a_second_are_too_far_apart(judge, survey_frames):
    assert severities(judge(survey_frames[::4], look_at_images=False))["image rate"] == "poor"
    assert severities(judge(survey_frames[::8], look_at_images=False))["image rate"] == "bad"


def test_a_receiver_that_lives_in_another_time_is_named(judge, fixes):
    judgement = judge(fixes=[replace(fix, stamp_ns=fix.stamp_ns - DAY_NS) for fix in fixes])
    assert severities(judgement)["GNSS coverage"] == "bad"
    assert "from another time" in text_of(judgement, "GNSS coverage")
    assert "86400" in text_of(judgement, "GNSS coverage") or "86399" in text_of(judgement, "GNSS coverage")
    assert severities(judgement)["clocks"] == "unknown"


def test_fixes_over_half_of_the_images_are_a_warning(judge, fixes):
    assert severities(judge(fixes=fixes[: len(fixes) * 2 // 3], look_at_images=False))["GNSS coverage"] == "poor"
    assert severities(judge(fixes=fixes[: len(fixes) // 3], look_at_images=False))["GNSS coverage"] == "bad"


def test_a_drive_without_fixes_or_calibration_cannot_be_mapped(judge):
    assert judge(fixes=[], look_at_images=False).summary == "no, because of GNSS"
    judgement = judge(calibrated=False)
    assert severities(judgement)["calibration"] == "bad"
    assert judgement.images is None


def test_an_antenna_at_an_unknown_place_is_a_warning(judge):
    judgement = judge(gnss_frame_id="roof")
    assert severities(judgement)["antenna"] == "poor"
    assert "--antenna-offset" in text_of(judgement, "antenna")
    assert severities(judgement)["clocks"] == "unknown"


def test_fixes_that_promise_more_than_they_keep_are_a_warning(judge, fixes):
    rng = np.random.default_rng(0)
    lying = [
        replace(fix, lat_deg=fix.lat_deg + rng.normal(0, 4e-6), lon_deg=fix.lon_deg + rng.normal(0, 6e-6))
        for fix in fixes
    ]
    judgement = judge(fixes=lying)
    assert severities(judgement)["GNSS accuracy"] == "poor"
    assert "worse than they say" in text_of(judgement, "GNSS accuracy")


def test_an_image_that_cannot_be_decoded_on_the_way_is_bad(tmp_path, judge, survey_frames):
    small = Frame(survey_frames[40].stamp_ns, survey_frames[40].image[:160].copy())
    judgement = judge([*survey_frames[:40], small, *survey_frames[41:]])
    assert severities(judgement)["readable images"] == "bad"
    assert "image 40" in text_of(judgement, "readable images")


def test_a_recording_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(DriveError, match="there is no recording"):
        judge_drive(tmp_path / "nothing.mcap")
