"""A second vehicle in the street while its map server leaves, or announces another version of the map."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from fleetmap.drive import Frame
from fleetmap.map_package import open_package
from fleetmap_localizer.pose_estimate import PoseEstimate
from fleetmap_localizer.run import LocalizedDrive, localize_drive
from fleetmap_localizer.tile_supply import TileSupply, map_supply_of

PATIENCE_S = 30.0
MIDDLE = 12  # of 24 images


@pytest.fixture
def near(mapped_street) -> tuple[float, float]:
    lon, lat = mapped_street.manifest.trajectory_lonlat[0]
    return lat, lon


def localized(drive, supply: TileSupply, in_mid_drive: Callable[[], object]) -> LocalizedDrive:
    """Localise the drive; something happens before its middle image, and no image is read before its turn."""

    def frames() -> Iterator[Frame]:
        for number, frame in enumerate(drive.frames[: 2 * MIDDLE]):
            if number == MIDDLE:
                in_mid_drive()
            yield frame

    return localize_drive(frames(), drive.camera, supply, looks_ahead=False)


def assert_no_gap(drive, result: LocalizedDrive) -> None:
    assert [pose.stamp_ns for pose in result.poses] == [frame.stamp_ns for frame in drive.frames[: 2 * MIDDLE]]
    away_m = drive.position_errors_m([(pose.stamp_ns, pose.utm_from_cam) for pose in result.poses])
    assert 0.0 < np.median(away_m) < 0.05
    assert away_m.max() < 0.3


def test_a_server_that_leaves_in_mid_drive_costs_no_pose(
    site, mapped_street, second_drive, near, tmp_path: Path
) -> None:
    site.publish(mapped_street.package)
    camera, cache = second_drive.camera, tmp_path / "cache"
    with closing(map_supply_of(site.origin(), camera, near_lat_lon_deg=near, cache=cache)) as supply:
        left = localized(second_drive, supply, site.leave)
    assert_no_gap(second_drive, left)
    with closing(map_supply_of(site.origin(), camera, near_lat_lon_deg=near, cache=cache)) as supply:
        offline = localized(second_drive, supply, lambda: None)
    assert_no_gap(second_drive, offline)
    for one, other in zip(left.poses, offline.poses, strict=True):
        assert np.array_equal(one.utm_from_cam.translation_m, other.utm_from_cam.translation_m)


def test_poses_go_on_in_the_next_version_from_one_image_to_the_next(
    site, mapped_street, second_drive, near, tmp_path: Path
) -> None:
    newer = Path(shutil.copytree(mapped_street.package, tmp_path / "newer"))
    manifest = json.loads((newer / "manifest.json").read_bytes())
    manifest["provenance"]["created_ns"] += 1
    (newer / "manifest.json").write_text(json.dumps(manifest))
    old, new = site.publish(mapped_street.package), open_package(newer).version
    assert old != new

    with closing(
        map_supply_of(site.origin(), second_drive.camera, near_lat_lon_deg=near, cache=tmp_path / "cache")
    ) as supply:

        def publish_and_wait() -> None:
            site.publish(newer)
            with supply._changed:
                assert supply._changed.wait_for(
                    lambda: [view.version for view in supply._views or ()] == [new], PATIENCE_S
                )

        result = localized(second_drive, supply, publish_and_wait)
    assert_no_gap(second_drive, result)
    assert all(isinstance(answer, PoseEstimate) for answer in result.answers)
    assert [pose.version for pose in result.poses] == [old] * MIDDLE + [new] * MIDDLE
