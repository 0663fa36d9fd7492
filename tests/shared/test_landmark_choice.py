"""Landmarks for localizers: as many as the budget holds, those that help most, everywhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import MapPackageError
from fleetmap.landmark_choice import choose_again, choose_for_localizing, localizable_part
from fleetmap.manifest import Provenance, Quality
from fleetmap.map_package import open_package, verify_package, write_package
from fleetmap.package_encoding import cell_parts
from fleetmap.visual_map import LocalizationMap, VisualMap

MakeMap = Callable[..., VisualMap]


@pytest.fixture(scope="module")
def street(make_map: MakeMap) -> VisualMap:
    """400 m whose landmarks lie before the cameras; the pixels are where they project, but for a little noise."""
    rng = np.random.default_rng(0)
    made = make_map(0, 200, 4000, 400.0, observers=12)
    heading = np.array([0.6, 0.8, 0.0])
    right = np.array([0.8, -0.6, 0.0])
    rotation = np.stack([right, [0.0, 0.0, -1.0], heading], axis=1)
    observations, positions_m = made.observations, made.keyframes.positions_m
    last = np.zeros(4000, np.int64)
    np.maximum.at(last, observations.landmark_index, observations.keyframe_index)
    ahead_m, aside_m, up_m = (
        rng.uniform(8.0, 40.0, 4000),
        rng.uniform(-12.0, 12.0, 4000),
        rng.uniform(-1.0, 5.0, 4000),
    )
    points_m = positions_m[last] + np.stack([ahead_m, aside_m, up_m]).T @ np.stack([heading, right, [0, 0, 1.0]])
    in_cam = (points_m[observations.landmark_index] - positions_m[observations.keyframe_index]) @ rotation
    pixels = made.camera.project_ideal(in_cam) + rng.normal(0.0, 0.5, (len(in_cam), 2))
    return replace(
        made,
        keyframes=replace(made.keyframes, rotations=np.tile(rotation, (200, 1, 1))),
        landmarks=replace(made.landmarks, points_m=points_m),
        observations=replace(
            observations, pixels=pixels.astype(np.float32), octaves=np.zeros(len(pixels), np.uint8)
        ),
    )


def size_bytes(content: LocalizationMap) -> int:
    return sum(len(data) for data, _ in cell_parts(content).values())


def length_km(visual_map: VisualMap) -> float:
    return float(np.linalg.norm(np.diff(visual_map.keyframes.positions_m, axis=0), axis=1).sum()) / 1000.0


@pytest.mark.parametrize("budget", [0.1, 0.3])
def test_the_budget_is_used_but_not_exceeded(street: VisualMap, budget: float) -> None:
    chosen = choose_for_localizing(street, budget)
    share = size_bytes(chosen) / (budget * 1e6 * length_km(street))
    assert 0.97 < share <= 1.0
    assert 300 < len(chosen.landmarks) < 4000


def test_every_keyframe_keeps_about_as_many_landmarks_and_none_is_bare(street: VisualMap) -> None:
    chosen = choose_for_localizing(street, 0.2)
    seen = np.bincount(chosen.seen_by_keyframe, minlength=len(chosen.keyframes))[5:-5]
    assert seen.min() > 0.5 * np.median(seen)
    assert seen.max() < 2.0 * np.median(seen)


def test_landmarks_seen_often_and_exact_ones_are_chosen(street: VisualMap) -> None:
    """Of landmarks alike in all else, half err by 3 px from image to image."""
    rng = np.random.default_rng(1)
    blurred = street.observations.landmark_index % 2 == 0
    pixels = street.observations.pixels + np.where(blurred[:, None], rng.normal(0.0, 3.0, (len(blurred), 2)), 0.0)
    spoilt = replace(street, observations=replace(street.observations, pixels=pixels.astype(np.float32)))
    chosen = choose_for_localizing(spoilt, 0.1)
    index = {point.tobytes(): n for n, point in enumerate(street.landmarks.points_m)}
    numbers = np.array([index[point.tobytes()] for point in chosen.landmarks.points_m])
    assert np.mean(numbers % 2 == 1) > 0.65
    counts = np.bincount(street.observations.landmark_index)
    assert counts[numbers].mean() > 1.3 * counts.mean()


def test_of_one_thing_mapped_twice_the_one_seen_more_often_is_preferred(street: VisualMap) -> None:
    """Every other landmark lies where the one before does, looks alike and is seen by one keyframe less."""
    observations = street.observations
    keep = observations.landmark_index % 2 == 0
    twin = {name: column[keep] for name, column in vars(observations).items()}
    last = np.zeros(4000, np.int64)
    np.maximum.at(last, twin["landmark_index"], twin["keyframe_index"])
    without_last = twin["keyframe_index"] != last[twin["landmark_index"]]
    other = {name: column[without_last] for name, column in twin.items()}
    other["landmark_index"] = other["landmark_index"] + np.int32(1)
    both = {name: np.concatenate([twin[name], other[name]]) for name in twin}
    order = np.lexsort((both["landmark_index"], both["keyframe_index"]))
    landmarks = type(street.landmarks)(
        *(
            None if column is None else np.repeat(column[::2], 2, axis=0)
            for column in vars(street.landmarks).values()
        )
    )
    nudge = np.tile([[0.0], [1e-4]], (2000, 1))
    landmarks = replace(landmarks, points_m=landmarks.points_m + nudge)
    doubled = replace(
        street,
        landmarks=landmarks,
        observations=type(observations)(**{name: column[order] for name, column in both.items()}),
    )
    chosen = choose_for_localizing(doubled, 0.15)
    index = {point.tobytes(): n for n, point in enumerate(landmarks.points_m)}
    numbers = np.array([index[point.tobytes()] for point in chosen.landmarks.points_m])
    assert np.mean(numbers % 2 == 0) > 0.65


def test_keyframes_are_thinned_and_what_dropped_ones_saw_is_not_lost(street: VisualMap) -> None:
    """Four times as dense."""
    keyframes, landmarks = street.keyframes, street.landmarks
    dense = replace(
        street,
        keyframes=replace(keyframes, positions_m=keyframes.positions_m / 4.0),
        landmarks=replace(landmarks, points_m=landmarks.points_m / 4.0),
    )
    chosen = choose_for_localizing(dense, 2.0)
    steps_m = np.linalg.norm(np.diff(chosen.keyframes.positions_m, axis=0), axis=1)
    assert steps_m.min() >= 1.5
    assert np.median(steps_m) < 2.5
    assert len(chosen.landmarks) == len(np.unique(street.observations.landmark_index))


def test_the_same_map_gives_the_same_choice(street: VisualMap) -> None:
    first, second = (cell_parts(choose_for_localizing(street, 0.2)) for _ in range(2))
    assert {index: data for index, (data, _) in first.items()} == {i: data for i, (data, _) in second.items()}


def test_without_a_limit_everything_is_kept(street: VisualMap) -> None:
    everything = localizable_part(street, 0.0)
    assert len(everything.keyframes) == 200
    assert len(everything.landmarks) == 4000
    assert len(everything.seen_landmark) == len(street.observations)
    assert everything.landmarks.sigmas_m is not None


def test_a_budget_that_has_no_room_for_keyframes_is_refused(street: VisualMap) -> None:
    with pytest.raises(MapPackageError, match=r"0\.005 MB/km are too few for the map's keyframes"):
        choose_for_localizing(street, 0.005)


def test_a_package_is_made_smaller_and_whole_again_without_mapping(
    street: VisualMap, quality_of: Callable[[VisualMap], Quality], provenance: Provenance, tmp_path: Path
) -> None:
    write_package(tmp_path / "all", street, map_id="street", quality=quality_of(street), provenance=provenance)
    small = choose_again(open_package(tmp_path / "all"), tmp_path / "small", 0.2)
    package = open_package(tmp_path / "small")
    verify_package(package)
    assert small.localizable is not None
    assert 0.97 * 0.2e6 * length_km(street) < small.localizable.size_bytes <= 0.2e6 * length_km(street)
    assert len(package.localization_map().landmarks) == small.localizable.landmarks < 4000
    choose_again(package, tmp_path / "again", 0.0)
    again, whole = (open_package(tmp_path / name).manifest for name in ("again", "all"))
    assert (again.parts, again.localizable) == (whole.parts, whole.localizable)
