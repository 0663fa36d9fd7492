"""Cells: a map cut along the 128 m UTM grid and put together again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleetmap.cells import Cell, decode_cell, encode_cell, merge_cells, split_into_cells, whole_map
from fleetmap.errors import MapPackageError
from fleetmap.full_part import decode_full, encode_full
from fleetmap.geodesy import UtmAnchor
from fleetmap.manifest import Manifest, PartRecord, Provenance, Quality
from fleetmap.map_package import write_package
from fleetmap.parts import DTYPES, encode_part
from fleetmap.visual_map import LocalizationMap, VisualMap

MakeMap = Callable[..., VisualMap]
Explode = Callable[[bytes], tuple[dict[str, Any], bytes]]
Assemble = Callable[..., bytes]
ANCHORS = {
    "Karlsruhe": UtmAnchor(32632, 457_000, 5_428_000, 116),
    "Svalbard": UtmAnchor(32633, 514_123, 8_683_317, -3),
    "Cape Town": UtmAnchor(32734, 262_001, 6_243_999, 12),
    "equator": UtmAnchor(32637, 166_100, -60, 1_800),
}


def record_of(index: tuple[int, int], cell: Cell) -> PartRecord:
    return PartRecord(
        kind="cell",
        sha256="0" * 64,
        size_bytes=1,
        cell=index,
        keyframes=len(cell.keyframe_ids),
        landmarks=len(cell.landmark_ids),
    )


def through_bytes(visual_map: VisualMap) -> dict[tuple[int, int], Cell]:
    return {
        index: decode_cell(
            encode_cell(index, cell, visual_map.anchor), record_of(index, cell), visual_map.anchor, "here"
        )
        for index, cell in split_into_cells(whole_map(visual_map)).items()
    }


def assert_localizes_like(merged: LocalizationMap, visual_map: VisualMap) -> None:
    """Everything observed is there once, in the order of the map, within what the format promises."""
    observed = np.unique(visual_map.observations.landmark_index)
    assert merged.anchor == visual_map.anchor
    np.testing.assert_array_equal(merged.keyframes.stamps_ns, visual_map.keyframes.stamps_ns)
    np.testing.assert_allclose(merged.keyframes.positions_m, visual_map.keyframes.positions_m, rtol=0, atol=5.1e-4)
    np.testing.assert_allclose(merged.keyframes.rotations, visual_map.keyframes.rotations, rtol=0, atol=1.5e-5)
    landmarks = visual_map.landmarks
    errors_m = np.linalg.norm(merged.landmarks.points_m - landmarks.points_m[observed], axis=1)
    assert 1e-5 < errors_m.max() < 1e-3
    np.testing.assert_array_equal(merged.landmarks.descriptors, landmarks.descriptors[observed])
    np.testing.assert_array_equal(merged.landmarks.octaves, landmarks.octaves[observed])
    np.testing.assert_allclose(merged.landmarks.distances_m, landmarks.distances_m[observed], rtol=0.0205)
    np.testing.assert_allclose(np.linalg.norm(merged.landmarks.normals, axis=1), 1.0, rtol=1e-6)
    turned_rad = np.arccos(np.clip(np.sum(merged.landmarks.normals * landmarks.normals[observed], axis=1), -1, 1))
    assert np.degrees(turned_rad.max()) < 1.0
    assert merged.landmarks.angles_deg is not None
    assert landmarks.angles_deg is not None
    turned_deg = (merged.landmarks.angles_deg - landmarks.angles_deg[observed] + 180.0) % 360.0 - 180.0
    assert np.abs(turned_deg).max() < 2.82
    pairs = set(zip(merged.seen_by_keyframe.tolist(), observed[merged.seen_landmark].tolist(), strict=True))
    observations = visual_map.observations
    assert pairs == set(
        zip(observations.keyframe_index.tolist(), observations.landmark_index.tolist(), strict=True)
    )
    assert len(pairs) == len(merged.seen_by_keyframe)
    assert (np.diff(merged.seen_by_keyframe) >= 0).all()
    assert merged.seen_by_keyframe.dtype == merged.seen_landmark.dtype == np.int32


@pytest.mark.parametrize("place", ANCHORS)
def test_all_cells_together_are_the_map_within_a_millimetre(make_map: MakeMap, place: str) -> None:
    visual_map = make_map(anchor=ANCHORS[place])
    cells = through_bytes(visual_map)
    assert 4 <= len(cells) <= 8
    assert_localizes_like(merge_cells(visual_map.anchor, list(cells.values())), visual_map)


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    keyframes=st.integers(1, 30),
    landmarks=st.integers(50, 200),
    length_m=st.floats(0.0, 3_000.0),
    place=st.sampled_from(sorted(ANCHORS)),
)
def test_any_map_survives(
    make_map: MakeMap, seed: int, keyframes: int, landmarks: int, length_m: float, place: str
) -> None:
    visual_map = make_map(seed, keyframes, landmarks, length_m, anchor=ANCHORS[place])
    assert_localizes_like(merge_cells(visual_map.anchor, list(through_bytes(visual_map).values())), visual_map)


def test_positions_survive_within_a_millimetre_far_from_the_anchor(make_map: MakeMap) -> None:
    visual_map = make_map()
    far = np.array([150_000.0, -200_000.0, 900.0])
    visual_map = replace(
        visual_map,
        keyframes=replace(visual_map.keyframes, positions_m=visual_map.keyframes.positions_m + far),
        landmarks=replace(visual_map.landmarks, points_m=visual_map.landmarks.points_m + far),
    )
    assert_localizes_like(merge_cells(visual_map.anchor, list(through_bytes(visual_map).values())), visual_map)


def test_every_keyframe_lies_in_its_cell_and_brings_all_that_it_sees(make_map: MakeMap) -> None:
    visual_map = make_map()
    observations = visual_map.observations
    for (east, north), cell in through_bytes(visual_map).items():
        in_utm = visual_map.anchor.utm_from_map(visual_map.keyframes.positions_m[cell.keyframe_ids])
        np.testing.assert_array_equal(np.floor(in_utm[:, 0] / 128), east)
        np.testing.assert_array_equal(np.floor(in_utm[:, 1] / 128), north)
        mine = np.isin(observations.keyframe_index, cell.keyframe_ids)
        np.testing.assert_array_equal(cell.landmark_ids, np.unique(observations.landmark_index[mine]))
        assert len(cell.seen_by_keyframe) == mine.sum()


def test_neighbours_share_landmarks_and_agree_on_them_to_the_bit(make_map: MakeMap) -> None:
    cells = list(through_bytes(make_map()).values())
    shared = 0
    for one, other in pairwise(cells):
        _, mine, theirs = np.intersect1d(one.landmark_ids, other.landmark_ids, return_indices=True)
        np.testing.assert_array_equal(one.landmarks.points_m[mine], other.landmarks.points_m[theirs])
        shared += len(mine)
    assert shared > 20


def test_some_cells_give_a_smaller_map_in_whatever_order(make_map: MakeMap) -> None:
    visual_map = make_map()
    one, other, *_ = through_bytes(visual_map).values()
    merged, turned = merge_cells(visual_map.anchor, [one, other]), merge_cells(visual_map.anchor, [other, one])
    assert len(merged.keyframes) == len(one.keyframe_ids) + len(other.keyframe_ids)
    assert len(merged.landmarks) == len(np.union1d(one.landmark_ids, other.landmark_ids))
    np.testing.assert_array_equal(merged.landmarks.points_m, turned.landmarks.points_m)
    np.testing.assert_array_equal(merged.seen_landmark, turned.seen_landmark)


def test_no_cells_give_an_empty_map() -> None:
    empty = merge_cells(ANCHORS["Karlsruhe"], [])
    assert (len(empty.keyframes), len(empty.landmarks), len(empty.seen_landmark)) == (0, 0, 0)


def test_a_keyframe_on_a_border_belongs_to_the_cell_that_begins_there(make_map: MakeMap) -> None:
    anchor = UtmAnchor(32632, 128 * 3_570, 128 * 42_406, 0)
    visual_map = make_map(keyframes=4, landmarks=60, anchor=anchor)
    positions_m = np.array([[0.0, 0.0, 1.0], [-1e-6, 0.0, 1.0], [128.0, 0.0, 1.0], [127.999999, 128.0, 1.0]])
    visual_map = replace(visual_map, keyframes=replace(visual_map.keyframes, positions_m=positions_m))
    cells = through_bytes(visual_map)
    assert {index: cell.keyframe_ids.tolist() for index, cell in cells.items()} == {
        (3_569, 42_406): [1],
        (3_570, 42_406): [0],
        (3_570, 42_407): [3],
        (3_571, 42_406): [2],
    }
    assert_localizes_like(merge_cells(anchor, list(cells.values())), visual_map)


def test_a_keyframe_that_sees_nothing_and_a_landmark_nobody_sees(make_map: MakeMap) -> None:
    visual_map = make_map(keyframes=3, landmarks=100, length_m=20.0)
    keep = (visual_map.observations.keyframe_index != 1) & (visual_map.observations.landmark_index != 40)
    observations = type(visual_map.observations)(
        *(column[keep] for column in vars(visual_map.observations).values())
    )
    visual_map = replace(visual_map, observations=observations)
    merged = merge_cells(visual_map.anchor, list(through_bytes(visual_map).values()))
    assert_localizes_like(merged, visual_map)
    assert 1 not in merged.seen_by_keyframe
    assert len(merged.landmarks) < 100


def with_precision(visual_map: VisualMap, sigma_m: float = 0.02) -> VisualMap:
    """The map with covariances that know no direction, at every other keyframe, and landmarks ever less exact."""
    covariances = np.tile(np.diag([1e-6] * 3 + [sigma_m**2] * 3), (len(visual_map.keyframes), 1, 1))
    covariances[1::2] = np.nan
    across_m = np.geomspace(1e-3, 5.0, len(visual_map.landmarks))
    sigmas_m = np.stack([across_m, across_m * 4.0], axis=1).astype(np.float32)
    return replace(
        visual_map,
        keyframes=replace(visual_map.keyframes, covariances=covariances.astype(np.float32)),
        landmarks=replace(visual_map.landmarks, sigmas_m=sigmas_m),
    )


def test_precision_comes_back_a_little_too_pessimistic_and_never_too_optimistic(make_map: MakeMap) -> None:
    visual_map = with_precision(make_map())
    merged = merge_cells(visual_map.anchor, list(through_bytes(visual_map).values()))
    observed = np.unique(visual_map.observations.landmark_index)
    assert merged.landmarks.sigmas_m is not None
    assert visual_map.landmarks.sigmas_m is not None
    rounding_m = 0.008 / np.sqrt(12.0)
    ratios = merged.landmarks.sigmas_m / np.hypot(visual_map.landmarks.sigmas_m[observed], rounding_m)
    assert ratios.min() > 0.9999
    assert 1.07 < ratios.max() < 1.084
    covariances = merged.keyframes.covariances
    assert covariances is not None
    np.testing.assert_array_equal(np.isnan(covariances[:, 0, 0]), np.arange(len(covariances)) % 2 == 1)


def test_a_map_that_does_not_tell_its_descriptors_orientations_comes_back_without_them(make_map: MakeMap) -> None:
    told = make_map()
    visual_map = replace(told, landmarks=replace(told.landmarks, angles_deg=None))
    merged = merge_cells(visual_map.anchor, list(through_bytes(visual_map).values()))
    assert merged.landmarks.angles_deg is None
    np.testing.assert_array_equal(
        merged.landmarks.descriptors,
        visual_map.landmarks.descriptors[np.unique(visual_map.observations.landmark_index)],
    )


def test_landmarks_are_rounded_no_more_than_they_are_uncertain_and_alike_in_every_cell(make_map: MakeMap) -> None:
    visual_map = with_precision(make_map())
    cells = list(through_bytes(visual_map).values())
    merged = merge_cells(visual_map.anchor, cells)
    observed = np.unique(visual_map.observations.landmark_index)
    assert visual_map.landmarks.sigmas_m is not None
    across_m = visual_map.landmarks.sigmas_m[observed, 0]
    rounded_m = np.abs(merged.landmarks.points_m - visual_map.landmarks.points_m[observed]).max(axis=1)
    assert 0.05 < rounded_m.max() < 0.52  # of half a step of 1,024 mm
    assert (rounded_m <= np.maximum(across_m / 8.0 * 1.09, 0.004) + 0.00051).all()
    shared = 0
    for one, other in pairwise(cells):
        _, mine, theirs = np.intersect1d(one.landmark_ids, other.landmark_ids, return_indices=True)
        np.testing.assert_array_equal(one.landmarks.points_m[mine], other.landmarks.points_m[theirs])
        shared += len(mine)
    assert shared > 20


def test_landmarks_come_and_go_as_often_as_they_like(make_map: MakeMap) -> None:
    """Every other keyframe, or at the beginning and the end only: who saw what is not smoothed over."""
    visual_map = make_map(keyframes=9, landmarks=60, length_m=20.0, observers=9)
    observations = visual_map.observations
    keep = (observations.keyframe_index % 2 == 0) | (observations.landmark_index % 3 == 0)
    observations = type(observations)(*(column[keep] for column in vars(observations).values()))
    visual_map = replace(visual_map, observations=observations)
    assert_localizes_like(merge_cells(visual_map.anchor, list(through_bytes(visual_map).values())), visual_map)


def test_a_cell_of_an_unknown_layout_asks_for_an_upgrade(make_map: MakeMap, explode: Explode) -> None:
    visual_map = make_map()
    (index, cell), *_ = split_into_cells(whole_map(visual_map)).items()
    header, _ = explode(encode_cell(index, cell, visual_map.anchor))
    later = encode_part("cell", header["attributes"] | {"layout": 3}, {})
    with pytest.raises(MapPackageError, match="cell layout that this fleetmap does not know; upgrade fleetmap"):
        decode_cell(later, record_of(index, cell), visual_map.anchor, "here")


def test_two_cells_that_claim_one_keyframe_are_refused(make_map: MakeMap) -> None:
    visual_map = make_map()
    one, *_ = through_bytes(visual_map).values()
    with pytest.raises(MapPackageError, match="two cells of the map claim the same keyframe"):
        merge_cells(visual_map.anchor, [one, one])


def test_a_cell_of_another_place_zone_or_size_is_refused(make_map: MakeMap) -> None:
    visual_map = make_map()
    (index, cell), *_ = split_into_cells(whole_map(visual_map)).items()
    data, record = encode_cell(index, cell, visual_map.anchor), record_of(index, cell)
    decode_cell(data, record, visual_map.anchor, "here")
    with pytest.raises(MapPackageError, match="here is not the cell"):
        decode_cell(data, record.model_copy(update={"cell": (index[0], index[1] + 1)}), visual_map.anchor, "here")
    with pytest.raises(MapPackageError, match="EPSG:32633"):
        decode_cell(data, record, replace(visual_map.anchor, epsg=32633), "here")
    with pytest.raises(MapPackageError, match="'keyframe_poses'"):
        decode_cell(data, record.model_copy(update={"keyframes": record.keyframes + 1}), visual_map.anchor, "here")
    with pytest.raises(MapPackageError, match="'landmark_places'"):
        decode_cell(data, record.model_copy(update={"landmarks": record.landmarks - 1}), visual_map.anchor, "here")
    with pytest.raises(MapPackageError, match="here is not the cell"):
        decode_cell(encode_full(visual_map), record, visual_map.anchor, "here")


Arrays = dict[str, np.ndarray[Any, Any]]


def put(name: str, place: Any, value: object) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        arrays[name][place] = value

    return change


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (put("runs", (0, 0), 2 * 10_000), "observing keyframes lie outside"),
        (put("runs", (0, 0), 1), "observing keyframes lie outside"),  # -1
        (put("runs", (1, -1), 10_000), "observing keyframes lie outside"),
        (put("runs", 1, 2**31), "more than 16777216 pairs"),
        (put("landmark_runs", 0, 2), "runs, there are"),
        (put("landmark_runs", 0, 2**32 - 1), "runs, there are"),
        (put("keyframe_poses", (0, 0), 2**32 - 1), "keyframe ids lie outside"),
        (put("keyframe_poses", (0, 1), 0), "keyframe ids are not ascending"),
        (put("keyframe_poses", (1, 0), 1), "a keyframe lies outside the cell"),  # -1 mm
        (put("keyframe_poses", (2, 0), 2 * 128_001), "a keyframe lies outside the cell"),
        (put("keyframe_poses", (3, 0), 2**32 - 2), "a keyframe lies outside the cell"),
        (put("keyframe_poses", (slice(4, 8), 0), 0), "no unit quaternions"),
        (put("keyframe_poses", (4, 0), 2**32 - 1), "no unit quaternions"),
        (put("landmark_places", (0, 0), 2**32 - 2), "landmark ids lie outside"),
        (put("landmark_places", (0, 1), 0), "landmark ids are not ascending"),
        (lambda arrays: arrays.pop("landmark_looks"), "lacks the array 'landmark_looks'"),
        (lambda arrays: arrays.update(landmark_runs=arrays["landmark_runs"][:-1]), "'landmark_runs'"),
        (lambda arrays: arrays.update(runs=arrays["runs"][:, :-1]), "runs, there are"),
        (put("keyframe_covariances", (slice(6, 21), 0), [127] * 5 + [129] * 10), "the covariance of a keyframe"),
    ],
)
def test_a_cell_that_contradicts_itself_is_refused(
    make_map: MakeMap, explode: Explode, change: Callable[[Arrays], None], complaint: str
) -> None:
    visual_map = with_precision(make_map())
    (index, cell), *_ = split_into_cells(whole_map(visual_map)).items()
    header, payload = explode(encode_cell(index, cell, visual_map.anchor))
    arrays = {item["name"]: values(item, payload) for item in header["arrays"]}
    change(arrays)
    with pytest.raises(MapPackageError, match=complaint):
        decode_cell(
            encode_part("cell", header["attributes"], arrays), record_of(index, cell), visual_map.anchor, "here"
        )


def values(item: dict[str, Any], payload: bytes) -> np.ndarray[Any, Any]:
    stored = np.frombuffer(payload[item["offset"] : item["offset"] + item["length"]], np.uint8)
    planes = stored.reshape(DTYPES[item["dtype"]].itemsize, -1)
    return np.array(planes.T, order="C").view(item["dtype"]).reshape(item["shape"])


@pytest.fixture(scope="module")
def small(
    make_map: MakeMap,
    quality_of: Callable[[VisualMap], Quality],
    provenance: Provenance,
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[VisualMap, Manifest]:
    visual_map = make_map(keyframes=4, landmarks=8, length_m=10.0)
    folder = tmp_path_factory.mktemp("small") / "map"
    quality = quality_of(visual_map)
    return visual_map, write_package(folder, visual_map, map_id="small", quality=quality, provenance=provenance)


json_values = st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | st.text(max_size=5)
json_values |= st.lists(json_values, max_size=3) | st.sampled_from(sorted(DTYPES))
header_changes = st.lists(
    st.tuples(st.sampled_from(["name", "dtype", "shape", "offset", "length"]), st.integers(0, 99), json_values),
    max_size=2,
)
payload_changes = st.lists(st.tuples(st.integers(0, 10**9), st.integers(0, 255)), max_size=4)


@settings(max_examples=300, deadline=None)
@given(header_changes, payload_changes, st.booleans())
def test_a_damaged_but_well_deflated_part_is_refused_or_still_a_sound_map(
    small: tuple[VisualMap, Manifest],
    explode: Explode,
    assemble: Assemble,
    headers: list[Any],
    bytes_changed: list[tuple[int, int]],
    is_full: bool,
) -> None:
    visual_map, manifest = small
    (index, cell), *_ = split_into_cells(whole_map(visual_map)).items()
    header, payload = explode(encode_full(visual_map) if is_full else encode_cell(index, cell, visual_map.anchor))
    damaged = bytearray(payload)
    for place, value in bytes_changed:
        damaged[place % len(damaged)] = value
    for field, number, value in headers:
        header["arrays"][number % len(header["arrays"])][field] = value
    data = assemble(header, bytes(damaged))
    try:
        if is_full:
            read: Any = decode_full(data, manifest, "here")
        else:
            decoded = decode_cell(data, record_of(index, cell), visual_map.anchor, "here")
            read = merge_cells(visual_map.anchor, [decoded])
    except MapPackageError:
        return
    assert np.isfinite(read.keyframes.positions_m).all()
    assert np.isfinite(read.landmarks.points_m).all()
    seen = read.observations.landmark_index if is_full else read.seen_landmark
    assert seen.max(initial=0) < len(read.landmarks)
