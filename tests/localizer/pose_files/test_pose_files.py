"""Files of poses, each read back by those it is written for."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.unknown_fields import UnknownFieldSet
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from shapely.geometry import shape

from fleetmap.covariances import COLUMNS as COVARIANCE_COLUMNS
from fleetmap.drives.mcap_drive import read_fixes
from fleetmap.drives.mcap_file import McapFile
from fleetmap.errors import InputError, StorageError
from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import CAM_FROM_BODY, Pose, rotation_angle_rad, rotations_from_quat_xyzw, so3_exp
from fleetmap_localizer.geographic import geographic, in_zone
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate
from fleetmap_localizer.pose_files import write_pose_file
from fleetmap_localizer.pose_files.tum_file import trajectory_of

START_NS = 1_700_000_000_123_456_789
# Ingolstadt lies 2.43 deg east of its zone's meridian: north of the grid is 1.83 deg clockwise of true north.
GRID, LAT_DEG, LON_DEG = UtmGrid(32632), 48.77, 11.43
SIGMAS = np.array([0.001, 0.002, 0.003, 0.04, 0.05, 0.3])  # about and along the camera's x, y, z


def pose(index: int, *, kind: str = "measured", turn_deg: float = 0.0, step_m: float = 1.5) -> PoseEstimate:
    """A level camera that looks along true north, turned by an angle to the left; it drives north."""
    enu_from_body = so3_exp(np.array([0.0, 0.0, np.radians(90.0 + turn_deg)]))
    grid_from_enu = GRID.grid_from_enu(LAT_DEG, LON_DEG)
    origin_m = GRID.from_geodetic(np.array(LAT_DEG), np.array(LON_DEG), np.array(412.5))
    position_m = origin_m + grid_from_enu @ np.array([0.0, step_m * index, 0.1 * index])
    return PoseEstimate(
        stamp_ns=START_NS + index * 100_000_000,
        epsg=32632,
        utm_from_cam=Pose(grid_from_enu @ enu_from_body @ CAM_FROM_BODY.T, position_m),
        covariance=np.diag(SIGMAS**2),
        map_id="street",
        version="ab" * 32,
        inlier_count=100 + index,
        kind="predicted" if kind == "predicted" else "measured",
    )


ANSWERS: Sequence[PoseEstimate | NoPose] = (
    pose(0),
    pose(1),
    NoPose(START_NS + 200_000_000, "the image shows no place, that the map knows"),
    pose(3, kind="predicted"),
    pose(4),
)


def written(folder: Path, name: str) -> Path:
    assert write_pose_file(folder / name, ANSWERS)
    return folder / name


def test_tum_text_holds_what_was_measured_and_evo_reads_it(tmp_path: Path) -> None:
    read = file_interface.read_tum_trajectory_file(str(written(tmp_path, "out.tum")))
    measured = [ANSWERS[i] for i in (0, 1, 4)]
    assert read.num_poses == 3
    for own, position_m, quat_wxyz in zip(measured, read.positions_xyz, read.orientations_quat_wxyz, strict=True):
        assert isinstance(own, PoseEstimate)
        assert position_m == pytest.approx(own.utm_from_cam.translation_m, abs=1e-6)
        rotation = rotations_from_quat_xyzw(np.roll(quat_wxyz, -1))
        assert rotation_angle_rad(rotation.T @ own.utm_from_cam.rotation) < 1e-7
    assert read.timestamps == pytest.approx([each.stamp_ns * 1e-9 for each in measured], abs=1e-6)


def test_tum_text_holds_predicted_poses_if_asked_to(tmp_path: Path) -> None:
    assert write_pose_file(tmp_path / "all.tum", ANSWERS, predicted_in_tum=True)
    assert file_interface.read_tum_trajectory_file(str(tmp_path / "all.tum")).num_poses == 4


def test_csv_has_a_line_an_image_and_says_why_there_is_no_pose(tmp_path: Path) -> None:
    with written(tmp_path, "out.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["kind"] for row in rows] == ["measured", "measured", "none", "predicted", "measured"]
    assert [int(row["stamp_ns"]) for row in rows] == [answer.stamp_ns for answer in ANSWERS]
    assert rows[2]["reason"] == "the image shows no place, that the map knows"
    assert {value for name, value in rows[2].items() if name not in ("stamp_ns", "kind", "reason")} == {""}
    first = rows[0]
    assert first["reason"] == ""
    assert (float(first["lat_deg"]), float(first["lon_deg"])) == pytest.approx((LAT_DEG, LON_DEG), abs=1e-9)
    assert float(first["height_m"]) == pytest.approx(412.5)
    back_m = GRID.from_geodetic(*(np.array(float(first[n])) for n in ("lat_deg", "lon_deg", "height_m")))
    assert back_m[:2] == pytest.approx([float(first["easting_m"]), float(first["northing_m"])], abs=2e-4)
    rotation = rotations_from_quat_xyzw(np.array([float(first[name]) for name in ("qx", "qy", "qz", "qw")]))
    assert isinstance(ANSWERS[0], PoseEstimate)
    assert rotation_angle_rad(rotation.T @ ANSWERS[0].utm_from_cam.rotation) < 1e-7
    assert [first[name] for name in ("map_id", "version", "inliers")] == ["street", "ab" * 32, "100"]
    entries = [float(first[name]) for name in COVARIANCE_COLUMNS]
    assert entries == pytest.approx(np.diag(SIGMAS**2)[np.triu_indices(6)])


def test_headings_and_sigmas_are_to_the_true_north(tmp_path: Path) -> None:
    """The camera's x points east, its y down, its z north: a grid that were not turned back would mix them."""
    with written(tmp_path, "out.csv").open(newline="") as file:
        first = next(csv.DictReader(file))
    assert float(first["heading_deg"]) == pytest.approx(0.0, abs=1e-4) or float(
        first["heading_deg"]
    ) == pytest.approx(360.0, abs=1e-4)
    sigmas_m = [float(first[f"sigma_{axis}_m"]) for axis in ("east", "north", "up")]
    assert sigmas_m == pytest.approx([SIGMAS[3], SIGMAS[5], SIGMAS[4]], rel=1e-3, abs=1e-4)
    assert float(first["sigma_heading_deg"]) == pytest.approx(np.degrees(SIGMAS[1]), rel=1e-3)
    assert float(first["sigma_tilt_deg"]) == pytest.approx(np.degrees(SIGMAS[2]), rel=1e-3)


