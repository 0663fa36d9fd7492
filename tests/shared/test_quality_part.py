"""The quality part: a round trip, the same bytes for the same quality, and refusals at the border."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleetmap.errors import MapPackageError
from fleetmap.geodesy import UtmAnchor
from fleetmap.manifest import Provenance, Quality
from fleetmap.map_package import MapPackage, open_package, verify_package, write_package
from fleetmap.quality_part import decode_quality, encode_quality
from fleetmap.road_quality import FixQuality, KeyframeQuality, RoadQuality
from fleetmap.visual_map import VisualMap

ANCHOR = UtmAnchor(32632, 457_000, 5_428_000, 116)


def random_quality(keyframes: int = 30, fixes: int = 7, stamps_ns: np.ndarray | None = None) -> RoadQuality:
    rng = np.random.default_rng(keyframes)
    roots = rng.normal(0.0, 0.05, (keyframes, 3, 3))
    covariances_m2 = (roots @ roots.transpose(0, 2, 1)).astype(np.float32)
    covariances_m2[1] = np.nan
    along_m = np.sort(rng.uniform(0.0, 100.0, keyframes))
    if stamps_ns is None:
        stamps_ns = 1_700_000_000_000_000_000 + np.arange(keyframes, dtype=np.int64) * 100_000_007
    return RoadQuality(
        KeyframeQuality(
            stamps_ns,
            along_m,
            rng.normal(0.0, 300.0, (keyframes, 3)),
            covariances_m2,
            rng.uniform(0.5, 1.5, keyframes).astype(np.float32),
            rng.integers(0, 900, keyframes, dtype=np.int32),
        ),
        FixQuality(
            stamps_ns[:fixes] + 5,
            np.sort(rng.uniform(0.0, 100.0, fixes)),
            rng.normal(0.0, 0.1, (fixes, 3)).astype(np.float32),
            rng.uniform(0.0, 3.0, fixes).astype(np.float32),
            rng.uniform(0.01, 3.0, fixes).astype(np.float32),
        ),
        np.linspace(0.0, 100.0, 11),
        rng.uniform(0.0, 90.0, 10).astype(np.float32),
        stamps_ns[[3, 4]][None],
        along_m[[3, 4]][None],
    )


def assert_equal(ours: Any, theirs: Any) -> None:
    for field in fields(ours):
        mine, other = getattr(ours, field.name), getattr(theirs, field.name)
        if isinstance(mine, np.ndarray):
            assert mine.dtype == other.dtype
            np.testing.assert_array_equal(mine, other)
        else:
            assert_equal(mine, other)


@pytest.mark.parametrize(("keyframes", "fixes"), [(30, 7), (6, 0)])
def test_it_comes_back_number_by_number(keyframes: int, fixes: int) -> None:
    quality = random_quality(keyframes, fixes)
    assert_equal(decode_quality(encode_quality(quality, ANCHOR), ANCHOR, "here"), quality)


def test_the_same_quality_gives_the_same_bytes_and_another_others() -> None:
    data = encode_quality(random_quality(), ANCHOR)
    assert encode_quality(random_quality(), ANCHOR) == data
    other = random_quality()
    other.fixes.residuals_m[0, 0] += 0.001
    assert encode_quality(other, ANCHOR) != data


def test_a_part_takes_under_a_hundred_bytes_a_keyframe() -> None:
    assert len(encode_quality(random_quality(1000), ANCHOR)) < 100_000


def test_a_part_of_another_map_or_kind_is_refused(
    explode: Callable[[bytes], tuple[dict[str, Any], bytes]], assemble: Callable[..., bytes]
) -> None:
    data = encode_quality(random_quality(), ANCHOR)
    with pytest.raises(MapPackageError, match="here is not the quality part of a map anchored at"):
        decode_quality(data, replace(ANCHOR, height_m=0), "here")
    header, payload = explode(data)
    other = assemble(header | {"kind": "qualiti"}, payload)
    with pytest.raises(MapPackageError, match="here is not the quality part"):
        decode_quality(other, ANCHOR, "here")


def spoilt(change: Callable[[RoadQuality], object]) -> bytes:
    quality = random_quality()
    changed = change(quality)
    return encode_quality(changed if isinstance(changed, RoadQuality) else quality, ANCHOR)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda q: q.keyframes.along_m.__setitem__(3, -1.0), "lies beside the 100.0 m of road"),
        (lambda q: q.fixes.along_m.__setitem__(3, 101.0), "lies beside the 100.0 m of road"),
        (lambda q: q.gaps_m.__setitem__((0, 1), 1e9), "lies beside the 100.0 m of road"),
        (lambda q: q.keyframes.positions_m.__setitem__((0, 0), 2e6), "more than 1,000 km"),
        (lambda q: q.keyframes.covariances_m2.__setitem__((0, 0, 0), -1.0), "variance is negative"),
        (lambda q: q.keyframes.stamps_ns.__setitem__(5, 0), "keyframe stamps are not ascending"),
        (lambda q: q.edges_m.__setitem__(5, 0.0), "do not ascend from 0"),
        (lambda q: replace(q, edges_m=np.zeros(0), landmarks_per_m=np.zeros(0, np.float32)), "do not ascend"),
        (lambda q: q.fixes.sigmas.__setitem__(0, np.inf), "numbers that are not finite"),
        (lambda q: replace(q, landmarks_per_m=q.landmarks_per_m[:-1]), "'step_landmarks_per_m' is <f4 9"),
        (lambda q: replace(q, fixes=replace(q.fixes, sigmas=q.fixes.sigmas[1:])), "'fix_sigmas' is <f4 6"),
    ],
)
def test_what_cannot_be_is_refused(change: Callable[[RoadQuality], object], message: str) -> None:
    with pytest.raises(MapPackageError, match=message) as refusal:
        decode_quality(spoilt(change), ANCHOR, "here")
    assert "\n" not in str(refusal.value)


# --- in a package


@pytest.fixture(scope="module")
def package(
    make_map: Callable[..., VisualMap],
    quality_of: Callable[[VisualMap], Quality],
    provenance: Provenance,
    tmp_path_factory: pytest.TempPathFactory,
) -> MapPackage:
    visual_map = make_map(keyframes=6, landmarks=40, length_m=150.0)
    folder: Path = tmp_path_factory.mktemp("quality") / "street"
    write_package(
        folder,
        visual_map,
        map_id="street",
        quality=quality_of(visual_map),
        provenance=provenance,
        road_quality=random_quality(6, 3, visual_map.keyframes.stamps_ns),
    )
    return open_package(folder)


def test_a_package_carries_it_as_a_part_of_its_own(package: MapPackage) -> None:
    verify_package(package)
    assert [part.kind for part in package.manifest.parts][-2:] == ["full", "quality"]
    found = package.road_quality()
    assert found is not None
    assert_equal(found, random_quality(6, 3, package.visual_map().keyframes.stamps_ns))


def test_a_package_without_says_so(
    make_map: Callable[..., VisualMap],
    quality_of: Callable[[VisualMap], Quality],
    provenance: Provenance,
    tmp_path: Path,
) -> None:
    visual_map = make_map(keyframes=6, landmarks=40, length_m=150.0)
    quality = quality_of(visual_map)
    write_package(tmp_path / "street", visual_map, map_id="street", quality=quality, provenance=provenance)
    assert open_package(tmp_path / "street").road_quality() is None


def test_quality_of_another_road_is_not_written(
    make_map: Callable[..., VisualMap],
    quality_of: Callable[[VisualMap], Quality],
    provenance: Provenance,
    tmp_path: Path,
) -> None:
    visual_map = make_map(keyframes=6, landmarks=40, length_m=150.0)
    with pytest.raises(MapPackageError, match="7 keyframes along the road, its quality record says 6"):
        write_package(
            tmp_path / "street",
            visual_map,
            map_id="street",
            quality=quality_of(visual_map),
            provenance=provenance,
            road_quality=random_quality(7, 3),
        )
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_part_is_found(package: MapPackage, tmp_path: Path) -> None:
    shutil.copytree(package.folder, tmp_path / "copy")
    record = package.manifest.parts[-1]
    path = tmp_path / "copy" / "parts" / f"{record.sha256}.bin"
    path.write_bytes(path.read_bytes()[:-1] + b"\0")
    with pytest.raises(MapPackageError, match=f"{record.sha256}.bin is damaged"):
        verify_package(open_package(tmp_path / "copy"))


def test_the_road_is_worst_in_its_worst_horizontal_direction() -> None:
    quality = random_quality()
    sigmas_m = quality.keyframes.horizontal_sigmas_m
    for row in (0, 2, 29):
        eigenvalues = np.linalg.eigvalsh(quality.keyframes.covariances_m2[row, :2, :2].astype(np.float64))
        assert sigmas_m[row] == pytest.approx(np.sqrt(eigenvalues[-1]), rel=1e-5)
    assert np.isnan(sigmas_m[1])
