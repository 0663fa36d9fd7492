"""A street is the same for the same seed, deep, and as easy to track as a real one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.errors import InputError
from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import Pose
from fleetmap.simulation.driving import drive_along
from fleetmap.simulation.rendering import render_depth, true_points
from fleetmap.simulation.simulated_drive import SimulatedDrive, simulate_drive
from fleetmap.simulation.street import Street, build_street

_WIDE = Camera(640, 240, 370.0, 370.0, 319.5, 119.5)


@pytest.fixture(scope="module")
def drive(street: Street) -> SimulatedDrive:
    return simulate_drive(street, camera=_WIDE, trajectory=drive_along(street, seed=4), gnss=None)


def test_the_same_seed_builds_the_same_street_and_another_seed_another(street: Street) -> None:
    again, other = build_street(5, 40.0), build_street(6, 20.0)
    assert street.surfaces.corners_in_map.tobytes() == again.surfaces.corners_in_map.tobytes()
    assert np.array_equal(street.atlas.pixels, again.atlas.pixels)
    assert street.surfaces.corners_in_map.tobytes() != other.surfaces.corners_in_map.tobytes()


def test_it_stands_at_its_site() -> None:
    street = build_street(1, 20.0, lat_deg=-33.9, lon_deg=18.4, height_m=31.0)
    lat_deg, lon_deg, height_m = UtmGrid(street.anchor.epsg).to_geodetic(street.anchor.offset_m)
    assert street.anchor.epsg == 32734
    assert float(lat_deg) == pytest.approx(-33.9, abs=1e-5)
    assert float(lon_deg) == pytest.approx(18.4, abs=1e-5)
    assert float(height_m) == 31.0


def test_depths_reach_from_parked_cars_to_the_horizon(drive: SimulatedDrive) -> None:
    depth = render_depth(drive.world.scene, _WIDE, drive.map_from_cam(5))
    finite = depth[np.isfinite(depth)]
    assert 1.5 < np.percentile(finite, 1) < 7.0
    assert 6.0 < np.median(finite) < 40.0
    assert 100.0 < finite.max() < 500.0
    assert np.isfinite(depth).mean() > 0.6


def test_the_road_under_the_camera_is_its_height_below(drive: SimulatedDrive) -> None:
    pose = drive.map_from_cam(2)
    ground = true_points(drive.world.scene, _WIDE, pose, np.array([[300.0, 238.0]]))[0]
    assert ground[2] - pose.translation_m[2] == pytest.approx(-1.65, abs=0.1)


def test_features_match_and_obey_the_true_geometry(drive: SimulatedDrive) -> None:
    """Bounds within a factor of two of what plain ORB does on real residential streets at this frame rate."""
    for index, least_matched in ((6, 0.3), (30, 0.3)):
        matched, consistent, error_px = _track(drive, index, index + 1)
        assert least_matched < matched < 0.9
        assert 0.8 < consistent < 0.995
        assert 0.1 < error_px < 1.0


def _track(drive: SimulatedDrive, first: int, second: int) -> tuple[float, float, float]:
    """Share of ORB features matched, of matches within 3 px of the truth, and these matches' median error."""
    orb = cv2.ORB.create(1000, fastThreshold=12)
    (pixels_a, words_a), (pixels_b, words_b) = (_features(orb, drive.frame(i).image) for i in (first, second))
    assert len(pixels_a) > 800
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(words_a, words_b, k=2)
    good = [best for best, next_best in pairs if best.distance < min(64.0, 0.8 * next_best.distance)]
    here, there = pixels_a[[m.queryIdx for m in good]], pixels_b[[m.trainIdx for m in good]]
    points = true_points(drive.world.scene, drive.camera, drive.map_from_cam(first), here)
    expected = drive.camera.project(_cam_from_map(drive, second).transform(points))
    error_px = np.linalg.norm(expected - there, axis=1)
    error_px = error_px[np.isfinite(error_px)]
    return len(good) / len(pixels_a), float((error_px < 3.0).mean()), float(np.median(error_px[error_px < 3.0]))


def _features(orb: cv2.ORB, image: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    keypoints, words = orb.detectAndCompute(image, None)
    return np.array([keypoint.pt for keypoint in keypoints]), np.asarray(words, dtype=np.uint8)


def _cam_from_map(drive: SimulatedDrive, index: int) -> Pose:
    return drive.map_from_cam(index).inverse()


@pytest.mark.parametrize("length_m", [0.0, -5.0, float("nan"), 5000.0])
def test_a_street_of_impossible_length_is_refused(length_m: float) -> None:
    with pytest.raises(InputError, match="street"):
        build_street(1, length_m)