def test_geojson_is_longitude_first_and_its_line_breaks_where_poses_are_missing(tmp_path: Path) -> None:
    content = json.loads(written(tmp_path, "out.geojson").read_text())
    way, *points = content["features"]
    assert content["type"] == "FeatureCollection"
    assert [len(line.coords) for line in shape(way["geometry"]).geoms] == [2, 2]
    assert way["properties"]["images"] == 5
    assert way["properties"]["maps"] == [["street", "ab" * 32]]
    assert len(points) == 4
    place = shape(points[0]["geometry"])
    assert (place.x, place.y, place.z) == pytest.approx((LON_DEG, LAT_DEG, 412.5), abs=1e-8)
    assert [point["properties"]["kind"] for point in points] == ["measured"] * 2 + ["predicted", "measured"]
    assert points[0]["properties"]["time"] == "2023-11-14T22:13:20.123456789Z"
    assert points[2]["properties"]["inliers"] == 103
    assert points[0]["properties"]["sigma_north_m"] == pytest.approx(0.3, abs=1e-3)


def test_an_unbroken_drive_is_one_line_and_a_single_pose_none(tmp_path: Path) -> None:
    for count, features in ((1, 1), (3, 4)):
        assert write_pose_file(tmp_path / "out.geojson", [pose(i) for i in range(count)])
        content = json.loads((tmp_path / "out.geojson").read_text())
        assert len(content["features"]) == features
    assert content["features"][0]["geometry"]["type"] == "LineString"


def test_a_line_is_cut_at_the_antimeridian(tmp_path: Path) -> None:
    grid = UtmGrid(32660)
    poses = []
    for index, lon_deg in enumerate((179.99998, 179.99999, -179.99999, -179.99998)):
        place_m = grid.from_geodetic(np.array(10.0), np.array(lon_deg % 360.0), np.array(0.0))
        at = pose(index)
        poses.append(PoseEstimate(**{**vars(at), "epsg": 32660, "utm_from_cam": Pose(np.eye(3), place_m)}))
    write_pose_file(tmp_path / "out.geojson", poses)
    geometry = json.loads((tmp_path / "out.geojson").read_text())["features"][0]["geometry"]
    assert geometry["type"] == "MultiLineString"
    assert [len(line) for line in geometry["coordinates"]] == [2, 2]


