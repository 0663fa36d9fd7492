"""The preview of a real map package: a few of its landmarks, where they are."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Sim3
from fleetmap.manifest import Manifest, Provenance, Quality
from fleetmap.map_package import MapPackage, open_package, write_package
from fleetmap.visual_map import Keyframes, Landmarks, Observations, VisualMap
from fleetmap_server.http.preview_routes import PLACES, Previews
from fleetmap_server.preview import MAX_PREVIEW_POINTS, preview_ply
from fleetmap_server.problems import BusyError

KEYFRAMES, LANDMARKS = 40, 12_000
ANCHOR = UtmAnchor(32632, 456_000, 5_428_000, 110)


@pytest.fixture(scope="module")
def visual_map() -> VisualMap:
    """A road of 390 m over several cells; neighbouring keyframes see the same landmarks."""
    rng = np.random.default_rng(0)
    positions_m = np.stack([10.0 * np.arange(KEYFRAMES), np.zeros(KEYFRAMES), np.zeros(KEYFRAMES)], axis=1)
    first = np.sort(rng.integers(0, KEYFRAMES - 1, LANDMARKS)).astype(np.int32)
    seen = np.concatenate([first, first + 1]), np.tile(np.arange(LANDMARKS, dtype=np.int32), 2)
    order = np.lexsort((seen[1], seen[0]))
    return VisualMap(
        ANCHOR,
        Sim3(1.0, np.eye(3), np.zeros(3)),
        Camera(640, 480, 500.0, 500.0, 320.0, 240.0, (0.0,) * 5),
        Keyframes(np.arange(KEYFRAMES, dtype=np.int64), np.tile(np.eye(3), (KEYFRAMES, 1, 1)), positions_m),
        Landmarks(
            positions_m[first] + rng.normal(0.0, 8.0, (LANDMARKS, 3)),
            rng.integers(0, 256, (LANDMARKS, 32), dtype=np.uint8),
            np.tile(np.array([1.0, 0.0, 0.0], np.float32), (LANDMARKS, 1)),
            np.zeros(LANDMARKS, np.uint8),
            np.full(LANDMARKS, 10.0, np.float32),
            np.full((LANDMARKS, 2), 0.01, np.float32),
        ),
        Observations(
            seen[0][order],
            seen[1][order],
            np.full((2 * LANDMARKS, 2), 100.0, np.float32),
            np.zeros(2 * LANDMARKS, np.uint8),
        ),
    )


@pytest.fixture(scope="module")
def package(visual_map, tmp_path_factory) -> MapPackage:
    quality = Quality(
        keyframes=KEYFRAMES, landmarks=LANDMARKS, observations=2 * LANDMARKS, length_m=390.0, frames_total=40,
        frames_posed=40, reprojection_rms_px=0.5, gnss_fixes=10, gnss_residual_rms_m=0.1, gnss_mode="full",
        publishable=True,
    )  # fmt: skip
    origin = Provenance(drive="made", fleetmap_version="0", settings={}, start_ns=0, end_ns=40, created_ns=40)
    folder = tmp_path_factory.mktemp("package") / "road"
    write_package(folder, visual_map, map_id="road", quality=quality, provenance=origin)
    return open_package(folder)


def points_of(ply: bytes) -> np.ndarray:
    """The vertices of a PLY file whose only properties are double x, y, z."""
    header, _, body = ply.partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert [line for line in lines if line.startswith("property")] == [f"property double {axis}" for axis in "xyz"]
    (count,) = [int(line.split()[2]) for line in lines if line.startswith("element vertex")]
    points_m = np.frombuffer(body, "<f8").reshape(-1, 3)
    assert len(points_m) == count
    return points_m


def test_a_preview_is_some_of_the_landmarks_each_once_and_in_utm(package, visual_map):
    points_m = points_of(preview_ply(package.manifest, lambda record: package.part_bytes(record.sha256)))
    assert MAX_PREVIEW_POINTS / 2 < len(points_m) <= MAX_PREVIEW_POINTS
    true_m = visual_map.anchor.utm_from_map(visual_map.landmarks.points_m)
    taken = true_m[:: -(-LANDMARKS // MAX_PREVIEW_POINTS)]
    np.testing.assert_allclose(points_m, taken, atol=4.6e-3)  # cells keep steps of 8 mm
    assert len(np.unique(points_m, axis=0)) == len(points_m)


def test_of_a_small_map_all_landmarks_are_shown(package):
    cells = [record for record in package.manifest.parts if record.kind == "cell"]
    quality = package.manifest.quality.model_copy(update={"landmarks": cells[0].landmarks})
    one_cell = package.manifest.model_copy(update={"parts": (cells[0],), "quality": quality, "localizable": None})
    points_m = points_of(preview_ply(one_cell, lambda record: package.part_bytes(record.sha256)))
    assert len(points_m) == cells[0].landmarks <= MAX_PREVIEW_POINTS


def test_a_preview_never_grows_beyond_its_size_whatever_a_manifest_claims(package):
    quality = package.manifest.quality.model_copy(update={"landmarks": 1})
    lying: Manifest = package.manifest.model_copy(update={"quality": quality, "localizable": None})
    points_m = points_of(preview_ply(lying, lambda record: package.part_bytes(record.sha256)))
    assert len(points_m) == MAX_PREVIEW_POINTS


def test_a_preview_is_served_with_each_version_of_a_map(web, library, package, publish):
    publish(library, _Published(package))
    item = web.get("/collections/maps/items/road").json()
    answer = web.get(item["assets"]["preview"]["href"])
    assert (answer.status_code, answer.headers["content-type"]) == (200, item["assets"]["preview"]["type"])
    assert "immutable" in answer.headers["cache-control"]
    assert len(points_of(answer.content)) > 1000
    again = web.get(str(answer.url), headers={"If-None-Match": answer.headers["etag"]})
    assert again.status_code == 304
    latest = web.get("/maps/road/preview.ply")
    assert latest.content == answer.content
    assert latest.headers["cache-control"] == "no-cache"


def test_few_wait_for_previews_and_the_others_are_told_to_ask_again(package, monkeypatch):
    finish, told = threading.Event(), queue.Queue()
    manifest = package.manifest_bytes

    def make(*arguments: object) -> bytes:
        assert finish.wait(30.0)
        return b"ply"

    class OneManifest:
        def stream(self, sha256: str) -> Iterator[bytes]:
            return iter([manifest])

    def ask(number: int) -> None:
        try:
            told.put(previews.of(f"{number:064x}"))
        except BusyError as error:
            told.put(error)

    monkeypatch.setattr("fleetmap_server.http.preview_routes.preview_ply", make)
    previews = Previews(OneManifest())
    askers = [threading.Thread(target=ask, args=(number,)) for number in range(PLACES + 3)]
    for asker in askers:
        asker.start()
    assert [type(told.get(timeout=30.0)) for _ in range(3)] == [BusyError] * 3
    finish.set()
    assert [told.get(timeout=30.0) for _ in range(PLACES)] == [b"ply"] * PLACES
    for asker in askers:
        asker.join(30.0)


class _Published:
    """A package as ``publish`` wants it."""

    def __init__(self, package: MapPackage) -> None:
        self.manifest, self.manifest_bytes, self.version = (
            package.manifest,
            package.manifest_bytes,
            package.version,
        )
        self.parts = {record.sha256: package.part_bytes(record.sha256) for record in package.manifest.parts}
