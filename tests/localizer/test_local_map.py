"""Where landmarks should be seen, by which camera, and at which size."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Pose, so3_exp
from fleetmap.visual_map import Keyframes, Landmarks, LocalizationMap
from fleetmap_localizer.local_map import LocalMap
from fleetmap_localizer.settings import LocalMapSettings

SURVEY = Camera(640, 400, 400.0, 400.0, 319.5, 199.5)
LOOKING_ALONG_X = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # columns: right, down, forward
OCTAVE, SEEN_FROM_M = 3, 10.0


def map_along_x(count: int = 30) -> LocalizationMap:
    """A keyframe every two metres; landmark i is seen by keyframes i and i + 1, ten metres ahead of the first."""
    x = 2.0 * np.arange(count)
    landmarks = np.stack([x + SEEN_FROM_M, np.zeros(count), np.zeros(count)], axis=1)
    pairs = sorted([(i, i) for i in range(count)] + [(i + 1, i) for i in range(count - 1)])
    by_keyframe, landmark = np.array(pairs, dtype=np.int32).T.copy()
    return LocalizationMap(
        UtmAnchor(32632, 0, 0, 0),
        Keyframes(
            np.arange(count, dtype=np.int64),
            np.repeat(LOOKING_ALONG_X[None], count, axis=0),
            np.stack([x, np.zeros(count), np.zeros(count)], axis=1),
        ),
        Landmarks(
            landmarks,
            np.zeros((count, 32), np.uint8),
            np.repeat(np.array([[-1.0, 0.0, 0.0]], np.float32), count, axis=0),
            np.full(count, OCTAVE, np.uint8),
            np.full(count, SEEN_FROM_M, np.float32),
        ),
        by_keyframe,
        landmark,
    )


def local_map(camera: Camera = SURVEY, **settings: float) -> LocalMap:
    return LocalMap(map_along_x(), SURVEY.fx_px, camera, 8, 1.2, LocalMapSettings(**settings))  # type: ignore[arg-type]


def at(x: float, turned_rad: float = 0.0) -> Pose:
    return Pose(so3_exp(np.array([0.0, 0.0, turned_rad])) @ LOOKING_ALONG_X, np.array([x, 0.0, 0.0]))


def zoomed(factor: float) -> Camera:
    return Camera(640, 400, 400.0 * factor, 400.0 * factor, 319.5, 199.5)


@pytest.mark.parametrize(
    ("camera", "distance_m", "octave"),
    [
        (SURVEY, SEEN_FROM_M, OCTAVE),
        (SURVEY, SEEN_FROM_M * 1.2, OCTAVE - 1),
        (SURVEY, SEEN_FROM_M / 1.2**2, OCTAVE + 2),
        (zoomed(1.2), SEEN_FROM_M, OCTAVE + 1),
        (zoomed(2.0), SEEN_FROM_M * 2.0, OCTAVE),
        (zoomed(0.5), SEEN_FROM_M / 2.0, OCTAVE),
    ],
)
def test_the_octave_follows_from_distance_and_focal_length(camera, distance_m, octave) -> None:
    predictions = local_map(camera).predict(np.array([4]), at(8.0 + SEEN_FROM_M - distance_m))
    assert predictions.octaves.tolist() == [octave]
    assert np.allclose(predictions.pixels, [[319.5, 199.5]])


def test_what_lies_behind_beside_or_is_seen_from_its_back_is_not_expected() -> None:
    look = local_map()
    every = np.arange(30)
    seen = look.predict(every, at(20.0)).landmarks
    assert seen.min() == 7  # at 24 m: those before it would be larger than the coarsest octave shows
    assert len(look.predict(every, at(20.0, turned_rad=np.pi)).landmarks) == 0  # backs of the landmarks before
    assert len(look.predict(every, at(20.0, turned_rad=np.pi / 2)).landmarks) == 0


def test_landmarks_of_keyframes_and_their_companions() -> None:
    look = local_map()
    assert look.landmarks_of(np.array([5])).tolist() == [4, 5]
    assert look.landmarks_of(np.array([5, 6])).tolist() == [4, 5, 6]
    assert look.landmarks_of(np.array([5, 6]), max_count=1).tolist() == [5]  # both saw it
    assert sorted(look.covisible(5, min_shared=1, count=8).tolist()) == [4, 6]
    assert look.covisible(5, min_shared=2, count=8).tolist() == []


def test_the_nearest_keyframes_that_look_the_same_way_bring_their_landmarks() -> None:
    assert local_map(keyframes=1).landmarks_around(at(20.4)).tolist() == [9, 10]
    assert local_map(keyframes=3).landmarks_around(at(20.4)).tolist() == [8, 9, 10, 11]
