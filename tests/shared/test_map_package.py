"""A map package on disk: whole or not at all, and read only if every byte is as it was written."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleetmap.errors import MapPackageError, OutputExistsError, StorageError
from fleetmap.geodesy import UtmAnchor, UtmGrid
from fleetmap.manifest import Manifest, Provenance, Quality, manifest_version
from fleetmap.map_package import MapPackage, decode_cells, open_package, verify_package, write_package
from fleetmap.visual_map import VisualMap

MakeMap = Callable[..., VisualMap]
Write = Callable[..., Manifest]


@pytest.fixture(scope="session")
def write(quality_of: Callable[[VisualMap], Quality], provenance: Provenance) -> Write:
    def write(folder: Path, visual_map: VisualMap, map_id: str = "street", **options: Any) -> Manifest:
        record = options.pop("quality", quality_of(visual_map))
        return write_package(folder, visual_map, map_id=map_id, quality=record, provenance=provenance, **options)

    return write


@pytest.fixture(scope="module")
def intact(write: Write, make_map: MakeMap, tmp_path_factory: pytest.TempPathFactory) -> MapPackage:
    """A package of a few kilobytes that tests read, and copy before they damage it."""
    folder = tmp_path_factory.mktemp("intact") / "street"
    write(folder, make_map(keyframes=6, landmarks=40, length_m=150.0))
    return open_package(folder)


def copy_of(package: MapPackage, folder: Path) -> MapPackage:
    shutil.copytree(package.folder, folder / "copy")
    return open_package(folder / "copy")


def part_path(package: MapPackage, kind: str) -> Path:
    record = next(record for record in package.manifest.parts if record.kind == kind)
    return package.folder / "parts" / f"{record.sha256}.bin"


def rewrite_manifest(package: MapPackage, change: Callable[[dict[str, Any]], None]) -> MapPackage:
    document = json.loads(package.manifest_bytes)
    change(document)
    (package.folder / "manifest.json").write_text(json.dumps(document))
    return open_package(package.folder)


def assert_equal_maps(read: VisualMap, written: VisualMap) -> None:
    assert (read.anchor, read.camera) == (written.anchor, written.camera)
    assert read.map_from_vis.scale == written.map_from_vis.scale
    np.testing.assert_allclose(read.map_from_vis.rotation, written.map_from_vis.rotation, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(read.map_from_vis.translation_m, written.map_from_vis.translation_m)
    for group in ("keyframes", "landmarks", "observations"):
        for field in fields(getattr(written, group)):
            ours, theirs = getattr(getattr(read, group), field.name), getattr(getattr(written, group), field.name)
            if theirs is None:
                assert ours is None
                continue
            assert ours.dtype == theirs.dtype
            np.testing.assert_array_equal(ours, theirs)


def test_a_map_that_does_not_tell_its_descriptors_orientations_comes_back_without_them(
    write: Write, make_map: MakeMap, tmp_path: Path
) -> None:
    told = make_map()
    written = replace(told, landmarks=replace(told.landmarks, angles_deg=None))
    write(tmp_path / "street", written)
    assert_equal_maps(open_package(tmp_path / "street").visual_map(), written)


@pytest.mark.parametrize("seed", range(3))
def test_the_whole_map_comes_back_exactly(write: Write, make_map: MakeMap, tmp_path: Path, seed: int) -> None:
    written = make_map(seed)
    write(tmp_path / "street", written)
    package = open_package(tmp_path / "street")
    verify_package(package)
    assert_equal_maps(package.visual_map(), written)


def test_a_map_read_and_written_again_keeps_every_hash(write: Write, make_map: MakeMap, tmp_path: Path) -> None:
    first = write(tmp_path / "one", make_map())
    again = write(tmp_path / "two", open_package(tmp_path / "one").visual_map())
    assert again.parts == first.parts


def test_the_same_map_gives_the_same_bytes(write: Write, make_map: MakeMap, tmp_path: Path) -> None:
    write(tmp_path / "one", make_map())
    write(tmp_path / "two", make_map())
    one, two = open_package(tmp_path / "one"), open_package(tmp_path / "two")
    assert one.manifest_bytes == two.manifest_bytes
    assert one.version == two.version == manifest_version(one.manifest_bytes)
    assert sorted(p.name for p in (tmp_path / "one/parts").iterdir()) == sorted(
        f"{record.sha256}.bin" for record in one.manifest.parts
    )


def test_the_localization_map_holds_all_keyframes(intact: MapPackage) -> None:
    localization, everything = intact.localization_map(), intact.visual_map()
    np.testing.assert_array_equal(localization.keyframes.stamps_ns, everything.keyframes.stamps_ns)
    assert len(localization.landmarks) == len(np.unique(everything.observations.landmark_index))


def test_cells_fetched_one_by_one_give_the_map_around_them(intact: MapPackage) -> None:
    records = [record for record in intact.manifest.parts if record.kind == "cell"]
    assert len(records) >= 2
    for record in records:
        piece = decode_cells(intact.manifest, [intact.part_bytes(record.sha256)])
        assert (len(piece.keyframes), len(piece.landmarks)) == (record.keyframes, record.landmarks)
    fetched = [intact.part_bytes(record.sha256) for record in reversed(records)]
    merged, whole = decode_cells(intact.manifest, [*fetched, fetched[0]]), intact.localization_map()
    np.testing.assert_array_equal(merged.landmarks.points_m, whole.landmarks.points_m)


def test_fetched_bytes_that_the_manifest_does_not_list_are_refused(intact: MapPackage) -> None:
    record = intact.manifest.parts[0]
    data = intact.part_bytes(record.sha256)
    with pytest.raises(MapPackageError, match="no cell part of map 'street'"):
        decode_cells(intact.manifest, [data[:-1] + bytes([data[-1] ^ 1])])
    with pytest.raises(MapPackageError, match="no cell part of map 'street'"):
        decode_cells(intact.manifest, [intact.part_bytes(intact.manifest.parts[-1].sha256)])


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 10**9), st.integers(1, 255))
def test_a_flipped_byte_anywhere_in_a_part_is_refused(
    intact: MapPackage, tmp_path_factory: pytest.TempPathFactory, number: int, place: int, flip: int
) -> None:
    records = intact.manifest.parts
    record = records[number % len(records)]
    data = bytearray(intact.part_bytes(record.sha256))
    data[place % len(data)] ^= flip
    folder = tmp_path_factory.mktemp("flipped")
    (folder / "parts").mkdir()
    (folder / "parts" / f"{record.sha256}.bin").write_bytes(data)
    damaged = replace(intact, folder=folder)
    with pytest.raises(MapPackageError, match=f"{record.sha256}.bin is damaged or was tampered with"):
        damaged.part_bytes(record.sha256)


@pytest.mark.parametrize("kind", ["cell", "full"])
@pytest.mark.parametrize("change", [lambda data: data[:-1], lambda data: data + b"x", lambda _: b""])
def test_a_part_of_another_size_is_refused(
    intact: MapPackage, tmp_path: Path, kind: str, change: Callable[[bytes], bytes]
) -> None:
    package = copy_of(intact, tmp_path)
    path = part_path(package, kind)
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(MapPackageError, match=f"{path} is not the .* bytes long"):
        verify_package(package)


@pytest.mark.parametrize("kind", ["cell", "full"])
def test_a_missing_part_is_named(intact: MapPackage, tmp_path: Path, kind: str) -> None:
    package = copy_of(intact, tmp_path)
    part_path(package, kind).unlink()
    with pytest.raises(MapPackageError, match=f"{part_path(package, kind)} is missing"):
        verify_package(package)


def test_a_localizer_does_without_the_full_part(intact: MapPackage, tmp_path: Path) -> None:
    package = copy_of(intact, tmp_path)
    part_path(package, "full").unlink()
    assert len(package.localization_map().keyframes) == 6
    with pytest.raises(MapPackageError, match="is missing"):
        package.visual_map()


def test_a_package_without_a_full_part_cannot_be_mapped_on(intact: MapPackage, tmp_path: Path) -> None:
    package = rewrite_manifest(copy_of(intact, tmp_path), lambda document: document["parts"].pop())
    with pytest.raises(MapPackageError, match="holds no full part"):
        package.visual_map()
    with pytest.raises(MapPackageError, match="holds no full part"):
        verify_package(package)


@pytest.mark.parametrize("sha256", ["", "0" * 64, "../manifest.json", "/etc/hostname", "x\n"])
def test_only_parts_of_the_manifest_can_be_asked_for(intact: MapPackage, sha256: str) -> None:
    with pytest.raises(MapPackageError, match="lists no part"):
        intact.part_bytes(sha256)


@pytest.mark.parametrize(
    "change",
    [
        lambda document: document["quality"].update(keyframes=7),
        lambda document: document["quality"].update(landmarks=41),
        lambda document: document["quality"].update(observations=1),
        lambda document: document["parts"][-1].update(keyframes=5),
        lambda document: document["parts"][-1].update(landmarks=39),
        lambda document: document["parts"][0].update(landmarks=document["parts"][0]["landmarks"] + 1),
        lambda document: document["parts"].pop(0),
        lambda document: document["parts"][0].update(cell=[1, 1]),
        lambda document: document["anchor"].update(northing_m=5_000_000),
        lambda document: document["anchor"].update(epsg=32633),
    ],
)
def test_a_manifest_that_contradicts_the_parts_is_found_out(
    intact: MapPackage, tmp_path: Path, change: Callable[[dict[str, Any]], None]
) -> None:
    verify_package(copy_of(intact, tmp_path))
    shutil.rmtree(tmp_path / "copy")
    with pytest.raises(MapPackageError):
        verify_package(rewrite_manifest(copy_of(intact, tmp_path), change))


def test_kinds_of_part_from_a_newer_version_are_carried_but_not_read(intact: MapPackage, tmp_path: Path) -> None:
    package = copy_of(intact, tmp_path)
    record = package.manifest.parts[-1]

    def add_part(document: dict[str, Any]) -> None:
        novel = {"kind": "lanes", "sha256": sha256, "size_bytes": len(data), "keyframes": 0, "landmarks": 0}
        document["parts"].append(novel)
        document["format"]["minor"] = 9
        document["weather"] = "fair"

    data = package.part_bytes(record.sha256) + b"!"
    sha256 = manifest_version(data)
    path = package.folder / "parts" / f"{sha256}.bin"
    path.write_bytes(data)
    newer = rewrite_manifest(package, add_part)
    verify_package(newer)
    assert_equal_maps(newer.visual_map(), intact.visual_map())
    assert newer.part_bytes(sha256) == data
    path.unlink()
    with pytest.raises(MapPackageError, match="is missing"):
        verify_package(newer)


def test_no_package_there_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(MapPackageError, match=r"no map package at .*nowhere; make one with 'fleetmap map'"):
        open_package(tmp_path / "nowhere")
    with pytest.raises(MapPackageError, match=r"is no map package: it holds no manifest\.json"):
        open_package(tmp_path)
    with pytest.raises(MapPackageError, match="cannot be read"):
        open_package(tmp_path / ("x" * 300))
    (tmp_path / "manifest.json").mkdir()
    with pytest.raises(MapPackageError, match=r"manifest\.json is missing"):
        open_package(tmp_path)


def test_an_existing_package_stays_unless_forced(write: Write, make_map: MakeMap, tmp_path: Path) -> None:
    target = tmp_path / "street"
    write(target, make_map(0))
    before = open_package(target).version
    with pytest.raises(OutputExistsError, match="--force"):
        write(target, make_map(1))
    assert open_package(target).version == before
    write(target, make_map(1), force=True)
    package = open_package(target)
    verify_package(package)
    assert package.version != before
    assert len(list((target / "parts").iterdir())) == len(package.manifest.parts)
    assert [path.name for path in tmp_path.iterdir()] == ["street"]


def test_force_replaces_nothing_but_maps(write: Write, make_map: MakeMap, tmp_path: Path) -> None:
    """A slip of the keyboard must not cost a user the home folder."""
    home, file, empty, extension = (tmp_path / name for name in ("home", "notes.txt", "empty", "extension"))
    home.mkdir()
    extension.mkdir()
    (extension / "manifest.json").write_text('{"name": "some browser extension"}')
    (home / "thesis.tex").write_text("years of work")
    file.write_text("notes")
    empty.mkdir()
    for target in (home, file, extension):
        with pytest.raises(OutputExistsError, match="is not a map package, --force will not replace it"):
            write(target, make_map(), force=True)
    assert (home / "thesis.tex").read_text() == "years of work"
    assert file.read_text() == "notes"
    write(empty, make_map(), force=True)
    verify_package(open_package(empty))


def test_a_damaged_package_can_be_replaced(write: Write, make_map: MakeMap, tmp_path: Path) -> None:
    write(tmp_path / "street", make_map())
    manifest = tmp_path / "street" / "manifest.json"
    manifest.write_bytes(manifest.read_bytes()[:-40])
    with pytest.raises(MapPackageError, match="is not JSON"):
        open_package(tmp_path / "street")
    write(tmp_path / "street", make_map(), force=True)
    verify_package(open_package(tmp_path / "street"))


def test_the_current_folder_can_be_the_target(
    write: Write, make_map: MakeMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    write(Path(), make_map(), force=True)
    verify_package(open_package(tmp_path / "here"))


def test_a_link_to_a_package_is_followed(write: Write, make_map: MakeMap, tmp_path: Path) -> None:
    write(tmp_path / "real", make_map(0))
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write(tmp_path / "link", make_map(1), force=True)
    assert (tmp_path / "link").is_symlink()
    assert open_package(tmp_path / "real").version == open_package(tmp_path / "link").version


def test_a_place_that_cannot_be_written_is_one_line(write: Write, make_map: MakeMap, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match=r"cannot write .*File exists|cannot write .*Not a directory"):
        write(tmp_path / "file" / "street", make_map())
    with pytest.raises(StorageError, match=r"cannot write .*File name too long"):
        write(tmp_path / ("x" * 300), make_map())


FULL_DISK = """
import resource, signal, sys
from pathlib import Path
from fleetmap.errors import StorageError
from fleetmap.map_package import open_package, write_package

