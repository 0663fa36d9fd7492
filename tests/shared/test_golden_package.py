"""A package written once and kept: every later fleetmap must read it, number by number.

``golden/map_format_1`` is never written again; test_golden_package_2 is about what today's writer makes.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleetmap.geodesy import UtmAnchor
from fleetmap.map_package import MapPackage, open_package, verify_package

Explode = Callable[[bytes], tuple[dict[str, Any], bytes]]
FOLDER = Path(__file__).parent / "golden" / "map_format_1"
VERSION = "2ec305b866cc53048908270ed42bbeb0f62757889a5d8c87a62c00f9692afb44"


@pytest.fixture(scope="module")
def golden() -> MapPackage:
    return open_package(FOLDER)


def test_the_golden_package_is_whole_and_small(golden: MapPackage) -> None:
    verify_package(golden)
    assert golden.version == VERSION
    assert sum(path.stat().st_size for path in FOLDER.rglob("*") if path.is_file()) < 100_000


def test_what_its_writer_did_not_know_is_not_told(golden: MapPackage) -> None:
    assert golden.manifest.localizable is None
    for content in (golden.visual_map(), golden.localization_map()):
        assert content.keyframes.covariances is None
        assert content.landmarks.sigmas_m is None


def test_its_manifest_reads_as_written(golden: MapPackage) -> None:
    manifest = golden.manifest
    assert (manifest.format.major, manifest.format.minor, manifest.map_id) == (1, 0, "golden-street")
    assert manifest.bbox_lonlat == (8.412062, 49.0033983, 8.4132858, 49.0044827)
    assert [(part.kind, part.cell, part.keyframes, part.landmarks) for part in manifest.parts] == [
        ("cell", (3570, 42406), 6, 150),
        ("cell", (3570, 42407), 1, 20),
        ("cell", (3571, 42407), 1, 2),
        ("full", None, 8, 150),
    ]
    assert (manifest.quality.observations, manifest.quality.warnings) == (521, ("a warning",))
    assert (manifest.provenance.drive, manifest.provenance.settings) == ("golden.mcap", {"gnss": "full"})


def test_the_full_map_reads_number_by_number(golden: MapPackage) -> None:
    full = golden.visual_map()
    assert full.anchor == UtmAnchor(32632, 457_000, 5_428_000, 116)
    assert full.map_from_vis.scale == 12.25
    assert full.map_from_vis.translation_m.tolist() == [-8.627984081671087, 34.65082560345918, -24.42727483724144]
    assert (full.camera.width_px, full.camera.fx_px, full.camera.distortion[0]) == (1392, 959.8, -0.37)
    keyframes, landmarks, observations = full.keyframes, full.landmarks, full.observations
    assert keyframes.stamps_ns[3] == 1_700_000_000_300_000_003
    assert keyframes.positions_m[3].tolist() == [38.5036559130796, 51.64459177457416, 0.7972687045892738]
    assert keyframes.rotations[3, 0].tolist() == [0.27464717243764913, 0.8786585142534701, 0.3905485193953352]
    assert landmarks.points_m[42].tolist() == [-23.505142251582186, -16.474739991175383, -23.63104675129015]
    assert landmarks.descriptors[42, :6].tolist() == [149, 122, 164, 241, 106, 251]
    assert (landmarks.octaves[42], landmarks.distances_m[42]) == (1, np.float32(63.136856))
    assert landmarks.normals[42].tolist() == [0.05444355309009552, -0.20301105082035065, 0.9776617288589478]
    assert (observations.keyframe_index[77], observations.landmark_index[77], observations.octaves[77]) == (
        1,
        34,
        4,
    )
    assert observations.pixels[77].tolist() == [8.579756736755371, 269.27520751953125]


def test_the_localization_map_reads_number_by_number(golden: MapPackage) -> None:
    merged = golden.localization_map()
    assert (len(merged.keyframes), len(merged.landmarks), len(merged.seen_landmark)) == (8, 150, 521)
    assert merged.landmarks.points_m[42].tolist() == [-23.505, -16.475, -23.631]
    assert merged.landmarks.descriptors[42, :6].tolist() == [149, 122, 164, 241, 106, 251]
    assert (merged.landmarks.octaves[42], merged.landmarks.distances_m[42]) == (1, 63.125)
    np.testing.assert_allclose(merged.landmarks.normals[42], [0.05516601, -0.20490234, 0.97722656], atol=1e-6)
    assert (merged.seen_by_keyframe[77], merged.seen_landmark[77]) == (1, 34)
    np.testing.assert_allclose(merged.keyframes.positions_m, golden.visual_map().keyframes.positions_m, atol=1e-8)


def test_the_bytes_mean_what_the_format_says(golden: MapPackage, explode: Explode) -> None:
    """Landmark 42 read by hand: byte planes, then millimetres from the corner of cell (3570, 42406)."""
    header, payload = explode(golden.part_bytes(golden.manifest.parts[0].sha256))
    item = next(item for item in header["arrays"] if item["name"] == "landmark_points_mm")
    assert (item["dtype"], item["shape"]) == ("<i4", [150, 3])
    planes = [payload[item["offset"] + plane * 450 :][:450] for plane in range(4)]
    place = 42 * 3
    in_cell_mm = [
        int.from_bytes(bytes(plane[place + axis] for plane in planes), "little", signed=True) for axis in range(3)
    ]
    assert in_cell_mm[0] + 3570 * 128_000 == 457_000_000 - 23_505
    assert in_cell_mm[1] + 42406 * 128_000 == 5_428_000_000 - 16_475
    assert in_cell_mm[2] == 116_000 - 23_631
