"""A drive whose recorded lens is wrong, through SLAM and then tightened: what the images alone can make of it."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geometry import umeyama_alignment
from fleetmap_mapper.drive_slam import run_slam
from fleetmap_mapper.settings import CalibrationGroup, MapperSettings
from fleetmap_mapper.stage_times import StageTimes
from fleetmap_mapper.tightening import tighten

WRONG_K1 = 0.04  # 4 px in the corners of these images
SETTINGS = MapperSettings()


@pytest.fixture(scope="module")
def drive(survey_drive):
    wrong = replace(survey_drive.camera, distortion=(WRONG_K1, 0.0, 0.0, 0.0, 0.0))
    return replace(survey_drive, camera=wrong)


@pytest.fixture(scope="module")
def segments(drive):
    return run_slam(drive.frames(), drive.camera, SETTINGS)


@pytest.fixture(scope="module")
def tightened(drive, segments):
    """By mode of the calibration."""
    return {
        mode: tighten(copy.deepcopy(segments), drive.frames, CalibrationGroup(mode=mode), StageTimes())
        for mode in ("recorded", "auto")
    }


def shape_error_m(survey, segments):
    """RMSE of the posed images' positions after one Sim(3)."""
    posed = [frame for segment in segments for frame in segment.posed]
    rows = np.searchsorted(survey.truth.stamps_ns, [frame.stamp_ns for frame in posed])
    estimated = np.array([frame.vis_from_cam.translation_m for frame in posed])
    truth = survey.truth.positions_m[rows]
    errors = umeyama_alignment(estimated, truth).transform(estimated) - truth
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def test_a_wrong_lens_is_found_out_and_replaced(survey_drive, tightened):
    """As far as 60 m can tell: focal length, centre and the higher coefficients make up for each other in part."""
    auto = tightened["auto"].segments[0].growing.camera
    assert abs(auto.distortion[0]) < 0.5 * WRONG_K1
    assert auto.fx_px == pytest.approx(survey_drive.camera.fx_px, rel=0.02)
    assert auto.cx_px == pytest.approx(survey_drive.camera.cx_px, abs=10.0)


def test_the_drive_keeps_its_shape_only_with_its_own_lens(survey, segments, tightened):
    slam, held, auto = (
        shape_error_m(survey, s) for s in (segments, tightened["recorded"].segments, tightened["auto"].segments)
    )
    assert 0.001 < auto < 0.1
    assert auto < 0.3 * min(slam, held)


def test_a_recorded_calibration_is_held_to_the_last_bit(drive, tightened):
    assert tightened["recorded"].segments[0].growing.camera == drive.camera


def test_most_observations_are_aligned_and_several_times_as_exact_as_corners(tightened):
    growing = tightened["auto"].segments[0].growing
    held = [keyframe.landmark_of >= 0 for keyframe in growing.keyframes]
    aligned = np.concatenate([k.is_aligned[h] for k, h in zip(growing.keyframes, held, strict=True)])
    noise = np.concatenate([k.noise[h] for k, h in zip(growing.keyframes, held, strict=True)])
    assert aligned.mean() > 0.6
    assert 0.02 < np.median(noise[aligned]) < 0.4 < np.median(noise[~aligned])


def test_every_image_stays_posed(segments, tightened):
    for result in tightened.values():
        assert [len(s.posed) for s in result.segments] == [len(s.posed) for s in segments]
