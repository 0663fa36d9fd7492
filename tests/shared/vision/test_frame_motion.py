"""The camera's motion between two images, against the truth of a simulated drive."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.geometry import so3_log
from fleetmap.vision.frame_motion import FrameFollower

CAMERA = Camera(640, 320, 430.0, 430.0, 319.5, 159.5)  # of the survey drive


@pytest.fixture(scope="module")
def motions(survey, survey_frames):
    """Of every third pair of images: the measured motion, the true rotation, the true step in the first camera."""
    follower = FrameFollower(CAMERA)
    found = []
    for index in range(0, len(survey_frames) - 1, 3):
        first, second = survey.truth.pose(index), survey.truth.pose(index + 1)
        measured = follower.motion(*(follower.reduced(survey_frames[i].image) for i in (index, index + 1)))
        step = first.rotation.T @ (second.translation_m - first.translation_m)
        found.append((measured, so3_log(first.rotation.T @ second.rotation), step))
    return found


def test_rotations_are_found_through_a_corner(motions):
    errors_deg = np.degrees([measured.rotation_rad - rotation for measured, rotation, _ in motions])
    assert max(np.degrees(np.linalg.norm(rotation)) for _, rotation, _ in motions) > 1.0
    assert np.sqrt(np.mean(errors_deg**2)) < 0.05
    assert np.abs(errors_deg).max() < 0.25


def test_the_direction_of_travel_is_found(motions):
    cosines = [measured.direction @ step / np.linalg.norm(step) for measured, _, step in motions]
    errors_deg = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    assert np.median(errors_deg) < 0.5
    assert np.percentile(errors_deg, 90) < 2.0


def test_near_things_show_parallax(motions):
    for measured, _, _ in motions:
        assert 1.0 < measured.parallax_px < 60.0
        assert measured.track_count > 100


def test_a_backward_drive_is_told_from_a_forward_one(survey_frames):
    follower = FrameFollower(CAMERA)
    first, second = (follower.reduced(frame.image) for frame in survey_frames[:2])
    assert follower.motion(first, second).direction[2] > 0.9
    assert follower.motion(second, first).direction[2] < -0.9


def test_a_turn_on_the_spot_has_no_parallax_and_no_direction(survey_frames):
    """The second image is the first as a camera sees it that has turned by two degrees."""
    cv2 = pytest.importorskip("cv2")
    angle = np.radians(2.0)
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    homography = CAMERA.matrix @ rotation.T @ np.linalg.inv(CAMERA.matrix)
    first = survey_frames[0].image
    second = cv2.warpPerspective(first, homography, (640, 320))[:, 40:600]
    follower = FrameFollower(Camera(560, 320, 430.0, 430.0, 279.5, 159.5))
    motion = follower.motion(first[:, 40:600].copy(), second.copy())
    assert np.degrees(motion.rotation_rad) == pytest.approx([0.0, 2.0, 0.0], abs=0.05)
    assert motion.parallax_px < 0.3
    assert motion.direction_sigma_rad > np.radians(4.0)


def test_nothing_can_be_followed_in_an_image_without_texture():
    follower = FrameFollower(CAMERA)
    grey = np.full((320, 640), 120, np.uint8)
    assert follower.motion(grey, grey) is None
