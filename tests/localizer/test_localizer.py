"""The localizer in a street whose truth is known: right poses, or none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.drive import Frame
from fleetmap.errors import CalibrationError
from fleetmap.geometry import Pose, rotation_angle_rad, so3_log
from fleetmap_localizer.localizer import Localizer
from fleetmap_localizer.motion import Motion
from fleetmap_localizer.pose_estimate import PoseEstimate


@pytest.fixture
def localizer(mapped_street, second_drive) -> Localizer:
    return Localizer(mapped_street.content, mapped_street.manifest.camera.to_camera(), second_drive.camera)


def errors(drive, answers: list[PoseEstimate]) -> tuple[np.ndarray, np.ndarray]:
    """Position errors in metres and rotation errors in degrees."""
    truth = {int(s): drive.truth.pose(i) for i, s in enumerate(drive.truth.stamps_ns)}
    away = [truth[a.stamp_ns].inverse() @ a.utm_from_cam for a in answers]
    turned = rotation_angle_rad(np.array([pose.rotation for pose in away]))
    return np.array([np.linalg.norm(pose.translation_m) for pose in away]), np.degrees(turned)


def test_another_camera_in_another_lane_is_followed_through_the_street(localizer, second_drive) -> None:
    answers = [answer for frame in second_drive.frames if (answer := localizer.localize(frame)) is not None]
    away_m, turned_deg = errors(second_drive, answers)
    assert len(answers) >= 0.95 * len(second_drive.frames)
    assert 0.0 < np.median(away_m) < 0.05
    assert away_m.max() < 0.5
    assert 0.0 < np.median(turned_deg) < 0.1
    assert min(answer.inlier_count for answer in answers) >= 15


def test_every_single_image_is_localised_from_nothing(mapped_street, second_drive) -> None:
    camera = mapped_street.manifest.camera.to_camera()
    lost = Localizer(mapped_street.content, camera, second_drive.camera)
    apart_ns = 60_000_000_000  # images a minute apart: nothing to track
    answers = []
    for i, frame in enumerate(second_drive.frames[::3]):
        answer = lost.localize(Frame(frame.stamp_ns + i * apart_ns, frame.image))
        if answer is not None:
            answers.append(replace(answer, stamp_ns=frame.stamp_ns))
    away_m, _ = errors(second_drive, answers)
    assert len(answers) >= 0.9 * len(second_drive.frames[::3])
    assert np.median(away_m) < 0.05
    assert away_m.max() < 0.5


def test_images_of_another_street_give_no_pose(localizer, foreign_drive) -> None:
    assert len(foreign_drive.frames) > 20
    assert [localizer.localize(frame) for frame in foreign_drive.frames] == [None] * len(foreign_drive.frames)


@pytest.mark.parametrize("kind", ["black", "white", "noise", "smooth", "stripes"])
def test_images_of_nothing_give_no_pose(localizer, second_drive, kind: str) -> None:
    shape = second_drive.frames[0].image.shape
    rng = np.random.default_rng(0)
    image = {
        "black": np.zeros(shape),
        "white": np.full(shape, 255.0),
        "noise": rng.uniform(0, 255, shape),
        "smooth": np.linspace(0, 255, shape[1])[None, :].repeat(shape[0], axis=0),
        "stripes": 255.0 * (np.arange(shape[1]) // 8 % 2)[None, :].repeat(shape[0], axis=0),
    }[kind]
    assert localizer.localize(Frame(second_drive.frames[0].stamp_ns, image.astype(np.uint8))) is None


def test_a_vehicle_that_lost_its_way_finds_it_again(localizer, second_drive, foreign_drive) -> None:
    """Ten images of somewhere else, as when a lorry fills the view, and then the street again."""
    answers = []
    for i, frame in enumerate(second_drive.frames[:30]):
        image = foreign_drive.frames[i].image if 10 <= i < 20 else frame.image
        answers.append(localizer.localize(Frame(frame.stamp_ns, image)))
    assert all(answer is None for answer in answers[10:20])
    assert sum(answer is not None for answer in answers[20:]) >= 9
    found = [answer for answer in answers if answer is not None]
    assert errors(second_drive, found)[0].max() < 0.5


def test_a_wrong_turn_of_the_motion_is_overruled_by_a_far_better_place(localizer, second_drive) -> None:
    first, second = second_drive.frames[2], second_drive.frames[3]
    right = localizer.localize(first)
    assert right is not None
    wrong = Pose(right.utm_from_cam.rotation, np.array([900.0, 0.0, 0.0]))
    localizer._motion = Motion(first.stamp_ns, wrong, inlier_count=20)
    answer = localizer.localize(second)
    assert answer is not None
    assert errors(second_drive, [answer])[0][0] < 0.2
    localizer._motion = Motion(first.stamp_ns, wrong, inlier_count=400)
    assert localizer.localize(second) is None  # both cannot be true, and neither is clearly the better


def test_a_mirrored_world_gives_no_pose(localizer, second_drive) -> None:
    for frame in second_drive.frames[::6]:
        mirrored = np.ascontiguousarray(frame.image[:, ::-1])
        assert localizer.localize(Frame(frame.stamp_ns, mirrored)) is None


def test_the_covariance_tells_the_size_of_the_error(localizer, second_drive) -> None:
    """Not exact: the errors of landmarks are shared between images. But no order of magnitude off."""
    squares = []
    truth = {int(s): second_drive.truth.pose(i) for i, s in enumerate(second_drive.truth.stamps_ns)}
    for frame in second_drive.frames:
        answer = localizer.localize(frame)
        if answer is None:
            continue
        difference = answer.utm_from_cam.inverse() @ truth[frame.stamp_ns]
        xi = np.r_[so3_log(difference.rotation), difference.translation_m]
        squares.append(xi @ np.linalg.solve(answer.covariance, xi))
        assert np.allclose(answer.covariance, answer.covariance.T)
    assert 1.0 < np.median(squares) < 40.0


def test_the_map_is_never_changed_and_the_answers_repeat(mapped_street, second_drive) -> None:
    camera = mapped_street.manifest.camera.to_camera()
    before = [array.copy() for array in vars(mapped_street.content.landmarks).values()]
    runs: list[list[Pose]] = []
    for _ in range(2):
        localizer = Localizer(mapped_street.content, camera, second_drive.camera)
        answers = [localizer.localize(frame) for frame in second_drive.frames[:8]]
        runs.append([answer.utm_from_cam for answer in answers if answer is not None])
    assert len(runs[0]) == len(runs[1]) >= 7
    for first, second in zip(*runs, strict=True):
        assert np.array_equal(first.rotation, second.rotation)
        assert np.array_equal(first.translation_m, second.translation_m)
    after = vars(mapped_street.content.landmarks).values()
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


def test_time_that_stands_still_or_runs_back_does_no_harm(localizer, second_drive) -> None:
    first, second = second_drive.frames[4], second_drive.frames[5]
    for frame in (first, Frame(first.stamp_ns, second.image), Frame(first.stamp_ns - 5_000_000_000, first.image)):
        answer = localizer.localize(frame)
        assert answer is not None
        assert answer.stamp_ns == frame.stamp_ns


def test_an_image_of_another_size_is_refused(localizer) -> None:
    with pytest.raises(CalibrationError, match=r"100x50.*720x420"):
        localizer.localize(Frame(0, np.zeros((50, 100), dtype=np.uint8)))
