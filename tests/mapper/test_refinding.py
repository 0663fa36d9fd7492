"""Landmarks found again: on a road driven twice, and from a segment in a frame of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, Sim3, rotation_angle_rad, so3_exp
from fleetmap.vision.features import Features
from fleetmap_mapper.growing_map import GrowingMap
from fleetmap_mapper.refinding import tie_what_is_refound
from fleetmap_mapper.relative_placing import place_beside
from fleetmap_mapper.settings import MapperSettings
from fleetmap_mapper.slam import PosedFrame, Segment

CAMERA = Camera(640, 400, 430.0, 435.0, 322.0, 197.0)
SETTINGS = MapperSettings()
KEYFRAMES, STEP_M = 14, 1.5


@dataclass(frozen=True)
class Place:
    """Points along a straight road and what they look like."""

    points: np.ndarray  # (P, 3): x right, y down, z along the road
    descriptors: np.ndarray  # (P, 32)


def place(seed: int, points: int = 900) -> Place:
    rng = np.random.default_rng(seed)
    side = rng.choice([-1.0, 1.0], points) * rng.uniform(4.0, 12.0, points)
    cloud = np.stack([side, rng.uniform(-6.0, 1.5, points), rng.uniform(4.0, 50.0, points)], axis=1)
    return Place(cloud, rng.integers(0, 256, (points, 32), dtype=np.uint8))


def drive_past(growing: GrowingMap, seen: Place, rng: np.random.Generator, frame: Sim3, noise_px: float = 0.7):
    """Keyframes of a pass, in ``frame`` (vis_from_road), each landmark made by the first two that see it."""
    owner = np.full(len(seen.points), -1, np.int32)
    before = None
    for number in range(KEYFRAMES):
        road_from_cam = Pose(np.eye(3), np.array([0.0, 0.0, STEP_M * number]))
        pixels = CAMERA.project_ideal(road_from_cam.inverse().transform(seen.points))
        depth = seen.points[:, 2] - STEP_M * number
        shown = np.flatnonzero(CAMERA.is_inside(pixels) & (depth < 35.0))
        noise = rng.normal(0.0, noise_px, (len(shown), 2))
        flips = np.packbits(rng.random((len(shown), 256)) < 0.04, axis=1)
        features = Features(
            pixels[shown] + noise,
            np.zeros(len(shown), np.uint8),
            seen.descriptors[shown] ^ flips,
            np.zeros(len(shown), np.float32),
            1.2,
        )
        index = len(growing.keyframes)
        keyframe = growing.add_keyframe(
            index, index * 10**8, frame.transform_pose(road_from_cam), features, owner[shown]
        )
        if before is not None:
            both, first_rows, rows = np.intersect1d(before[1], shown, return_indices=True)
            new = owner[both] < 0
            owner[both[new]] = growing.add_landmarks(
                frame.transform(seen.points[both[new]]), before[0], first_rows[new], keyframe, rows[new]
            )
        before = keyframe, shown
    return owner


def two_passes(first: Place, second: Place, off: Sim3) -> tuple[GrowingMap, np.ndarray, np.ndarray]:
    """A road driven twice; the second time the map is off by a little."""
    growing, rng = GrowingMap(CAMERA), np.random.default_rng(1)
    owners = [drive_past(growing, seen, rng, frame) for seen, frame in ((first, Sim3.identity()), (second, off))]
    return growing, owners[0], owners[1]


def test_what_both_passes_see_becomes_one():
    """20 cm and half a degree of difference, as fixes leave it."""
    road = place(0)
    off = Sim3(1.0, so3_exp(np.array([0.0, 0.009, 0.0])), np.array([0.2, -0.05, 0.1]))
    growing, first, second = two_passes(road, road, off)
    segment_of = np.repeat([0, 1], KEYFRAMES)
    believed = tie_what_is_refound(growing, segment_of, SETTINGS)
    assert len(believed) > 1.5 * KEYFRAMES
    both = (first >= 0) & (second >= 0)
    became, wanted = growing.resolve(second[both]), growing.resolve(first[both])
    assert both.sum() > 300
    assert (became == wanted).mean() > 0.8
    fused = np.flatnonzero(growing.merged_into[: growing.landmark_count] != np.arange(growing.landmark_count))
    pairs = {int(a): int(b) for a, b in zip(second[both], first[both], strict=True)}
    pairs |= {b: a for a, b in pairs.items()}
    wrong = [
        i for i in fused.tolist() if growing.resolve(np.array([i]))[0] != growing.resolve(np.array([pairs[i]]))[0]
    ]
    assert len(wrong) < 0.01 * len(fused)
    shifts_m = [np.linalg.norm(r.shift.translation_m) for r in believed]
    assert 0.1 < np.median(shifts_m) < 0.6


def test_within_one_segment_a_second_pass_is_a_loop():
    road = place(0)
    growing, _, _ = two_passes(road, road, Sim3(1.0, np.eye(3), np.array([0.1, 0.0, 0.0])))
    believed = tie_what_is_refound(growing, np.zeros(2 * KEYFRAMES, np.int64), SETTINGS)
    assert any(r.keyframe.index >= KEYFRAMES for r in believed)
    assert all(abs(int(growing.reference[r.landmarks].max()) - r.keyframe.index) > 5 for r in believed)


def test_another_road_at_the_same_place_is_not_taken_for_this_one():
    growing, _, _ = two_passes(place(0), place(1), Sim3.identity())
    assert tie_what_is_refound(growing, np.repeat([0, 1], KEYFRAMES), SETTINGS) == []


def test_one_house_that_looks_like_another_convinces_nobody():
    """Everything in view repeats 9 m further on: each keyframe alone would believe it, but fixes say otherwise."""
    road = place(0)
    growing, _, _ = two_passes(road, road, Sim3(1.0, np.eye(3), np.array([0.0, 0.0, 9.0])))
    assert tie_what_is_refound(growing, np.repeat([0, 1], KEYFRAMES), SETTINGS) == []


def segment(road: Place, frame: Sim3, seed: int, first_stamp_ns: int) -> Segment:
    growing = GrowingMap(CAMERA)
    drive_past(growing, road, np.random.default_rng(seed), frame)
    posed = [
        PosedFrame(
            k.frame_index,
            first_stamp_ns + k.stamp_ns,
            k,
            Pose.identity(),
            k.landmarks(),
            np.zeros((0, 2)),
            np.zeros(0),
        )
        for k in growing.keyframes
    ]
    return Segment(growing, posed)


@pytest.mark.parametrize("is_later", [True, False], ids=["after", "before"])
def test_a_segment_is_placed_beside_another_by_what_both_saw(is_later):
    road = place(2)
    vis_from_road = Sim3(3.0, so3_exp(np.array([0.4, -1.0, 0.3])), np.array([20.0, -4.0, 7.0]))
    other = segment(road, vis_from_road, 5, 10**10 if is_later else -(10**10))
    found = place_beside(segment(road, Sim3.identity(), 4, 0), other, SETTINGS)
    assert found is not None
    left = found @ vis_from_road  # the identity, if all were right
    assert left.scale == pytest.approx(1.0, abs=0.01)
    assert 0.0 < np.degrees(rotation_angle_rad(left.rotation)) < 0.2
    assert 0.0 < np.linalg.norm(left.translation_m) < 0.1


def test_a_segment_that_saw_other_things_is_not_placed():
    other = segment(place(3), Sim3.identity(), 5, 10**10)
    assert place_beside(segment(place(2), Sim3.identity(), 4, 0), other, SETTINGS) is None
