"""A whole drive: what its images give, why some give nothing, and what is left when it ends early."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.drive import Frame, WheelSpeed
from fleetmap.drives import open_drive
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.errors import DriveError, NoPoseError, ServerError
from fleetmap_localizer.dead_reckoning import DeadReckoning
from fleetmap_localizer.map_source import read_map
from fleetmap_localizer.map_view import LocalizableMap, MapView
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate
from fleetmap_localizer.run import DROPPED, LocalizedDrive, localize_drive
from fleetmap_localizer.settings import LocalizerSettings


@pytest.fixture(scope="module")
def street_map(mapped_street) -> LocalizableMap:
    return read_map(mapped_street.package)


@pytest.fixture(scope="module")
def elsewhere(street_map) -> LocalizableMap:
    """A map that shows nothing of the street: the same road with other descriptors."""
    landmarks = street_map.content.landmarks
    noise = np.random.default_rng(0).integers(0, 256, landmarks.descriptors.shape, dtype=np.uint8)
    content = replace(street_map.content, landmarks=replace(landmarks, descriptors=noise))
    return replace(street_map, map_id="elsewhere", content=content)


class ListeningSupply:
    """Maps as a whole; remembers where it was told that the vehicle is."""

    def __init__(self, maps: list[LocalizableMap], camera: Camera) -> None:
        self._views = tuple(MapView(each, camera, LocalizerSettings()) for each in maps)
        self.told: list[PoseEstimate | NoPose] = []

    def views(self) -> tuple[MapView, ...]:
        return self._views

    def moved(self, pose: PoseEstimate | NoPose) -> None:
        self.told.append(pose)

    def close(self) -> None:
        pass


@pytest.fixture
def supply(street_map, elsewhere, second_drive) -> ListeningSupply:
    return ListeningSupply([elsewhere, street_map], second_drive.camera)


def test_a_drive_becomes_a_utm_trajectory_in_the_map_that_knows_the_place(
    street_map, supply, second_drive
) -> None:
    result = localize_drive(second_drive.frames[:12], second_drive.camera, supply)
    assert result.map_versions == (("street", street_map.version),)
    assert result.map_ids == ("elsewhere", "street")
    assert result.frame_count == 12
    assert len(result.poses) >= 11
    assert result.ended_by is None
    trajectory = result.trajectory()
    assert trajectory.epsg == second_drive.truth.epsg
    index = np.searchsorted(second_drive.truth.stamps_ns, trajectory.stamps_ns)
    away_m = np.linalg.norm(trajectory.positions_m - second_drive.truth.positions_m[index], axis=1)
    assert 0.0 < np.median(away_m) < 0.05
    np.testing.assert_array_equal(result.covariances().stamps_ns, trajectory.stamps_ns)
    assert result.median_inliers == int(np.median([pose.inlier_count for pose in result.poses]))


def test_a_drive_that_enters_the_map_late_is_localised_from_there_on(supply, foreign_drive, second_drive) -> None:
    frames = [
        replace(frame, stamp_ns=second_drive.frames[0].stamp_ns - (5 - i) * 10**8)
        for i, frame in enumerate(foreign_drive.frames[:5])
    ]
    result = localize_drive(frames + second_drive.frames[:5], second_drive.camera, supply)
    assert result.frame_count == 10
    assert [pose.stamp_ns for pose in result.poses] == [frame.stamp_ns for frame in second_drive.frames[:5]]
    assert [answer.stamp_ns for answer in result.answers] == [
        frame.stamp_ns for frame in frames + second_drive.frames[:5]
    ]
    assert result.reasons.total() == 5


def test_reasons_that_differ_in_numbers_only_are_counted_together() -> None:
    reasons = ["too little agrees (12 landmarks)", "too dark", "too little agrees (9 landmarks)"]
    drive = LocalizedDrive(tuple(NoPose(i, reason) for i, reason in enumerate(reasons)))
    assert dict(drive.reasons) == {"too little agrees": 2, "too dark": 1}


def test_queries_on_their_own_do_not_depend_on_the_images_before(street_map, second_drive, foreign_drive) -> None:
    """Backwards, with others between, each gives the same pose; and nobody is told where the vehicle is."""
    camera = second_drive.camera
    supply = ListeningSupply([street_map], camera)
    forwards = localize_drive(second_drive.frames[:6:2], camera, supply, independent=True)
    mixed = [*second_drive.frames[4::-2], foreign_drive.frames[0]]
    backwards = localize_drive(mixed, camera, supply, independent=True)
    assert len(forwards.poses) == 3
    found = {pose.stamp_ns: pose for pose in backwards.poses}
    for pose in forwards.poses:
        np.testing.assert_array_equal(
            pose.utm_from_cam.translation_m, found[pose.stamp_ns].utm_from_cam.translation_m
        )
        np.testing.assert_array_equal(pose.covariance, found[pose.stamp_ns].covariance)
    assert supply.told == []
    tracked = localize_drive(second_drive.frames[:2], camera, supply)
    assert supply.told == list(tracked.answers)


class Shutdown:
    """Frames of a recording that ends in something."""

    def __init__(self, frames: list[Frame], error: BaseException) -> None:
        self._frames, self._error = frames, error

    def __iter__(self) -> Iterator[Frame]:
        yield from self._frames
        raise self._error


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ServerError("the server is gone")])
def test_what_ends_a_run_early_takes_nothing_away(supply, second_drive, error) -> None:
    frames = Shutdown(second_drive.frames[:3], error)
    result = localize_drive(frames, second_drive.camera, supply)
    assert [pose.stamp_ns for pose in result.poses] == [frame.stamp_ns for frame in second_drive.frames[:3]]
    assert result.ended_by is error
    result.require_pose()
    nothing = localize_drive(Shutdown([], error), second_drive.camera, supply)
    with pytest.raises(type(error)):
        nothing.require_pose()


def test_a_damaged_recording_is_refused(supply, second_drive) -> None:
    frames = Shutdown(second_drive.frames[:2], DriveError("an image is damaged"))
    with pytest.raises(DriveError, match="damaged"):
        localize_drive(frames, second_drive.camera, supply)


def test_a_drive_that_no_map_knows_says_which_and_why(supply, foreign_drive) -> None:
    result = localize_drive(foreign_drive.frames[:3], foreign_drive.camera, supply)
    assert result.poses == ()
    with pytest.raises(NoPoseError, match=r"not one of 3 images .* in 'elsewhere', 'street' \(.+\)"):
        result.require_pose()


def test_dropped_images_take_their_place_in_time(supply, second_drive) -> None:
    stamps_ns = [frame.stamp_ns for frame in second_drive.frames[:4]]
    seen = [second_drive.frames[0], second_drive.frames[3]]
    result = localize_drive(seen, second_drive.camera, supply).with_dropped(stamps_ns[1:3])
    assert [answer.stamp_ns for answer in result.answers] == stamps_ns
    assert result.reasons == {DROPPED: 2}
    assert len(result.poses) == 2


def test_predictions_fill_gaps_and_stay_apart_from_what_was_measured(
    street_map, second_drive, foreign_drive, tmp_path
) -> None:
    """Two images of elsewhere, while the wheels go on telling 10 m/s."""
    camera, frames = second_drive.camera, second_drive.frames[:6]
    with DriveWriter(tmp_path / "wheels.mcap", camera) as writer:
        writer.write_image(frames[0].stamp_ns, frames[0].image)
        for stamp_ns in range(frames[0].stamp_ns, frames[5].stamp_ns, 20_000_000):
            writer.write_wheel_speed(WheelSpeed(stamp_ns, 10.0))
    reckoning = DeadReckoning.for_drive(open_drive(tmp_path / "wheels.mcap"), use_gnss=False)
    supply = ListeningSupply([street_map], camera)
    elsewhere = [replace(foreign_drive.frames[i], stamp_ns=frames[i].stamp_ns) for i in (3, 4)]
    result = localize_drive([*frames[:3], *elsewhere, frames[5]], camera, supply, reckoning=reckoning)
    assert [pose.stamp_ns for pose in result.predicted] == [frame.stamp_ns for frame in elsewhere]
    assert [pose.stamp_ns for pose in result.poses] == [frames[i].stamp_ns for i in (0, 1, 2, 5)]
    truth = second_drive.truth.positions_m[3:5]
    predicted_m = np.array([pose.utm_from_cam.translation_m for pose in result.predicted])
    assert 0.0 < np.linalg.norm(predicted_m - truth, axis=1).max() < 0.3
    assert len(result.trajectory()) == len(result.covariances().matrices) == 4
    every = {"with_predicted": True}
    assert len(result.trajectory(**every)) == len(result.covariances(**every).matrices) == 6
    assert supply.told == list(result.answers)