source, target, limit = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
package = open_package(source)
visual_map = package.visual_map()
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
try:
    write_package(
        target, visual_map, map_id="street", quality=package.manifest.quality,
        provenance=package.manifest.provenance, force=True,
    )
except StorageError as error:
    print(error)
"""


@pytest.mark.skipif(os.name != "posix", reason="resource limits are POSIX")
@pytest.mark.parametrize("existing", [False, True])
def test_a_full_disk_leaves_what_was_there(intact: MapPackage, tmp_path: Path, existing: bool) -> None:
    target = tmp_path / "street"
    if existing:
        shutil.copytree(intact.folder, target)
    largest = max(record.size_bytes for record in intact.manifest.parts)
    command = [sys.executable, "-c", FULL_DISK, str(intact.folder), str(target)]
    refused = subprocess.run([*command, str(largest - 1)], capture_output=True, text=True, check=True)
    assert refused.stdout == f"cannot write {target}: File too large\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == (["street"] if existing else [])
    if existing:
        verify_package(open_package(target))
    fits = subprocess.run([*command, str(largest)], capture_output=True, text=True, check=True)
    assert fits.stdout == ""
    verify_package(open_package(target))


def spoilt(visual_map: VisualMap, group: str, field: str, value: Callable[[Any], Any]) -> VisualMap:
    old = getattr(visual_map, group)
    return replace(visual_map, **{group: replace(old, **{field: value(getattr(old, field).copy())})})


def with_first(value: object) -> Callable[[Any], Any]:
    def change(column: Any) -> Any:
        column[0] = value
        return column

    return change


@pytest.mark.parametrize(
    ("group", "field", "value", "complaint"),
    [
        (
            "keyframes",
            "positions_m",
            with_first(np.nan),
            "'keyframe_positions_m' holds numbers that are not finite",
        ),
        ("keyframes", "positions_m", with_first(2e6), "a keyframe lies more than 1,000 km from"),
        ("keyframes", "rotations", with_first(np.diag([1.0, 1.0, -1.0])), "are no rotations"),
        ("keyframes", "rotations", with_first(np.eye(3) * 1.001), "are no rotations"),
        ("keyframes", "stamps_ns", with_first(2**62), "keyframe stamps are not ascending"),
        ("landmarks", "points_m", with_first(np.inf), "not finite"),
        ("landmarks", "points_m", with_first(-1.1e6), "a landmark lies more than 1,000 km from"),
        ("landmarks", "distances_m", with_first(-1.0), "negative distance"),
        ("landmarks", "octaves", lambda column: column[1:], "'landmark_octaves' has shape"),
        ("landmarks", "angles_deg", lambda column: column[1:], "'landmark_angles_deg' is not one finite number"),
        ("landmarks", "angles_deg", with_first(np.nan), "'landmark_angles_deg' is not one finite number"),
        ("observations", "landmark_index", with_first(10_000), "observed landmarks lie outside the 900 there are"),
        ("observations", "landmark_index", with_first(-1), "observed landmarks lie outside"),
        ("observations", "keyframe_index", with_first(60), "observed keyframes lie outside the 60 there are"),
        ("observations", "keyframe_index", with_first(59), "observations are not sorted by keyframe"),
        ("observations", "pixels", with_first(np.nan), "not finite"),
    ],
)
def test_a_broken_map_is_not_written(
    write: Write, make_map: MakeMap, tmp_path: Path, group: str, field: str, value: Any, complaint: str
) -> None:
    with pytest.raises(MapPackageError, match=f"map 'street': .*{complaint}"):
        write(tmp_path / "street", spoilt(make_map(), group, field, value))
    assert list(tmp_path.iterdir()) == []


def test_a_map_must_hold_keyframes_and_agree_with_its_quality_record(
    write: Write, make_map: MakeMap, quality_of: Callable[[VisualMap], Quality], tmp_path: Path
) -> None:
    visual_map = make_map()
    wrong = quality_of(visual_map).model_copy(update={"landmarks": 899})
    with pytest.raises(MapPackageError, match="900 landmarks, its quality record says 899"):
        write(tmp_path / "street", visual_map, quality=wrong)
    with pytest.raises(MapPackageError, match="map 'street' holds no keyframes"):
        write(tmp_path / "street", make_map(keyframes=0, landmarks=0))


@pytest.mark.parametrize("map_id", ["", "Street", "../up", "a/b", "-x", "a" * 65, "street\n", "straße"])
def test_a_name_that_cannot_be_a_map_id_is_refused(
    write: Write, make_map: MakeMap, tmp_path: Path, map_id: str
) -> None:
    with pytest.raises(MapPackageError, match="cannot be a map id; take 1 to 64 of a-z"):
        write(tmp_path / "street", make_map(), map_id)


@pytest.mark.parametrize(
    "anchor", [UtmAnchor(32632, 457_000, 5_428_000, 116), UtmAnchor(32734, 262_001, 6_243_999, 12)]
)
def test_the_catalogue_fields_say_where_the_map_lies(
    write: Write, make_map: MakeMap, tmp_path: Path, anchor: UtmAnchor
) -> None:
    visual_map = make_map(anchor=anchor)
    manifest = write(tmp_path / "street", visual_map)
    west, south, east, north = manifest.bbox_lonlat
    lon_deg, lat_deg = np.array(manifest.trajectory_lonlat).T
    assert 30 < len(lon_deg) <= 42
    assert west <= lon_deg.min() < lon_deg.max() <= east
    assert south <= lat_deg.min() < lat_deg.max() <= north
    in_utm = UtmGrid(anchor.epsg).from_geodetic(lat_deg[[0, -1]], lon_deg[[0, -1]], np.zeros(2))
    ends = anchor.utm_from_map(visual_map.keyframes.positions_m[[0, -1]])
    np.testing.assert_allclose(in_utm[:, :2], ends[:, :2], atol=0.02)
    grid = UtmGrid(anchor.epsg).from_geodetic(np.array([south, north]), np.array([west, east]), np.zeros(2))
    assert 350.0 < np.linalg.norm(grid[1] - grid[0]) < 450.0


def test_across_the_antimeridian_west_is_greater_than_east(
    write: Write, make_map: MakeMap, tmp_path: Path
) -> None:
    border = UtmGrid(32601).from_geodetic(np.array([-17.0]), np.array([-180.0]), np.zeros(1))[0]
    anchor = UtmAnchor(32701, int(border[0]) - 120, int(border[1]) + 10_000_000, 0)
    west, south, east, north = write(tmp_path / "street", make_map(anchor=anchor)).bbox_lonlat
    assert 179.99 < west <= 180.0
    assert -180.0 <= east < -179.99
    assert -17.01 < south < north < -16.99


def test_a_map_of_one_keyframe_is_a_map(write: Write, make_map: MakeMap, tmp_path: Path) -> None:
    manifest = write(tmp_path / "street", make_map(keyframes=1, landmarks=5))
    verify_package(open_package(tmp_path / "street"))
    assert len(manifest.trajectory_lonlat) == 1


def test_a_cell_takes_less_than_48_bytes_per_landmark(write: Write, make_map: MakeMap, tmp_path: Path) -> None:
    """32 of them descriptor, which nothing packs; positions about 6.5, directions 4, who sees what 1.5."""
    manifest = write(tmp_path / "street", make_map(keyframes=100, landmarks=10_000, length_m=100.0))
    for record in manifest.parts:
        if record.kind == "cell" and record.landmarks > 1_000:
            assert 36.0 < record.size_bytes / record.landmarks < 48.0
