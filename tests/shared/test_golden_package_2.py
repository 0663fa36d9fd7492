"""A package of format 2 written once and kept: every later fleetmap must read it, number by number.

``golden/map_format_2`` is never written again. When format 3 comes, its golden package is what
``pytest tests/shared/test_golden_package_2.py --basetemp=draft`` leaves under ``draft/``: today's writer, given
the same map. Copy it beside the old ones, and keep this module for the old one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleetmap.map_package import MapPackage, open_package, verify_package, write_package
from fleetmap.visual_map import VisualMap

Explode = Callable[[bytes], tuple[dict[str, Any], bytes]]
FOLDER = Path(__file__).parent / "golden" / "map_format_2"
VERSION = "eee1a1e53ae8c5ce2407a324ab93e6977cd173902b601a9e7c779a9e12aa8d92"


@pytest.fixture(scope="module")
def golden() -> MapPackage:
    return open_package(FOLDER)


def golden_map() -> VisualMap:
    """The map of the package of format 1, and how exact it is."""
    earlier = open_package(FOLDER.parent / "map_format_1").visual_map()
    covariances = np.tile(np.diag([1e-6, 2e-6, 3e-6, 4e-4, 5e-4, 6e-4]), (8, 1, 1))
    covariances[:, 0, 4] = covariances[:, 4, 0] = 1e-5
    covariances[5] = np.nan
    across_m = 0.002 + 0.004 * np.arange(150)
    return replace(
        earlier,
        keyframes=replace(earlier.keyframes, covariances=covariances.astype(np.float32)),
        landmarks=replace(
            earlier.landmarks, sigmas_m=np.stack([across_m, across_m * 5.0], axis=1).astype(np.float32)
        ),
    )


def test_the_golden_package_is_whole_and_small(golden: MapPackage) -> None:
    verify_package(golden)
    assert golden.version == VERSION
    assert sum(path.stat().st_size for path in FOLDER.rglob("*") if path.is_file()) < 50_000


def test_its_manifest_reads_as_written(golden: MapPackage) -> None:
    manifest = golden.manifest
    assert (manifest.format.major, manifest.format.minor, manifest.map_id) == (2, 0, "golden-street")
    assert manifest.localizable is not None
    cells = [part.size_bytes for part in manifest.parts if part.kind == "cell"]
    told = manifest.localizable
    assert (told.keyframes, told.landmarks, told.size_bytes) == (8, 150, sum(cells))
    assert [(part.kind, part.cell, part.keyframes, part.landmarks) for part in manifest.parts] == [
        ("cell", (3570, 42406), 6, 150),
        ("cell", (3570, 42407), 1, 20),
        ("cell", (3571, 42407), 1, 2),
        ("full", None, 8, 150),
    ]


def test_the_full_map_reads_as_that_of_format_1(golden: MapPackage) -> None:
    ours, earlier = golden.visual_map(), golden_map()
    assert ours.keyframes.positions_m.tolist() == earlier.keyframes.positions_m.tolist()
    assert ours.landmarks.points_m.tolist() == earlier.landmarks.points_m.tolist()
    np.testing.assert_array_equal(ours.keyframes.covariances, earlier.keyframes.covariances)


def test_the_localization_map_reads_number_by_number(golden: MapPackage) -> None:
    merged = golden.localization_map()
    landmarks, keyframes = merged.landmarks, merged.keyframes
    assert (len(keyframes), len(landmarks), len(merged.seen_landmark)) == (8, 150, 521)
    assert landmarks.points_m[42].tolist() == [-23.52, -16.48, -23.616]
    assert landmarks.points_m[0].tolist() == [-27.32, -19.152, 1.192]
    assert landmarks.descriptors[42, :6].tolist() == [149, 122, 164, 241, 106, 251]
    assert landmarks.octaves[42] == 1
    np.testing.assert_allclose(landmarks.distances_m[42], 62.64068, rtol=1e-6)
    np.testing.assert_allclose(landmarks.normals[42], [0.05843709, -0.2111645, 0.9757021], atol=1e-6)
    assert landmarks.sigmas_m is not None
    np.testing.assert_allclose(landmarks.sigmas_m[42], [0.1736407, 0.860048], rtol=1e-6)
    assert (merged.seen_by_keyframe[77], merged.seen_landmark[77]) == (1, 34)
    assert keyframes.stamps_ns[3] == 1_700_000_000_300_000_003
    np.testing.assert_allclose(keyframes.positions_m[3], [38.504, 51.645, 0.797], atol=1e-5)
    np.testing.assert_allclose(keyframes.rotations[3, 0], [0.2746448, 0.87866, 0.3905469], atol=1e-6)
    assert keyframes.covariances is not None
    assert np.isnan(keyframes.covariances[5]).all()
    np.testing.assert_allclose(
        np.diag(keyframes.covariances[3]),
        [1.154866e-06, 2.279564e-06, 3.202668e-06, 0.0004431836, 0.0005253077, 0.0006226498],
        rtol=1e-5,
    )
    np.testing.assert_allclose(keyframes.covariances[3, 0, 4], 1.008041e-05, rtol=1e-5)


def test_the_bytes_mean_what_the_format_says(golden: MapPackage, explode: Explode) -> None:
    """Landmark 42 read by hand: byte planes, zigzag, then steps of 32 mm from the corner of cell (3570, 42406)."""
    header, payload = explode(golden.part_bytes(golden.manifest.parts[0].sha256))
    item = next(item for item in header["arrays"] if item["name"] == "landmark_places")
    assert (item["dtype"], item["shape"], header["attributes"]["layout"]) == ("<u4", [4, 150], 2)
    planes = [payload[item["offset"] + plane * 600 :][:600] for plane in range(4)]
    steps = []
    for axis in range(3):
        stored = int.from_bytes(bytes(plane[150 * (axis + 1) + 42] for plane in planes), "little")
        steps.append(-(stored + 1) // 2 if stored % 2 else stored // 2)
    corner_m = np.array([3570 * 128 - 457_000, 42406 * 128 - 5_428_000, -116])
    in_map_mm = np.array(steps) * 32 + corner_m * 1000
    assert (in_map_mm / 1000.0).tolist() == golden.localization_map().landmarks.points_m[42].tolist()


def test_todays_writer_makes_the_same_package(golden: MapPackage, explode: Explode, tmp_path: Path) -> None:
    """Inflated payloads are compared, since another deflate library may pack the same numbers into other bytes."""
    write_package(
        tmp_path / "map",
        golden_map(),
        map_id=golden.manifest.map_id,
        quality=golden.manifest.quality,
        provenance=golden.manifest.provenance,
    )
    written = open_package(tmp_path / "map")
    for ours, theirs in zip(written.manifest.parts, golden.manifest.parts, strict=True):
        assert explode(written.part_bytes(ours.sha256)) == explode(golden.part_bytes(theirs.sha256))
    unpacked = {key: getattr(golden.manifest, key) for key in ("format", "parts", "map_from_vis", "localizable")}
    assert written.manifest.model_copy(update=unpacked) == golden.manifest
