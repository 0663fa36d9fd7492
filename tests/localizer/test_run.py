"""A whole drive: the first map that knows the place, and no other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from fleetmap.errors import NoPoseError
from fleetmap_localizer.map_source import LocalizableMap, read_map
from fleetmap_localizer.run import localize_drive


@pytest.fixture
def street_map(mapped_street) -> LocalizableMap:
    return read_map(mapped_street.package)


@pytest.fixture
def elsewhere(street_map) -> LocalizableMap:
    """A map that shows nothing of the street: the same road with other descriptors."""
    landmarks = street_map.content.landmarks
    noise = np.random.default_rng(0).integers(0, 256, landmarks.descriptors.shape, dtype=np.uint8)
    content = replace(street_map.content, landmarks=replace(landmarks, descriptors=noise))
    return replace(street_map, map_id="elsewhere", content=content)


def test_a_drive_becomes_a_utm_trajectory(street_map, second_drive) -> None:
    result = localize_drive(second_drive.frames[:12], second_drive.camera, [street_map])
    assert (result.map_id, result.version) == ("street", street_map.version)
    assert result.frame_count == 12
    assert len(result.poses) >= 11
    trajectory = result.trajectory()
    assert trajectory.epsg == second_drive.truth.epsg
    index = np.searchsorted(second_drive.truth.stamps_ns, trajectory.stamps_ns)
    away_m = np.linalg.norm(trajectory.positions_m - second_drive.truth.positions_m[index], axis=1)
    assert 0.0 < np.median(away_m) < 0.05
    assert result.median_inliers == int(np.median([pose.inlier_count for pose in result.poses]))


def test_maps_are_asked_in_order_and_only_until_one_knows_the_place(street_map, elsewhere, second_drive) -> None:
    asked = []

    def maps() -> Iterator[LocalizableMap]:
        for candidate in (elsewhere, street_map, replace(elsewhere, map_id="never")):
            asked.append(candidate.map_id)
            yield candidate

    result = localize_drive(second_drive.frames[:4], second_drive.camera, maps())
    assert result.map_id == "street"
    assert len(result.poses) == 4
    assert asked == ["elsewhere", "street"]


def test_a_drive_that_enters_the_map_late_is_localised_from_there_on(
    street_map, foreign_drive, second_drive
) -> None:
    frames = [
        replace(frame, stamp_ns=second_drive.frames[0].stamp_ns - (5 - i) * 10**8)
        for i, frame in enumerate(foreign_drive.frames[:5])
    ]
    result = localize_drive(frames + second_drive.frames[:5], second_drive.camera, [street_map])
    assert result.frame_count == 10
    assert [pose.stamp_ns for pose in result.poses] == [frame.stamp_ns for frame in second_drive.frames[:5]]


def test_a_drive_that_no_map_knows_is_one_clear_error(street_map, elsewhere, foreign_drive) -> None:
    with pytest.raises(NoPoseError, match=r"not one of 3 images .* in map 'street', 'elsewhere'"):
        localize_drive(foreign_drive.frames[:3], foreign_drive.camera, [street_map, elsewhere])
