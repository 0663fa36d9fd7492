"""A simulated survey drive through the whole mapper, against the truth; and the drives that go wrong."""

from __future__ import annotations

import logging
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fleetmap.errors import DriveError
from fleetmap.gnss import RTK, sample_fixes
from fleetmap.simulation.look import Look
from fleetmap.simulation.rendering import render, true_points
from fleetmap_mapper.mapper import MappedDrive, map_drive
from fleetmap_mapper.settings import FeatureGroup, GnssGroup, MapperSettings

QUICK = MapperSettings(features=FeatureGroup(count=1500))
ARM = (0.4, -1.2, -0.7)


@pytest.fixture(scope="module")
def mapped_quickly(survey_drive):
    return map_drive(survey_drive, QUICK)


def stamps_of(drive: Any) -> np.ndarray:
    return np.array([frame.stamp_ns for frame in drive.images])


def test_every_image_is_posed_where_it_truly_was(survey, survey_drive, mapped):
    np.testing.assert_array_equal(mapped.trajectory.stamps_ns, stamps_of(survey_drive))
    assert mapped.trajectory.epsg == survey.truth.epsg
    errors_m, errors_deg = survey.errors_m(mapped.trajectory), survey.errors_deg(mapped.trajectory)
    assert 0.005 < errors_m.mean() < 0.1  # fixes err by 9 cm; a drive of 60 m with eight of them
    assert errors_m.max() < 0.4
    assert 0.01 < errors_deg.mean() < 0.6


def test_landmarks_lie_on_the_street(survey, mapped):
    """Each is where the ray of the pixel it was seen at meets the street, in UTM."""
    content = mapped.visual_map
    shift_m = content.anchor.offset_m - survey.street.anchor.offset_m
    errors = []
    for k in range(1, len(content.keyframes), 6):
        rows = np.flatnonzero(content.observations.keyframe_index == k)
        row = int(np.searchsorted(survey.truth.stamps_ns, content.keyframes.stamps_ns[k]))
        pose = survey.truth.pose(row)
        in_street = replace(pose, translation_m=survey.street.anchor.map_from_utm(pose.translation_m))
        truth = true_points(
            survey.street, content.camera, in_street, content.observations.pixels[rows].astype(np.float64)
        )
        points = content.landmarks.points_m[content.observations.landmark_index[rows]] + shift_m
        distances = np.linalg.norm(truth - in_street.translation_m, axis=1)
        near = distances < 25.0
        errors.append((np.linalg.norm(points - truth, axis=1) / distances)[near])
    relative = np.concatenate(errors)
    assert len(relative) > 200
    assert 0.001 < np.median(relative) < 0.04


def test_its_quality_record_is_true(survey, survey_drive, mapped):
    quality = mapped.quality
    assert (quality.frames_total, quality.frames_posed) == (76, 76)
    assert quality.keyframes == len(mapped.visual_map.keyframes)
    assert quality.landmarks == len(mapped.visual_map.landmarks)
    assert quality.observations == len(mapped.visual_map.observations)
    assert quality.length_m == pytest.approx(60.0, rel=0.05)
    assert quality.gnss_fixes == len(survey_drive.fixes)
    assert 0.01 < quality.gnss_residual_rms_m < 0.15
    assert 0.3 < quality.reprojection_rms_px < 1.5
    assert quality.publishable
    assert quality.warnings == ()


def test_the_same_drive_and_settings_give_the_same_map_bit_by_bit(survey_drive, mapped_quickly, caplog):
    with caplog.at_level(logging.INFO, "fleetmap_mapper"):
        again = map_drive(survey_drive, QUICK)
    told = r"76 images in \d+\.\d s, \d+\.\d images/s before the map is placed: reading .*, tracking \d+\.\d s, "
    assert re.match(told, caplog.messages[0])
    np.testing.assert_array_equal(again.trajectory.positions_m, mapped_quickly.trajectory.positions_m)
    np.testing.assert_array_equal(again.trajectory.rotations, mapped_quickly.trajectory.rotations)
    for name in ("points_m", "descriptors", "normals", "octaves", "distances_m"):
        np.testing.assert_array_equal(
            getattr(again.visual_map.landmarks, name), getattr(mapped_quickly.visual_map.landmarks, name)
        )
    assert again.quality == mapped_quickly.quality


@pytest.mark.parametrize("mode", ["none", "mapping", "final"])
def test_the_ablation_runs(survey, survey_drive, mode):
    result = map_drive(survey_drive, QUICK.model_copy(update={"gnss": GnssGroup(mode=mode)}))
    assert result.quality.gnss_mode == mode
    assert len(result.trajectory) == survey_drive.frame_count
    assert 0.005 < survey.errors_m(result.trajectory).mean() < (0.12 if mode == "final" else 0.25)


def test_the_fixes_may_come_from_an_antenna_on_the_roof(survey, survey_drive):
    fixes = tuple(sample_fixes(survey.truth, RTK, interval_s=1.0, antenna_in_cam_m=ARM, seed=4))
    on_the_roof = replace(survey_drive, fixes=fixes, antenna_in_cam_m=ARM)
    assert 0.005 < survey.errors_m(map_drive(on_the_roof, QUICK).trajectory).mean() < 0.12
    forgotten = replace(on_the_roof, antenna_in_cam_m=(0.0, 0.0, 0.0))
    assert survey.errors_m(map_drive(forgotten, QUICK).trajectory).mean() > 0.5


