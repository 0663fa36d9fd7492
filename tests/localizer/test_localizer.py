"""The localizer in a street whose truth is known: right poses, or none."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from fleetmap.drive import Frame
from fleetmap.errors import CalibrationError
from fleetmap.geometry import Pose, rotation_angle_rad, so3_log
from fleetmap_localizer.localizer import Localizer
from fleetmap_localizer.map_view import LocalizableMap, MapView
from fleetmap_localizer.motion import Motion
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate
from fleetmap_localizer.settings import LocalizerSettings


@pytest.fixture
def view(mapped_street, second_drive) -> MapView:
    camera = mapped_street.manifest.camera.to_camera()
    source = LocalizableMap("street", "0" * 64, camera, mapped_street.content)
    return MapView(source, second_drive.camera, LocalizerSettings())


@pytest.fixture
def localizer(view, second_drive) -> Localizer:
    return Localizer(second_drive.camera, [view])


def poses_of(answers: list[PoseEstimate | NoPose]) -> list[PoseEstimate]:
    return [answer for answer in answers if isinstance(answer, PoseEstimate)]


def errors(drive, answers: list[PoseEstimate]) -> tuple[np.ndarray, np.ndarray]:
    """Position errors in metres and rotation errors in degrees."""
    truth = {int(s): drive.truth.pose(i) for i, s in enumerate(drive.truth.stamps_ns)}
    away = [truth[a.stamp_ns].inverse() @ a.utm_from_cam for a in answers]
    turned = rotation_angle_rad(np.array([pose.rotation for pose in away]))
    return np.array([np.linalg.norm(pose.translation_m) for pose in away]), np.degrees(turned)


def test_another_camera_in_another_lane_is_followed_through_the_street(localizer, second_drive) -> None:
    answers = poses_of([localizer.localize(frame) for frame in second_drive.frames])
    away_m, turned_deg = errors(second_drive, answers)
    assert len(answers) >= 0.95 * len(second_drive.frames)
    assert 0.0 < np.median(away_m) < 0.05
    assert away_m.max() < 0.5
    assert 0.0 < np.median(turned_deg) < 0.1
    assert min(answer.inlier_count for answer in answers) >= 15


def test_every_single_image_is_localised_from_nothing(localizer, second_drive) -> None:
    answers = []
    for frame in second_drive.frames[::3]:
        localizer.forget()
        answers += poses_of([localizer.localize(frame)])
    away_m, _ = errors(second_drive, answers)
    assert len(answers) >= 0.9 * len(second_drive.frames[::3])
    assert np.median(away_m) < 0.05
    assert away_m.max() < 0.5


def test_images_of_another_street_give_no_pose(localizer, foreign_drive) -> None:
    assert len(foreign_drive.frames) > 20
    answers = [localizer.localize(frame) for frame in foreign_drive.frames]
    assert not poses_of(answers)
    assert all(answer.reason for answer in answers)


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
    answer = localizer.localize(Frame(second_drive.frames[0].stamp_ns, image.astype(np.uint8)))
    assert isinstance(answer, NoPose)


def test_a_vehicle_that_lost_its_way_finds_it_again(localizer, second_drive, foreign_drive) -> None:
    """Ten images of somewhere else, as when a lorry fills the view, and then the street again."""
    answers = []
    for i, frame in enumerate(second_drive.frames[:30]):
        image = foreign_drive.frames[i].image if 10 <= i < 20 else frame.image
        answers.append(localizer.localize(Frame(frame.stamp_ns, image)))
    assert not poses_of(answers[10:20])
    assert len(poses_of(answers[20:])) >= 9
    assert errors(second_drive, poses_of(answers))[0].max() < 0.5


def test_a_wrong_turn_of_the_motion_is_overruled_by_a_far_better_place(localizer, second_drive) -> None:
    first, second = second_drive.frames[2], second_drive.frames[3]
    right = localizer.localize(first)
    assert isinstance(right, PoseEstimate)
    far = Pose(right.utm_from_cam.rotation, right.utm_from_cam.translation_m + np.array([900.0, 0.0, 0.0]))
    wrong = Motion(first.stamp_ns, far, 20, right.epsg, right.map_id, right.version)
    localizer._motion = wrong
    answer = localizer.localize(second)
    assert isinstance(answer, PoseEstimate)
    assert errors(second_drive, [answer])[0][0] < 0.2
    localizer._motion = replace(wrong, inlier_count=400)
    answer = localizer.localize(second)  # both cannot be true, and neither is clearly the better
    assert isinstance(answer, NoPose)
    assert "cannot have got to" in answer.reason


def test_a_mirrored_world_gives_no_pose(localizer, second_drive) -> None:
    for frame in second_drive.frames[::6]:
        mirrored = np.ascontiguousarray(frame.image[:, ::-1])
        assert isinstance(localizer.localize(Frame(frame.stamp_ns, mirrored)), NoPose)


def test_the_covariance_tells_the_size_of_the_error(localizer, second_drive) -> None:
    """Not exact: the errors of landmarks are shared between images. But no order of magnitude off."""
    squares = []
    truth = {int(s): second_drive.truth.pose(i) for i, s in enumerate(second_drive.truth.stamps_ns)}
    for answer in poses_of([localizer.localize(frame) for frame in second_drive.frames]):
        difference = answer.utm_from_cam.inverse() @ truth[answer.stamp_ns]
        xi = np.r_[so3_log(difference.rotation), difference.translation_m]
        squares.append(xi @ np.linalg.solve(answer.covariance, xi))
        assert np.allclose(answer.covariance, answer.covariance.T)
    assert 1.0 < np.median(squares) < 40.0


def test_the_map_is_never_changed_and_the_answers_repeat(view, second_drive) -> None:
    before = copy.deepcopy(view.content.landmarks)
    runs: list[list[Pose]] = []
    for _ in range(2):
        localizer = Localizer(second_drive.camera, [view])
        answers = poses_of([localizer.localize(frame) for frame in second_drive.frames[:8]])
        runs.append([answer.utm_from_cam for answer in answers])
    assert len(runs[0]) == len(runs[1]) >= 7
    for first, second in zip(*runs, strict=True):
        assert np.array_equal(first.rotation, second.rotation)
        assert np.array_equal(first.translation_m, second.translation_m)
    after = vars(view.content.landmarks)
    assert all(np.array_equal(values, after[name]) for name, values in vars(before).items())


def test_a_track_goes_on_in_a_map_that_takes_the_place_of_another(view, mapped_street, second_drive) -> None:
    """Another version has its own anchor, so the same place has other coordinates in it."""
    moved_m = np.array([40, -25, 3])
    anchor, content = view.anchor, mapped_street.content
    anchor = replace(
        anchor,
        easting_m=anchor.easting_m - 40,
        northing_m=anchor.northing_m + 25,
        height_m=anchor.height_m - 3,
    )
    content = replace(
        content,
        anchor=anchor,
        keyframes=replace(content.keyframes, positions_m=content.keyframes.positions_m + moved_m),
        landmarks=replace(content.landmarks, points_m=content.landmarks.points_m + moved_m),
    )
    newer = LocalizableMap("street", "1" * 64, mapped_street.manifest.camera.to_camera(), content)
    localizer = Localizer(second_drive.camera, [view])
    before = poses_of([localizer.localize(frame) for frame in second_drive.frames[:5]])
    localizer.use([MapView(newer, second_drive.camera, LocalizerSettings())])
    after = poses_of([localizer.localize(frame) for frame in second_drive.frames[5:10]])
    assert (len(before), len(after)) == (5, 5)
    assert {answer.version for answer in before} == {"0" * 64}
    assert {answer.version for answer in after} == {"1" * 64}
    assert errors(second_drive, before + after)[0].max() < 0.5


def test_without_any_map_there_is_no_pose_but_a_reason(second_drive) -> None:
    answer = Localizer(second_drive.camera).localize(second_drive.frames[0])
    assert isinstance(answer, NoPose)
    assert "no place" in answer.reason


def test_time_that_stands_still_or_runs_back_does_no_harm(localizer, second_drive) -> None:
    first, second = second_drive.frames[4], second_drive.frames[5]
    for frame in (first, Frame(first.stamp_ns, second.image), Frame(first.stamp_ns - 5_000_000_000, first.image)):
        answer = localizer.localize(frame)
        assert isinstance(answer, PoseEstimate)
        assert answer.stamp_ns == frame.stamp_ns


def test_an_image_of_another_size_is_refused(localizer) -> None:
    with pytest.raises(CalibrationError, match=r"100x50.*720x420"):
        localizer.localize(Frame(0, np.zeros((50, 100), dtype=np.uint8)))
