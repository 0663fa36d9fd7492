"""A package of format 2.1 written once and kept: like that of format 2.0, with orientations of descriptors.

``golden/map_format_2_1`` is never written again; see test_golden_package_2 for how the next one is made.
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
FOLDER = Path(__file__).parent / "golden" / "map_format_2_1"
VERSION = "4ff60e4101cc1253cb09d92febef2a161cefbc3f27093729f43dd9e90e645b47"


@pytest.fixture(scope="module")
def golden() -> MapPackage:
    return open_package(FOLDER)


def golden_map() -> VisualMap:
    """The map of the package of format 2.0, and along which orientations its landmarks were described."""
    earlier = open_package(FOLDER.parent / "map_format_2").visual_map()
    angles_deg = (7.3 * np.arange(150) % 360.0).astype(np.float32)
    return replace(earlier, landmarks=replace(earlier.landmarks, angles_deg=angles_deg))


def test_the_golden_package_is_whole_and_small(golden: MapPackage) -> None:
    verify_package(golden)
    assert golden.version == VERSION
    assert (golden.manifest.format.major, golden.manifest.format.minor) == (2, 1)
    assert sum(path.stat().st_size for path in FOLDER.rglob("*") if path.is_file()) < 50_000


def test_orientations_read_exactly_from_the_full_map(golden: MapPackage) -> None:
    ours = golden.visual_map().landmarks.angles_deg
    assert ours is not None
    assert ours.tolist() == golden_map().landmarks.angles_deg.tolist()  # type: ignore[union-attr]


def test_orientations_read_in_steps_of_a_64th_turn_from_the_cells(golden: MapPackage) -> None:
    ours = golden.localization_map().landmarks.angles_deg
    assert ours is not None
    assert ours[:4].tolist() == [0.0, 5.625, 16.875, 22.5]
    assert ours[49] == 0.0  # 357.7 degrees are nearer to a whole turn
    assert ours[42] == 309.375


def test_the_bytes_mean_what_the_format_says(golden: MapPackage, explode: Explode) -> None:
    header, payload = explode(golden.part_bytes(golden.manifest.parts[0].sha256))
    item = next(item for item in header["arrays"] if item["name"] == "landmark_angles")
    assert (item["dtype"], item["shape"]) == ("|u1", [150])
    assert payload[item["offset"] + 42] * 360.0 / 64.0 == 309.375


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