def test_a_few_black_images_in_mid_drive_cost_no_more_than_themselves(survey, survey_drive):
    result = map_drive(survey_drive.blacked_out(40, 42), QUICK)
    seen = np.delete(stamps_of(survey_drive), [40, 41, 42])
    assert set(seen) <= set(result.trajectory.stamps_ns)
    errors_m = survey.errors_m(result.trajectory)  # of black ones too, if they were given poses
    assert 0.005 < errors_m.mean() < 0.12
    assert errors_m.max() < 0.5


def test_dropped_images_are_bridged(survey, survey_drive):
    kept = survey_drive.images[:35] + survey_drive.images[39:]
    result = map_drive(replace(survey_drive, images=kept), QUICK)
    assert len(result.trajectory) == len(kept)
    assert 0.005 < survey.errors_m(result.trajectory).mean() < 0.12


def test_after_a_long_loss_the_rest_of_the_drive_is_mapped_too(survey, survey_drive):
    """Over a second without sight around the corner: the map goes on beyond it, tied by its own fixes."""
    fixes = tuple(sample_fixes(survey.truth, RTK, interval_s=0.5, seed=4))
    result = map_drive(replace(survey_drive, fixes=fixes).blacked_out(30, 42), QUICK)
    before, after = (stamps_of(survey_drive)[rows] for rows in (slice(0, 30), slice(43, None)))
    assert set(before) <= set(result.trajectory.stamps_ns)
    assert np.isin(after, result.trajectory.stamps_ns).mean() > 0.9
    assert 0.005 < survey.errors_m(result.trajectory).mean() < 0.2
    assert not result.quality.publishable  # 13 of 76 images have no pose
    assert result.quality.warnings[0].startswith(f"only {len(result.trajectory)} of 76 images")


def test_a_car_that_stands_at_first_is_posed_from_its_first_image_on(survey, survey_drive):
    """Nothing can be triangulated while it stands: those images get their poses once there is a map."""
    first = survey.truth.pose(0)
    pose = replace(first, translation_m=survey.street.anchor.map_from_utm(first.translation_m))
    standing = [
        replace(
            survey_drive.images[0],
            stamp_ns=int(survey.truth.stamps_ns[0]) - (8 - i) * 100_000_000,
            image=render(survey.street, survey_drive.camera, pose, Look(seed=i + 1)),
        )
        for i in range(8)
    ]
    result = map_drive(replace(survey_drive, images=(*standing, *survey_drive.images)), QUICK)
    assert len(result.trajectory) == 84
    assert result.visual_map.keyframes.stamps_ns[1] > survey.truth.stamps_ns[0]
    stood_m = np.linalg.norm(result.trajectory.positions_m[:8] - first.translation_m, axis=1)
    assert 0.001 < stood_m.max() < 0.4
    assert 0.005 < survey.errors_m(without_first(result, 8)).mean() < 0.12


def without_first(result: MappedDrive, count: int) -> Any:
    trajectory = result.trajectory
    return replace(
        trajectory,
        stamps_ns=trajectory.stamps_ns[count:],
        positions_m=trajectory.positions_m[count:],
        rotations=trajectory.rotations[count:],
    )


def test_one_fix_that_is_a_street_away_does_not_bend_the_map(survey, survey_drive):
    fixes = list(survey_drive.fixes)
    fixes[4] = replace(fixes[4], lat_deg=fixes[4].lat_deg + 3e-4)  # 33 m
    result = map_drive(replace(survey_drive, fixes=tuple(fixes)), QUICK)
    assert 0.005 < survey.errors_m(result.trajectory).mean() < 0.25


# --- drives that cannot be mapped


def refusal_of(drive: Any) -> str:
    with pytest.raises(DriveError) as refused:
        map_drive(drive, QUICK)
    message = str(refused.value)
    assert "\n" not in message
    return message


def test_black_images_make_no_map(survey_drive):
    images = survey_drive.blacked_out(0, 99).images[:20]
    assert "no map could be started: the images show too little texture" in refusal_of(
        replace(survey_drive, images=images)
    )


def test_a_car_that_never_moved_makes_no_map(survey_drive):
    images = tuple(replace(survey_drive.images[0], stamp_ns=f.stamp_ns) for f in survey_drive.images[:20])
    assert "the camera never moved" in refusal_of(replace(survey_drive, images=images))


def test_one_image_makes_no_map(survey_drive):
    assert "no map could be started" in refusal_of(replace(survey_drive, images=survey_drive.images[:1]))
    assert "no map could be started" in refusal_of(replace(survey_drive, images=()))


def test_without_fixes_there_is_no_map(survey_drive):
    assert "no usable GNSS fix" in refusal_of(replace(survey_drive, fixes=()))


def test_fixes_of_another_day_are_told(survey_drive):
    fixes = tuple(replace(fix, stamp_ns=fix.stamp_ns + 86_400 * 10**9) for fix in survey_drive.fixes)
    drive = replace(survey_drive, images=survey_drive.images[:30], fixes=fixes)
    assert "only 0 of 9 GNSS fixes lie between posed images" in refusal_of(drive)
