"""Drives that are disturbed: by what moves in view, by what covers the lens, by standing still and by gaps.

In each case the map is right, or it says where it is not; it is never bent in silence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.gnss import RTK, sample_fixes
from fleetmap.simulation.rendering import surface_ids
from fleetmap.simulation.scenario import Scenario, simulate_scenario
from fleetmap.trajectory import Trajectory
from fleetmap_mapper.image_mask import ImageMask
from fleetmap_mapper.mapper import MappedDrive, map_drive
from fleetmap_mapper.settings import FeatureGroup, MapperSettings

QUICK = MapperSettings(features=FeatureGroup(count=1500))


def errors_m(estimate: Trajectory, truth: Trajectory) -> np.ndarray:
    rows = np.searchsorted(truth.stamps_ns, estimate.stamps_ns)
    np.testing.assert_array_equal(truth.stamps_ns[rows], estimate.stamps_ns)
    return np.linalg.norm(estimate.positions_m - truth.positions_m[rows], axis=1)


# --- things that move, and things that move along


def in_city(drive_in_memory: Callable, moving_cars_per_km: float) -> tuple:
    """50 m in a city with a small camera: the drive, its truth, and the share of each image that moves."""
    camera = Camera(620, 188, 359.4, 359.4, 303.6, 92.6)
    drive = simulate_scenario(
        Scenario(world_seed=5, length_m=50.0, camera=camera, moving_cars_per_km=moving_cars_per_km)
    )
    images = tuple(drive.frames())
    fixed = len(drive.world.surfaces)
    shares = []
    for index in range(0, len(images), 10):
        scene = drive.world.scene_at((images[index].stamp_ns - drive.motion.start_ns) * 1e-9)
        shares.append(float((surface_ids(scene, camera, drive.map_from_cam(index)) >= fixed).mean()))
    return drive_in_memory("city", camera, images, drive.fixes), drive.trajectory, np.array(shares)


@pytest.fixture(scope="module")
def quiet(survey_drive) -> tuple:
    return in_city(type(survey_drive), 0.0)


@pytest.fixture(scope="module")
def mapped_quietly(quiet) -> MappedDrive:
    return map_drive(quiet[0], QUICK)


def test_traffic_over_thirty_percent_of_the_image_does_not_bend_the_map(survey_drive, quiet, mapped_quietly):
    """A van ahead at the same speed, whose image hardly moves, and cars that come towards it."""
    drive, truth, shares = in_city(type(survey_drive), 100.0)
    assert 0.26 < shares.mean() < 0.4
    assert shares.max() > 0.3
    result = map_drive(drive, QUICK)
    assert len(result.trajectory) >= 0.95 * drive.frame_count
    without, with_traffic = errors_m(mapped_quietly.trajectory, quiet[1]), errors_m(result.trajectory, truth)
    assert 0.005 < without.mean() < 0.1
    assert 0.005 < with_traffic.mean() < max(0.15, 3.0 * without.mean())
    assert with_traffic.max() < 0.6


def with_bonnet(frame: Frame, shape: np.ndarray, texture: np.ndarray, gloss: float) -> Frame:
    """The lower part of the image is a bonnet that stands still; reflections of what is above glide on it."""
    mirrored = frame.image[::-1].astype(np.float64)
    painted = np.clip((1.0 - gloss) * texture + gloss * mirrored, 0.0, 255.0).astype(np.uint8)
    return replace(frame, image=np.where(shape, painted, frame.image))


@pytest.fixture(scope="module")
def bonnet(quiet) -> np.ndarray:
    """(H, W) bool: an arch over the lower quarter of the image."""
    camera = quiet[0].camera
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, camera.width_px), np.arange(camera.height_px))
    return y > camera.height_px * (0.72 + 0.15 * x**2)


@pytest.fixture(scope="module")
def behind_a_bonnet(quiet, bonnet) -> object:
    drive = quiet[0]
    rng = np.random.default_rng(0)
    blocks = np.kron(rng.integers(20, 200, (24, 78)), np.ones((8, 8)))
    texture = blocks[: bonnet.shape[0], : bonnet.shape[1]]
    return replace(drive, images=tuple(with_bonnet(f, bonnet, texture, 0.4) for f in drive.images))


def test_the_own_bonnet_does_not_bend_the_map_even_without_a_mask(quiet, bonnet, behind_a_bonnet):
    assert 0.2 < bonnet.mean() < 0.3
    result = map_drive(behind_a_bonnet, QUICK)
    assert len(result.trajectory) >= 0.95 * behind_a_bonnet.frame_count
    assert 0.005 < errors_m(result.trajectory, quiet[1]).mean() < 0.15


def test_nothing_of_a_masked_bonnet_is_in_the_map(quiet, bonnet, behind_a_bonnet):
    result = map_drive(behind_a_bonnet, QUICK, mask=ImageMask(~bonnet))
    column, row = np.rint(result.visual_map.observations.pixels).astype(int).T
    assert not bonnet[row, column].any()
    assert len(result.trajectory) == behind_a_bonnet.frame_count
    assert 0.005 < errors_m(result.trajectory, quiet[1]).mean() < 0.12


# --- standing still, gaps, and what is not seen


def test_a_minute_at_a_light_with_crossing_traffic_leaves_the_car_where_it_stands(survey, survey_drive):
    """Images every half second, in which a lorry crosses again and again."""
    at, count, pause_ns = 38, 120, 500_000_000
    rng = np.random.default_rng(1)
    here = survey_drive.images[at]
    lorry = np.kron(rng.integers(10, 240, (20, 25)), np.ones((8, 8))).astype(np.uint8)  # 160 x 200 px
    standing = []
    for number in range(1, count + 1):
        image = np.clip(here.image + rng.normal(0.0, 1.5, here.image.shape), 0.0, 255.0).astype(np.uint8)
        left = (number * 37) % 840 - 200
        shown = slice(max(left, 0), min(left + 200, 640))
        image[100:260, shown] = lorry[:, shown.start - left : shown.stop - left]
        standing.append(Frame(here.stamp_ns + number * pause_ns, image))
    later = [replace(f, stamp_ns=f.stamp_ns + count * pause_ns) for f in survey_drive.images[at + 1 :]]
    fixes = [
        f if f.stamp_ns <= here.stamp_ns else replace(f, stamp_ns=f.stamp_ns + count * pause_ns)
        for f in sample_fixes(survey.truth, RTK, interval_s=0.5, seed=4)
    ]
    images = (*survey_drive.images[: at + 1], *standing, *later)
    result = map_drive(replace(survey_drive, images=images, fixes=tuple(fixes)), QUICK)
    truth_m = np.vstack(
        [
            survey.truth.positions_m[: at + 1],
            np.repeat(survey.truth.positions_m[[at]], count, axis=0),
            survey.truth.positions_m[at + 1 :],
        ]
    )
    rows = np.searchsorted([f.stamp_ns for f in images], result.trajectory.stamps_ns)
    errors = np.linalg.norm(result.trajectory.positions_m - truth_m[rows], axis=1)
    assert len(rows) >= 0.95 * len(images)
    assert 0.005 < errors.mean() < 0.15
    assert errors.max() < 0.5
    assert result.quality.segments == 1


def blurred(frame: Frame, length_px: int) -> Frame:
    """Smeared sideways."""
    kernel = np.ones(length_px) / length_px
    rows = np.apply_along_axis(np.convolve, 1, frame.image.astype(np.float64), kernel, "same")
    return replace(frame, image=np.clip(rows, 0.0, 255.0).astype(np.uint8))


def glaring(frame: Frame) -> Frame:
    """The low sun: nothing but white in two thirds of the image, and little beside."""
    x = np.linspace(0.0, 1.0, frame.image.shape[1])
    light = 600.0 * np.exp(-((x - 0.5) ** 2) / 0.05)
    return replace(frame, image=np.clip(0.3 * frame.image + light, 0.0, 255.0).astype(np.uint8))


@pytest.mark.parametrize("spoil", [lambda f: blurred(f, 61), glaring], ids=["blur", "glare"])
def test_spoilt_images_are_posed_rightly_or_not_at_all(survey, survey_drive, spoil):
    images = [spoil(f) if 30 <= i < 36 else f for i, f in enumerate(survey_drive.images)]
    result = map_drive(replace(survey_drive, images=tuple(images)), QUICK)
    clear = [f.stamp_ns for i, f in enumerate(images) if not 30 <= i < 36]
    assert np.isin(clear, result.trajectory.stamps_ns).mean() > 0.97
    errors = survey.errors_m(result.trajectory)
    is_clear = np.isin(result.trajectory.stamps_ns, clear)
    assert 0.005 < errors[is_clear].mean() < 0.15
    assert errors[is_clear].max() < 0.3
    assert errors.max() < 1.0


def test_after_a_gap_the_two_segments_are_counted_and_the_join_is_told(survey, survey_drive):
    """Two seconds of images are missing around the corner: the views on either side share nothing."""
    fixes = tuple(sample_fixes(survey.truth, RTK, interval_s=0.5, seed=4))
    images = survey_drive.images[:28] + survey_drive.images[48:]
    result = map_drive(replace(survey_drive, images=images, fixes=fixes), QUICK)
    assert survey.errors_m(result.trajectory).max() < 0.6
    assert result.quality.segments == 2
    (remark,) = [r for r in result.quality.remarks if "tracking was lost" in r]
    assert remark.startswith(
        "tracking was lost for 2.1 s, 2.7 s into the drive; the segments are joined by their fixes"
    )


def test_a_segment_that_nothing_places_is_left_out_and_told(survey, survey_drive):
    fixes = sample_fixes(survey.truth, RTK, interval_s=0.5, seed=4)
    early = tuple(f for f in fixes if f.stamp_ns < survey_drive.images[40].stamp_ns)
    images = survey_drive.images[:28] + survey_drive.images[48:]
    result = map_drive(replace(survey_drive, images=images, fixes=early), QUICK)
    assert result.trajectory.stamps_ns[-1] <= images[27].stamp_ns
    assert survey.errors_m(result.trajectory).max() < 0.6
    assert result.quality.segments == 1
    assert any(
        r.startswith("a stretch of 28 images is left out of the map: only ") for r in result.quality.remarks
    )
    assert not result.quality.publishable