def test_mcap_speaks_foxglove(tmp_path: Path) -> None:
    with written(tmp_path, "out.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        messages = list(reader.iter_decoded_messages())
        (maps,) = reader.iter_metadata()
    topics = [channel.topic for _, channel, _, _ in messages]
    assert {topic: topics.count(topic) for topic in topics} == {
        "/fleetmap/location": 3,
        "/fleetmap/pose": 3,
        "/fleetmap/predicted/location": 1,
        "/fleetmap/predicted/pose": 1,
    }
    assert (maps.name, maps.metadata) == ("fleetmap maps", {"street": "ab" * 32})
    official = {"foxglove.LocationFix": LocationFix, "foxglove.PoseInFrame": PoseInFrame}
    for schema, channel, message, decoded in messages:
        read = official[schema.name].FromString(message.data)
        assert read.SerializeToString(deterministic=True) == decoded.SerializeToString(deterministic=True)
        assert len(UnknownFieldSet(read)) == 0
        assert message.log_time == read.timestamp.ToNanoseconds()
        assert read.frame_id == ("camera" if channel.topic.endswith("location") else "EPSG:32632")


def test_a_fix_has_its_covariance_to_the_true_east_and_a_pose_lies_on_the_grid(tmp_path: Path) -> None:
    with written(tmp_path, "out.mcap").open("rb") as file:
        messages = {channel.topic: message.data for _, channel, message in make_reader(file).iter_messages()}
    fix = LocationFix.FromString(messages["/fleetmap/location"])
    last = ANSWERS[4]
    assert isinstance(last, PoseEstimate)
    assert fix.position_covariance_type == LocationFix.KNOWN
    covariance = np.array(fix.position_covariance).reshape(3, 3)
    assert covariance == pytest.approx(np.diag([0.04, 0.3, 0.05]) ** 2, rel=2e-3, abs=1e-6)
    assert np.cos(fix.heading) == pytest.approx(1.0, abs=1e-9)
    assert fix.latitude == pytest.approx(LAT_DEG + 6.0 / 111_200, abs=1e-6)
    posed = PoseInFrame.FromString(messages["/fleetmap/pose"]).pose
    at = posed.position
    assert [at.x, at.y, at.z] == pytest.approx(last.utm_from_cam.translation_m.tolist(), abs=1e-9)
    q = posed.orientation
    rotation = rotations_from_quat_xyzw(np.array([q.x, q.y, q.z, q.w]))
    assert rotation_angle_rad(rotation.T @ last.utm_from_cam.rotation) < 1e-7


def test_what_is_written_as_fixes_is_read_as_fixes(tmp_path: Path) -> None:
    fixes = read_fixes(McapFile(written(tmp_path, "out.mcap")), "/fleetmap/location")
    assert [fix.stamp_ns for fix in fixes] == [ANSWERS[i].stamp_ns for i in (0, 1, 4)]
    assert fixes[0].covariance_enu_m2[1, 1] == pytest.approx(0.09, rel=2e-3)


def test_poses_of_two_zones_become_one_trajectory() -> None:
    """At 12 deg east, the border, the two grids are turned by 4.5 deg against each other."""
    lat_deg, lon_deg = np.array([48.0]), np.array([12.0])
    here = pose(0)
    west, east = UtmGrid(32632), UtmGrid(32633)
    place_m = west.from_geodetic(lat_deg, lon_deg, np.array([400.0]))[0]
    first = PoseEstimate(**{**vars(here), "utm_from_cam": Pose(here.utm_from_cam.rotation, place_m)})
    second = PoseEstimate(**{**vars(in_zone(first, 32633)), "stamp_ns": START_NS + 1})
    away_m = second.utm_from_cam.translation_m - east.from_geodetic(lat_deg, lon_deg, np.array([400.0]))[0]
    assert np.linalg.norm(away_m) < 1e-6
    turned_deg = np.degrees(rotation_angle_rad(first.utm_from_cam.rotation.T @ second.utm_from_cam.rotation))
    assert 4.0 < turned_deg < 5.0
    assert geographic(first).heading_deg == pytest.approx(geographic(second).heading_deg, abs=1e-9)
    together = trajectory_of([first, second])
    assert together.epsg == 32632
    assert together.positions_m[1] == pytest.approx(together.positions_m[0], abs=1e-6)
    assert rotation_angle_rad(together.rotations[0].T @ together.rotations[1]) < 1e-9


def test_without_a_pose_only_the_reasons_are_written(tmp_path: Path) -> None:
    nothing = [NoPose(START_NS, "too dark"), NoPose(START_NS + 1, "too bright")]
    for name in ("out.tum", "out.geojson", "out.mcap"):
        assert not write_pose_file(tmp_path / name, nothing)
    assert write_pose_file(tmp_path / "out.csv", nothing)
    assert [path.name for path in tmp_path.iterdir()] == ["out.csv"]
    assert "too bright" in (tmp_path / "out.csv").read_text()


@pytest.mark.parametrize("name", ["out.tum", "out.csv", "out.geojson", "out.mcap"])
def test_a_file_is_there_whole_or_as_it_was(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()  # which no file can take the place of
    with pytest.raises(StorageError, match=name):
        write_pose_file(tmp_path / name, ANSWERS)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_an_ending_that_nobody_knows_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must end in \.tum, \.csv, \.geojson, \.mcap"):
        write_pose_file(tmp_path / "out.kml", ANSWERS)
