"""manifest.json at the border: what holds is read, what does not is refused in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from fleetmap import manifest as manifest_module
from fleetmap.errors import MapPackageError
from fleetmap.manifest import Manifest, Provenance, Quality, check_map_id, manifest_version, parse_manifest
from fleetmap.map_package import write_package
from fleetmap.visual_map import VisualMap


@pytest.fixture(scope="module")
def data(
    make_map: Callable[..., VisualMap],
    quality_of: Callable[[VisualMap], Quality],
    provenance: Provenance,
    tmp_path_factory: pytest.TempPathFactory,
) -> bytes:
    visual_map = make_map(keyframes=20, landmarks=60)
    folder: Path = tmp_path_factory.mktemp("manifest") / "street"
    write_package(folder, visual_map, map_id="street", quality=quality_of(visual_map), provenance=provenance)
    return (folder / "manifest.json").read_bytes()


def changed(data: bytes, path: str, value: object) -> bytes:
    document = json.loads(data)
    *steps, last = [int(step) if step.isdigit() else step for step in path.split(".")]
    place: Any = document
    for step in steps:
        place = place[step]
    place[last] = value
    return json.dumps(document, separators=(",", ":")).encode()


def test_a_manifest_comes_back_byte_for_byte(data: bytes) -> None:
    manifest = parse_manifest(data, "here")
    assert manifest.to_bytes() == data
    assert manifest == Manifest.model_validate_json(data)
    assert len(manifest_version(data)) == 64


def test_fields_of_a_newer_minor_version_are_passed_over(data: bytes) -> None:
    newer = changed(changed(data, "format.minor", 7), "quality.confidence", {"new": [1]})
    manifest = parse_manifest(newer, "here")
    assert manifest.format.minor == 7
    assert manifest.quality == parse_manifest(data, "here").quality


@pytest.mark.parametrize("major", [3, 17, 10**4000])
def test_a_newer_major_version_asks_for_an_upgrade_whatever_else_it_changed(data: bytes, major: int) -> None:
    newer = json.dumps({"format": {"name": "fleetmap-map", "major": major}, "everything": "else"}).encode()
    with pytest.raises(
        MapPackageError, match=r"^here has map format \d{1,20}, this fleetmap reads 1 to 2; upgrade fleetmap$"
    ):
        parse_manifest(newer, "here")


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "null", "7", '"x"', "{}", '{"format": []}', '{"format": {"name": "zip"}}']
)
def test_what_is_no_manifest_is_refused(text: str) -> None:
    with pytest.raises(MapPackageError, match="here"):
        parse_manifest(text.encode(), "here")


def test_bytes_that_are_no_text_and_endless_nesting_are_refused() -> None:
    for broken in (b"\xff\xfe\x00", b"[" * 200_000, b'{"a":' * 200_000):
        with pytest.raises(MapPackageError, match="manifest of here is not JSON"):
            parse_manifest(broken, "here")


def test_a_manifest_beyond_the_limit_is_refused(data: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(manifest_module, "MAX_MANIFEST_BYTES", len(data) - 1)
    with pytest.raises(MapPackageError, match=f"larger than {len(data) - 1} bytes"):
        parse_manifest(data, "here")


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("format.major", "1"),
        ("format.major", None),
        ("format.major", 0),
        ("format.minor", -1),
        ("map_id", "Street"),
        ("map_id", "../street"),
        ("map_id", "street\n"),
        ("anchor.epsg", 4326),
        ("anchor.epsg", 32661),
        ("anchor.easting_m", 0.5),
        ("anchor.northing_m", 10**12),
        ("anchor.height_m", 10**6),
        ("map_from_vis.scale", 0.0),
        ("map_from_vis.scale", float("nan")),
        ("map_from_vis.quat_xyzw", [0, 0, 0, 0]),
        ("map_from_vis.quat_xyzw", [0, 0, 1]),
        ("map_from_vis.translation_m", [0, 0, float("inf")]),
        ("camera.width_px", 0),
        ("camera.fx_px", -1.0),
        ("camera.distortion", [0, 0, 0, 0]),
        ("bbox_lonlat", [8.0, 91.0, 9.0, 92.0]),
        ("bbox_lonlat", [181.0, 49.0, 182.0, 50.0]),
        ("trajectory_lonlat", [[8.0, 49.0, 100.0]]),
        ("trajectory_lonlat.0", [-200.0, 0.0]),
        ("parts", []),
        ("parts.0.kind", "../x"),
        ("parts.0.sha256", "A" * 64),
        ("parts.0.sha256", "../" * 20 + "abcd"),
        ("parts.0.sha256", "a" * 64 + "\n"),
        ("parts.0.size_bytes", 0),
        ("parts.0.size_bytes", 2**40),
        ("parts.0.keyframes", -1),
        ("parts.0.landmarks", 2**40),
        ("parts.0.cell", None),
        ("parts.0.cell", [1, 2, 3]),
        ("parts.0.cell", [10**9, 0]),
        ("parts.0.kind", "full"),
        ("quality.length_m", float("inf")),
        ("quality.gnss_mode", "some"),
        ("quality.keyframes", -1),
        ("quality.frames_posed", 2**63),
        ("provenance.created_ns", 2**63),
        ("provenance.drive_sha256", "beef"),
        ("provenance.settings", {"threshold": float("nan")}),
        ("provenance.settings", {"text": "\ud800"}),
    ],
)
def test_a_field_that_does_not_hold_is_refused(data: bytes, path: str, value: object) -> None:
    with pytest.raises(MapPackageError, match="manifest of here") as refusal:
        parse_manifest(changed(data, path, value), "here")
    assert "\n" not in str(refusal.value)


def test_a_part_listed_twice_is_refused(data: bytes) -> None:
    parts = json.loads(data)["parts"]
    with pytest.raises(MapPackageError, match="a part or a cell is listed twice"):
        parse_manifest(changed(data, "parts", [*parts, parts[0]]), "here")
    other = {**parts[0], "sha256": "0" * 64}
    with pytest.raises(MapPackageError, match="a part or a cell is listed twice"):
        parse_manifest(changed(data, "parts", [*parts, other]), "here")
    full = {**parts[-1], "sha256": "0" * 64}
    with pytest.raises(MapPackageError, match="more than one full part"):
        parse_manifest(changed(data, "parts", [*parts, full]), "here")


def test_more_parts_than_allowed_are_refused(data: bytes) -> None:
    part = json.loads(data)["parts"][0]
    parts = [{**part, "sha256": f"{number:064x}", "cell": [number, 0]} for number in range(100_001)]
    with pytest.raises(MapPackageError, match="'parts'"):
        parse_manifest(changed(data, "parts", parts), "here")


def test_settings_that_json_cannot_carry_are_refused_where_they_are_made(provenance: Provenance) -> None:
    for value in (float("nan"), b"bytes", {1, 2}):
        with pytest.raises(ValidationError, match="not plain JSON"):
            Provenance(**{**dict(provenance), "settings": {"value": value}})


def test_map_ids() -> None:
    for good in ("a", "0", "karlsruhe-2011_09_26", "x" * 64):
        check_map_id(good)
    for bad in ("", "_a", "A", "a b", "a.b", "x" * 65, "a\n", "é"):
        with pytest.raises(MapPackageError, match="cannot be a map id"):
            check_map_id(bad)


@settings(max_examples=300, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1, max_size=5))
def test_damaged_manifests_never_raise_anything_else(data: bytes, changes: list[tuple[int, int]]) -> None:
    damaged = bytearray(data)
    for place, value in changes:
        damaged[place % len(damaged)] = value
    try:
        parse_manifest(bytes(damaged), "here")
    except MapPackageError as error:
        refusal = str(error)
    else:
        refusal = ""
    assert "\n" not in refusal


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda children: st.lists(children, max_size=4) | st.dictionaries(st.text(max_size=8), children, max_size=4),
)
FIELDS = [
    *(
        "format",
        "map_id",
        "anchor",
        "map_from_vis",
        "camera",
        "bbox_lonlat",
        "trajectory_lonlat",
        "parts",
        "quality",
    ),
    *("provenance", "parts.0", "parts.0.cell", "parts.0.size_bytes", "anchor.epsg", "map_from_vis.quat_xyzw"),
]


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(FIELDS), json_values)
def test_whatever_stands_in_a_field_is_read_or_refused(data: bytes, path: str, value: object) -> None:
    document = changed(data, path, value)
    try:
        manifest = parse_manifest(document, "here")
    except MapPackageError:
        return
    assert parse_manifest(manifest.to_bytes(), "here") == manifest
