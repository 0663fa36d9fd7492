"""Tiles around a vehicle, from folders and real servers that lose tiles, change their maps, or leave."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.errors import MapPackageError, NoPoseError, ServerRefusedError, ServerUnreachableError
from fleetmap.geodesy import UtmAnchor, UtmGrid
from fleetmap.geometry import Pose, Sim3
from fleetmap.manifest import Provenance, Quality
from fleetmap.map_package import open_package, write_package
from fleetmap.transport import MapClient
from fleetmap.visual_map import Keyframes, Landmarks, Observations, VisualMap
from fleetmap_localizer.map_source import read_map
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.map_window import WindowSettings
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate
from fleetmap_localizer.tile_supply import TileSupply, map_supply_of

CAMERA = Camera(640, 400, 430.0, 430.0, 319.5, 199.5)
ANCHOR = UtmAnchor(32632, 691_200, 5_334_784, 500)  # the south-west corner of a cell
CELL_M, SPACING_M = 128.0, 8.0
PATIENCE_S = 30.0  # of the tests, with what other threads do


def write_road(
    folder: Path, map_id: str = "road", *, first: int = 0, last: int = 11, day: int = 0, seed: int = 1
) -> Path:
    """A map of a straight road eastwards through cells ``first`` to ``last``; what it shows is random."""
    east_m = np.arange(first * CELL_M + 4.0, (last + 1) * CELL_M, SPACING_M)
    count, rng = len(east_m), np.random.default_rng(seed)
    stamps_ns = np.arange(count) * 10**9 + (1_700_000_000 + 86_400 * day) * 10**9
    positions_m = np.stack([east_m, np.full(count, 60.0), np.zeros(count)], axis=1)
    points_m = np.repeat(positions_m, 12, axis=0) + rng.uniform(-9.0, 9.0, (12 * count, 3))
    landmarks = Landmarks(
        points_m,
        rng.integers(0, 256, (len(points_m), 32), dtype=np.uint8),
        np.tile(np.array([-1.0, 0.0, 0.0], np.float32), (len(points_m), 1)),
        np.zeros(len(points_m), np.uint8),
        np.full(len(points_m), 10.0, np.float32),
    )
    seen = np.arange(len(points_m), dtype=np.int32)
    observations = Observations(
        np.repeat(np.arange(count, dtype=np.int32), 12),
        seen,
        rng.uniform(0.0, 390.0, (len(seen), 2)).astype(np.float32),
        np.zeros(len(seen), np.uint8),
    )
    keyframes = Keyframes(stamps_ns, np.tile(np.eye(3), (count, 1, 1)), positions_m)
    visual_map = VisualMap(ANCHOR, Sim3(1.0, np.eye(3), np.zeros(3)), CAMERA, keyframes, landmarks, observations)
    quality = Quality(
        keyframes=count,
        landmarks=len(points_m),
        observations=len(seen),
        length_m=float(np.ptp(east_m)),
        frames_total=count,
        frames_posed=count,
        reprojection_rms_px=0.5,
        gnss_fixes=0,
        gnss_residual_rms_m=None,
        gnss_mode="none",
        publishable=True,
    )
    start_ns, end_ns = int(stamps_ns[0]), int(stamps_ns[-1])
    provenance = Provenance(
        drive="d.mcap", fleetmap_version="0.1", settings={}, start_ns=start_ns, end_ns=end_ns, created_ns=end_ns
    )
    write_package(folder, visual_map, map_id=map_id, quality=quality, provenance=provenance)
    return folder


def pose_at(east_m: float, at_s: float) -> PoseEstimate:
    place = Pose(np.eye(3), ANCHOR.utm_from_map(np.array([east_m, 60.0, 0.0])))
    return PoseEstimate(round(at_s * 1e9), ANCHOR.epsg, place, np.eye(6) * 1e-6, "road", "0" * 64, 50)


def lat_lon(east_m: float) -> tuple[float, float]:
    lat, lon, _ = UtmGrid(ANCHOR.epsg).to_geodetic(ANCHOR.utm_from_map(np.array([east_m, 60.0, 0.0])))
    return float(lat), float(lon)


def drive(supply: TileSupply, first_m: float, last_m: float) -> tuple[MapView, ...]:
    """Drive from here to there at 10 m/s, an image every 5 m; never without a view."""
    views = supply.views()
    for east_m in np.arange(first_m, last_m + 1.0, 5.0):
        supply.moved(pose_at(float(east_m), float(east_m) / 10.0))
        views = supply.views()
        assert any(shows(view, float(east_m)) for view in views), east_m
    return views


def shows(view: MapView, east_m: float) -> bool:
    return bool(np.abs(view.content.keyframes.positions_m[:, 0] - east_m).min() <= SPACING_M)


def cells_shown(views: tuple[MapView, ...]) -> list[int]:
    found = np.concatenate([view.content.keyframes.positions_m[:, 0] for view in views])
    return sorted(set((found // CELL_M).astype(int).tolist()))


def wait_for(supply: TileSupply, wanted: Callable[[tuple[MapView, ...]], bool]) -> tuple[MapView, ...]:
    """The first views that are as wanted."""
    with supply._changed:
        is_there = supply._changed.wait_for(lambda: wanted(supply._views or ()), PATIENCE_S)
    assert is_there, "no such views in time"
    return supply.views()


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """1.5 km of road in twelve cells."""
    return write_road(tmp_path_factory.mktemp("maps") / "road")


def test_a_folder_gives_what_lies_around_the_vehicle_and_lets_go_of_what_lies_behind(road: Path) -> None:
    with closing(map_supply_of(road, CAMERA, near_lat_lon_deg=lat_lon(10.0), in_step=True)) as supply:
        assert cells_shown(supply.views()) == [0, 1, 2, 3]
        assert supply.views() is supply.views()
        seen = [cells_shown(drive(supply, 20.0 + 100.0 * part, 110.0 + 100.0 * part)) for part in range(14)]
    assert max(len(cells) for cells in seen) <= 6
    assert seen[-1][-1] == 11
    assert seen[-1][0] >= 8


def test_without_a_prior_a_whole_map_is_there_until_several_poses_agree(road: Path) -> None:
    with closing(map_supply_of(road, CAMERA, in_step=True)) as supply:
        whole = read_map(road)
        (view,) = supply.views()
        assert (view.map_id, view.version) == ("road", whole.version)
        np.testing.assert_array_equal(view.content.landmarks.points_m, whole.content.landmarks.points_m)
        for number in range(2):
            supply.moved(pose_at(700.0, float(number)))
            assert supply.views() == (view,)
        supply.moved(pose_at(700.0, 2.0))
        assert cells_shown(supply.views()) == [3, 4, 5, 6, 7]


def test_a_lost_vehicle_gets_more_and_more_around_it(road: Path) -> None:
    with closing(map_supply_of(road, CAMERA, near_lat_lon_deg=lat_lon(700.0), in_step=True)) as supply:
        drive(supply, 700.0, 720.0)
        counts = []
        for at_s in (72.1, 80.0, 90.0, 110.0):
            supply.moved(NoPose(round(at_s * 1e9), "a lorry"))
            counts.append(len(cells_shown(supply.views())))
    assert counts == sorted(counts)
    assert counts[0] <= 5
    assert counts[-1] == 12


def test_the_views_of_a_vehicle_that_has_not_moved_stay_the_same_objects(road: Path) -> None:
    with closing(map_supply_of(road, CAMERA, near_lat_lon_deg=lat_lon(500.0), in_step=True)) as supply:
        views = drive(supply, 500.0, 540.0)
        assert drive(supply, 540.0, 560.0) is views


def test_only_cells_around_are_fetched_and_only_once(site, road: Path, tmp_path: Path) -> None:
    site.publish(road)
    cache = tmp_path / "cache"
    records = {record.sha256: record for record in open_package(road).manifest.parts if record.cell is not None}

    def kept() -> dict[str, int]:
        return {file.stem: file.stat().st_ino for file in (cache / "parts").iterdir()}

    for _ in range(2):
        before = kept() if cache.exists() else {}
        near = lat_lon(10.0)
        with closing(
            map_supply_of(site.origin(), CAMERA, near_lat_lon_deg=near, cache=cache, in_step=True)
        ) as supply:
            assert cells_shown(supply.views()) == [0, 1, 2, 3]
            wait_until_nothing_is_wished(supply)
        assert before.items() <= kept().items()
    east = sorted(records[name].cell[0] - ANCHOR.easting_m // 128 for name in kept() if name in records)  # type: ignore[index]
    assert east == [0, 1, 2, 3, 4]  # 600 m
    assert len(kept()) == 6  # and the manifest


def wait_until_nothing_is_wished(supply: TileSupply) -> None:
    """Until all that lies ahead has come."""
    fetcher = supply._fetcher
    with fetcher._changed:
        assert fetcher._changed.wait_for(lambda: not fetcher._wishes, PATIENCE_S)


def test_a_drive_on_a_server_is_the_same_as_on_a_folder(site, road: Path, tmp_path: Path) -> None:
    site.publish(road)
    near = lat_lon(10.0)
    shown = []
    for origin in (road, site.origin()):
        with closing(
            map_supply_of(origin, CAMERA, near_lat_lon_deg=near, cache=tmp_path / "cache", in_step=True)
        ) as supply:
            views = drive(supply, 10.0, 600.0)
            shown.append([(view.version, view.content.landmarks.points_m.tobytes()) for view in views])
    assert shown[0] == shown[1]


def test_a_server_that_leaves_in_mid_drive_is_done_without_and_taken_up_again(
    site, road: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    site.publish(road)
    near, cache = lat_lon(10.0), tmp_path / "cache"
    with closing(map_supply_of(site.origin(), CAMERA, near_lat_lon_deg=near, cache=cache, in_step=True)) as supply:
        drive(supply, 10.0, 200.0)
        wait_until_nothing_is_wished(supply)
        site.leave()
        with caplog.at_level(logging.WARNING):
            drive(supply, 200.0, 600.0)  # what lies 20 s ahead has come before
            supply.moved(pose_at(1300.0, 130.0))  # far beyond
            assert not any(shows(view, 1300.0) for view in supply.views())
            site.start()
            wait_for(supply, lambda views: any(shows(view, 1300.0) for view in views))
    told = [record.message for record in caplog.records]
    assert sum("going on with the maps at hand" in line for line in told) == 1
    assert sum("answers again" in line for line in told) == 1


def test_a_vehicle_starts_without_its_server_from_what_an_earlier_day_left(
    site, road: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    site.publish(road)
    near, cache = lat_lon(10.0), tmp_path / "cache"
    with closing(map_supply_of(site.origin(), CAMERA, near_lat_lon_deg=near, cache=cache, in_step=True)) as supply:
        online = supply.views()
    site.leave()
    with closing(map_supply_of(site.origin(), CAMERA, near_lat_lon_deg=near, cache=cache, in_step=True)) as supply:
        (view,) = supply.views()
        assert np.array_equal(view.content.landmarks.points_m, online[0].content.landmarks.points_m)
    assert "going on with the maps at hand" in caplog.text
    stranger = map_supply_of(site.origin(), CAMERA, cache=tmp_path / "new")
    with closing(stranger), pytest.raises(ServerUnreachableError, match="no map server answers"):
        stranger.views()


def test_a_new_version_is_taken_up_in_mid_drive_without_a_gap(site, road: Path, tmp_path: Path) -> None:
    old = site.publish(road)
    newer = write_road(tmp_path / "newer", day=1, seed=2)
    near, cache = lat_lon(10.0), tmp_path / "cache"
    with closing(map_supply_of(site.origin(), CAMERA, near_lat_lon_deg=near, cache=cache, in_step=True)) as supply:
        views = drive(supply, 10.0, 100.0)
        assert [view.version for view in views] == [old]
        new = site.publish(newer)
        views = wait_for(supply, lambda views: [view.version for view in views] == [new])
        assert shows(views[0], 100.0)
        drive(supply, 100.0, 300.0)
        assert [view.version for view in supply.views()] == [new]


def test_the_version_in_use_stays_where_the_next_cannot_be_read(
    site, road: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    old = site.publish(road)
    newer = spoil(write_road(tmp_path / "newer", day=1, seed=2), 1)
    near, cache = lat_lon(10.0), tmp_path / "cache"
    with closing(map_supply_of(site.origin(), CAMERA, near_lat_lon_deg=near, cache=cache, in_step=True)) as supply:
        drive(supply, 10.0, 100.0)
        new = site.publish(newer)
        with supply._changed:
            assert supply._changed.wait_for(lambda: supply._preparer._unreadable, PATIENCE_S)
        assert [view.version for view in supply.views()] == [old]
        drive(supply, 100.0, 430.0)
        views = wait_for(supply, lambda views: [view.version for view in views] == [new])
        assert min(cells_shown(views)) == 2
    assert caplog.text.count("a tile of map 'road' is left out") == 1


@pytest.mark.parametrize("how", ["undecodable", "tampered with", "missing"])
def test_a_folder_with_a_bad_tile_gives_the_others(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, how: str
) -> None:
    folder = write_road(tmp_path / "road", last=4)
    path = folder / "parts" / f"{cell_hash(folder, 2)}.bin"
    if how == "undecodable":
        spoil(folder, 2)
    elif how == "tampered with":
        path.write_bytes(path.read_bytes()[:-1] + b"!")
    else:
        path.unlink()
    with closing(map_supply_of(folder, CAMERA, in_step=True)) as supply:
        for number in range(5):
            assert cells_shown(supply.views()) == [0, 1, 3, 4]
            supply.moved(pose_at(300.0, float(number)))
    assert caplog.text.count("a tile of map 'road' is left out") == 1


@pytest.mark.parametrize("how", ["undecodable", "tampered with", "missing"])
def test_a_server_with_a_bad_tile_gives_the_others(
    site, tmp_path: Path, caplog: pytest.LogCaptureFixture, how: str
) -> None:
    folder = write_road(tmp_path / "road", last=4)
    if how == "undecodable":
        spoil(folder, 2)
    site.publish(folder)
    (blob,) = site.store.rglob(f"*{cell_hash(folder, 2)}*")
    if how == "tampered with":
        blob.write_bytes(blob.read_bytes()[:-1] + b"!")
    elif how == "missing":
        blob.unlink()
    with closing(map_supply_of(site.origin(), CAMERA, cache=tmp_path / "cache", in_step=True)) as supply:
        for number in range(5):
            assert cells_shown(supply.views()) == [0, 1, 3, 4]
            supply.moved(pose_at(300.0, float(number)))
    assert caplog.text.count("a tile of map 'road' is left out") == 1


def test_a_version_that_is_retired_in_mid_drive_is_used_as_far_as_it_has_come(
    site, road: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    site.publish(road)
    near, cache = lat_lon(10.0), tmp_path / "cache"
    with closing(map_supply_of(site.origin(), CAMERA, near_lat_lon_deg=near, cache=cache, in_step=True)) as supply:
        drive(supply, 10.0, 60.0)
        wait_until_nothing_is_wished(supply)
        with MapClient(site.endpoint) as client:
            client.retire("road")
        drive(supply, 60.0, 350.0)
        supply.moved(pose_at(1300.0, 130.0))
        assert not any(shows(view, 1300.0) for view in supply.views())
    assert "is left out" in caplog.text


def test_where_maps_overlap_the_newest_is_looked_into_alone_and_the_next_where_it_ends(
    site, tmp_path: Path
) -> None:
    for number, (map_id, first, last) in enumerate([("old", 0, 6), ("west", 0, 4), ("east", 5, 11)]):
        site.publish(write_road(tmp_path / map_id, map_id, first=first, last=last, day=number, seed=number))
    near, cache = lat_lon(10.0), tmp_path / "cache"
    with closing(map_supply_of(site.origin(), CAMERA, near_lat_lon_deg=near, cache=cache, in_step=True)) as supply:
        assert [view.map_id for view in supply.views()] == ["west"]
        drive(supply, 20.0, 300.0)
        assert {view.map_id for view in drive(supply, 300.0, 620.0)} == {"west", "east"}
        assert [view.map_id for view in drive(supply, 620.0, 1200.0)] == ["east"]


def test_what_covers_the_place_best_is_not_all_there_is_for_a_vehicle_that_is_lost(
    site, road: Path, tmp_path: Path
) -> None:
    site.publish(road)
    site.publish(write_road(tmp_path / "winter", "winter", day=90, seed=9))
    near, cache = lat_lon(300.0), tmp_path / "cache"
    with closing(map_supply_of(site.origin(), CAMERA, near_lat_lon_deg=near, cache=cache, in_step=True)) as supply:
        assert [view.map_id for view in drive(supply, 300.0, 330.0)] == ["winter"]
        supply.moved(NoPose(40 * 10**9, "summer"))
        assert {view.map_id for view in supply.views()} == {"road", "winter"}
        assert len(drive(supply, 400.0, 420.0)) == 1


def test_more_maps_than_can_be_searched_are_the_newest_and_one_warning(
    site, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for number in range(3):
        first = 20 * number
        site.publish(write_road(tmp_path / f"m{number}", f"m{number}", first=first, last=first + 3, day=number))
    size_bytes = sum(record.size_bytes for record in open_package(tmp_path / "m2").manifest.parts if record.cell)
    window = WindowSettings(max_bytes=int(2.5 * size_bytes))
    with closing(
        map_supply_of(site.origin(), CAMERA, cache=tmp_path / "cache", window=window, in_step=True)
    ) as supply:
        assert {view.map_id for view in supply.views()} == {"m1", "m2"}
    assert caplog.text.count("say --near where the vehicle is") == 1


def test_nothing_to_look_into_is_one_clear_error(site, road: Path, tmp_path: Path) -> None:
    def first_views(**settings: object) -> None:
        origin = site.origin(settings.pop("map_id", None))  # type: ignore[arg-type]
        with closing(map_supply_of(origin, CAMERA, cache=tmp_path / "cache", **settings)) as supply:  # type: ignore[arg-type]
            supply.views()

    with pytest.raises(NoPoseError, match=r"map server tcp/.* has no map; 'fleetmap maps list --server tcp/"):
        first_views()
    with pytest.raises(ServerRefusedError, match="atlantis"):
        first_views(map_id="atlantis")
    site.publish(road)
    with pytest.raises(NoPoseError, match=r"has no map near 40\.000000,-3\.000000"):
        first_views(near_lat_lon_deg=(40.0, -3.0))
    with closing(map_supply_of(tmp_path / "nothing", CAMERA)) as supply, pytest.raises(MapPackageError):
        supply.views()


def cell_hash(folder: Path, cell: int) -> str:
    """Hash of the part of one cell, counted from the west."""
    wanted = ANCHOR.easting_m // 128 + cell
    parts = open_package(folder).manifest.parts
    return next(record.sha256 for record in parts if record.cell is not None and record.cell[0] == wanted)


def spoil(folder: Path, cell: int) -> Path:
    """Put nonsense in the place of one cell's part; the manifest names its hash."""
    nonsense, spoilt = b"nonsense of cell %d" % cell, cell_hash(folder, cell)
    sha256 = hashlib.sha256(nonsense).hexdigest()
    (folder / "parts" / f"{spoilt}.bin").unlink()
    (folder / "parts" / f"{sha256}.bin").write_bytes(nonsense)
    manifest = json.loads((folder / "manifest.json").read_bytes())
    for part in manifest["parts"]:
        if part["sha256"] == spoilt:
            part |= {"sha256": sha256, "size_bytes": len(nonsense)}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder
