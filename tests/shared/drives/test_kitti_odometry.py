"""KITTI odometry folders in both layouts, placed in UTM, and the real sequence."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from pyproj import Geod

from fleetmap.camera import Camera
from fleetmap.drive import START_NS
from fleetmap.drives import open_drive
from fleetmap.drives.conversion import SimulatedGnss
from fleetmap.drives.kitti_odometry import Origin, convert_kitti_odometry
from fleetmap.errors import CalibrationError, DriveError, InputError
from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import Pose, so3_exp
from fleetmap.gnss import antenna_positions_m
from fleetmap.trajectory import read_trajectory

ORIGIN = Origin(48.98, 8.39, 115.0, 70.0)
CALIB = """P0: 5.0e+01 0 3.1e+01 0 0 5.0e+01 2.3e+01 0 0 0 1 0
P1: 5.0e+01 0 3.1e+01 -2.5e+01 0 5.0e+01 2.3e+01 0 0 0 1 0
P2: 5.0e+01 0 3.1e+01 2.031e+01 0 5.0e+01 2.3e+01 1.523e+01 0 0 1 1.0e-02
Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0
"""
FRAMES = 20


def kitti_pose(index: int) -> Pose:
    """A right turn: the camera's y axis points down, so a positive angle about it turns right."""
    angle = 0.05 * index
    forward = np.array([10.0 * (1 - np.cos(angle)), 0.1 * index, 10.0 * np.sin(angle)])
    return Pose(so3_exp(np.array([0.0, angle, 0.0])), forward)


@pytest.fixture
def dataset(tmp_path) -> Path:
    """The published layout, with 20 images of cameras 0 to 2 in sequence 07; sequence 11 has no poses."""
    root = tmp_path / "dataset"
    for name in ("07", "11"):
        sequence = root / "sequences" / name
        for camera in (0, 1, 2):
            (sequence / f"image_{camera}").mkdir(parents=True)
            for index in range(FRAMES):
                cv2.imwrite(
                    str(sequence / f"image_{camera}" / f"{index:06d}.png"), np.full((48, 64), index, np.uint8)
                )
        (sequence / "times.txt").write_text("".join(f"{0.1037 * index:.6e}\n" for index in range(FRAMES)))
        (sequence / "calib.txt").write_text(CALIB)
    (root / "poses").mkdir()
    rows = [np.hstack([p.rotation, p.translation_m[:, None]]) for p in map(kitti_pose, range(FRAMES))]
    (root / "poses" / "07.txt").write_text(
        "".join(" ".join(f"{value:.9e}" for value in row.reshape(12)) + "\n" for row in rows)
    )
    return root


def test_times_start_at_the_agreed_instant(dataset, tmp_path):
    convert_kitti_odometry(dataset, tmp_path / "out.mcap", sequence="07")
    stamps = [frame.stamp_ns for frame in open_drive(tmp_path / "out.mcap").frames()]
    assert START_NS == 1_700_000_000_000_000_000  # 2023-11-14T22:13:20Z
    assert stamps[:3] == [START_NS, START_NS + 103_700_000, START_NS + 207_400_000]


def test_the_camera_is_its_projection_matrix(dataset, tmp_path):
    convert_kitti_odometry(dataset, tmp_path / "out.mcap", sequence="07", camera=1)
    assert open_drive(tmp_path / "out.mcap").camera == Camera(64, 48, 50.0, 50.0, 31.0, 23.0)


@pytest.mark.parametrize("way", ["root and sequence", "sequence folder", "folder above the root"])
def test_every_way_to_name_a_sequence_gives_the_same(dataset, tmp_path, way):
    folder, sequence = {
        "root and sequence": (dataset, "07"),
        "sequence folder": (dataset / "sequences" / "07", None),
        "folder above the root": (tmp_path, "07"),
    }[way]
    done = convert_kitti_odometry(folder, tmp_path / "out.mcap", sequence=sequence, origin=ORIGIN)
    assert done.frame_count == FRAMES
    assert done.reference is not None


def test_another_tool_reads_back_what_the_folder_holds(dataset, tmp_path, read_by_rosbags):
    gnss = SimulatedGnss("consumer", interval_s=0.5, antenna_in_camera_m=(-0.5, -1.6, 0.3))
    done = convert_kitti_odometry(dataset, tmp_path / "out.mcap", sequence="07", gnss=gnss, origin=ORIGIN)
    messages = read_by_rosbags(tmp_path / "out.mcap")
    assert sorted(messages) == ["/cam0/camera_info", "/cam0/image/compressed", "/gnss/fix", "/tf_static"]
    files = sorted((dataset / "sequences" / "07" / "image_0").iterdir())
    assert [m.data.tobytes() for m in messages["/cam0/image/compressed"]] == [path.read_bytes() for path in files]
    assert tuple(messages["/cam0/camera_info"][0].k) == (50.0, 0.0, 31.0, 0.0, 50.0, 23.0, 0.0, 0.0, 1.0)
    drive = open_drive(tmp_path / "out.mcap")
    assert [(m.latitude, m.longitude, m.altitude) for m in messages["/gnss/fix"]] == [
        (fix.lat_deg, fix.lon_deg, fix.height_m) for fix in drive.gnss_fixes()
    ]
    assert (done.frame_count, done.fix_count) == (FRAMES, len(messages["/gnss/fix"]))
    stamps_ns = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in messages["/cam0/image/compressed"]]
    assert stamps_ns == [START_NS + index * 103_700_000 for index in range(FRAMES)]


def test_a_sequence_without_a_site_has_neither_reference_nor_gnss(dataset, tmp_path):
    done = convert_kitti_odometry(dataset, tmp_path / "out.mcap", sequence="07")
    assert done.reference is None
    assert open_drive(tmp_path / "out.mcap").gnss_fixes() == []


class TestPlacing:
    @pytest.fixture
    def reference(self, dataset, tmp_path):
        convert_kitti_odometry(dataset, tmp_path / "out.mcap", sequence="07", origin=ORIGIN)
        return read_trajectory(tmp_path / "out.reference.tum")

    def test_the_first_camera_stands_at_the_origin(self, reference):
        lat, lon, height = UtmGrid(reference.epsg).to_geodetic(reference.positions_m[0])
        assert (float(lat), float(lon)) == pytest.approx((ORIGIN.lat_deg, ORIGIN.lon_deg), abs=1e-10)
        assert float(height) == pytest.approx(115.0, abs=1e-6)

    def test_its_optical_axis_points_along_the_true_heading(self, reference):
        """A point 100 m ahead of the first camera is seen from there under the heading, on the ellipsoid."""
        ahead = reference.pose(0).transform(np.array([0.0, 0.0, 100.0]))
        (lat0, lon0, _), (lat1, lon1, height1) = (
            UtmGrid(reference.epsg).to_geodetic(point) for point in (reference.positions_m[0], ahead)
        )
        azimuth_deg, _, _ = Geod(ellps="WGS84").inv(lon0, lat0, lon1, lat1)
        assert azimuth_deg == pytest.approx(ORIGIN.heading_deg, abs=0.001)  # convergence there is -0.46 deg
        assert float(height1) == pytest.approx(115.0, abs=1e-4)

    def test_it_is_level_with_y_down(self, reference):
        assert reference.rotations[0] @ [0.0, 1.0, 0.0] == pytest.approx([0.0, 0.0, -1.0], abs=1e-8)

    def test_the_drive_keeps_its_shape_and_turns_right(self, reference):
        first_from_utm = reference.pose(0).inverse()
        for index in range(FRAMES):
            first_from_cam = first_from_utm @ reference.pose(index)
            assert first_from_cam.translation_m == pytest.approx(kitti_pose(index).translation_m, abs=1e-5)
            assert first_from_cam.rotation == pytest.approx(kitti_pose(index).rotation, abs=1e-7)
        east_north = np.diff(reference.positions_m[:, :2], axis=0)
        assert np.all(np.diff(np.unwrap(np.arctan2(east_north[:, 1], east_north[:, 0]))) < 0.0)

    @pytest.mark.parametrize(("camera", "centre_in_cam0"), [(1, [0.5, 0.0, 0.0]), (2, [-0.4, -0.3, -0.01])])
    def test_another_cameras_reference_is_beside(self, dataset, tmp_path, reference, camera, centre_in_cam0):
        convert_kitti_odometry(dataset, tmp_path / "other.mcap", sequence="07", camera=camera, origin=ORIGIN)
        other = read_trajectory(tmp_path / "other.reference.tum")
        for index in (0, 7, 19):
            expected = reference.pose(index).transform(np.array(centre_in_cam0))
            assert other.positions_m[index] == pytest.approx(expected, abs=2e-6)

    def test_the_southern_hemisphere_has_its_own_zone(self, dataset, tmp_path):
        convert_kitti_odometry(
            dataset, tmp_path / "south.mcap", sequence="07", origin=Origin(-33.9, 151.2, 20.0, 0.0)
        )
        assert read_trajectory(tmp_path / "south.reference.tum").epsg == 32756


def test_fixes_are_made_from_the_reference_at_the_antenna(dataset, tmp_path):
    gnss = SimulatedGnss("rtk", interval_s=0.1, antenna_in_camera_m=(-0.5, -1.6, 0.3), seed=3)
    convert_kitti_odometry(dataset, tmp_path / "out.mcap", sequence="07", gnss=gnss, origin=ORIGIN)
    drive, reference = open_drive(tmp_path / "out.mcap"), read_trajectory(tmp_path / "out.reference.tum")
    antenna = drive.antenna()
    assert antenna.source == "static transform"
    assert antenna.position_in_cam_m == pytest.approx([-0.5, -1.6, 0.3])
    fixes = drive.gnss_fixes()
    stamps_ns = np.array([fix.stamp_ns for fix in fixes])
    assert stamps_ns[0] == START_NS + 37_000_000
    assert stamps_ns[-1] == START_NS + 19 * 103_700_000 - 1_000_000
    truth = antenna_positions_m(reference, stamps_ns, (-0.5, -1.6, 0.3))
    measured = UtmGrid(reference.epsg).from_geodetic(
        *(np.array([getattr(fix, name) for fix in fixes]) for name in ("lat_deg", "lon_deg", "height_m"))
    )
    assert 0.03 < np.std(measured - truth) < 0.07


def test_without_an_antenna_the_fixes_are_the_camera_centre(dataset, tmp_path):
    gnss = SimulatedGnss("rtk")
    convert_kitti_odometry(dataset, tmp_path / "out.mcap", sequence="07", gnss=gnss, origin=ORIGIN)
    assert open_drive(tmp_path / "out.mcap").antenna().source == "same frame"


@pytest.mark.parametrize(
    ("change", "options", "error", "message"),
    [
        (None, {"sequence": None}, DriveError, r"choose one with --sequence \(07, 11\)"),
        (None, {"sequence": "12"}, DriveError, "has no sequence 12; it has 07, 11"),
        (None, {"camera": 3}, DriveError, "no KITTI odometry sequence with camera 3"),
        (None, {"gnss": SimulatedGnss("rtk")}, DriveError, "--origin"),
        (None, {"sequence": "11", "origin": ORIGIN}, DriveError, "no poses"),
        (None, {"sequence": "11", "gnss": SimulatedGnss("rtk")}, DriveError, "no reference"),
        (None, {"origin": Origin(89.0, 8.0, 0.0, 0.0)}, InputError, "outside UTM"),
        ("calib.txt", {}, CalibrationError, "cannot read calibration"),
        ("times.txt", {}, DriveError, "cannot read .*times.txt"),
        ("image_0", {}, DriveError, "no KITTI odometry sequence"),
    ],
)
def test_what_does_not_fit_is_refused_and_nothing_is_written(dataset, tmp_path, change, options, error, message):
    if change is not None:
        damaged = dataset / "sequences" / "07" / change
        shutil.rmtree(damaged) if damaged.is_dir() else damaged.unlink()
    before = sorted(tmp_path.iterdir())
    with pytest.raises(error, match=message):
        convert_kitti_odometry(dataset, tmp_path / "out.mcap", **{"sequence": "07", **options})
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("line", ["1 2 3", "a b c d e f g h i j k l"])
def test_a_pose_line_that_is_none_is_named(dataset, tmp_path, line):
    poses = dataset / "poses" / "07.txt"
    poses.write_text(poses.read_text() + line + "\n")
    with pytest.raises(DriveError, match=r"07.txt line 21 is no pose of 12 numbers"):
        convert_kitti_odometry(dataset, tmp_path / "out.mcap", sequence="07", origin=ORIGIN)


@pytest.fixture(scope="module")
def real_folder(drives_folder) -> Path:
    return drives_folder / "kitti_odo_00_first300"


class TestTheRealSequence:
    def test_a_fix_every_five_seconds(self, real_folder, tmp_path):
        gnss = SimulatedGnss("rtk", interval_s=5.0, seed=7)
        done = convert_kitti_odometry(real_folder, tmp_path / "o00.mcap", gnss=gnss)
        assert (done.frame_count, done.fix_count) == (300, 8)
        drive, reference = open_drive(tmp_path / "o00.mcap"), read_trajectory(tmp_path / "o00.reference.tum")
        assert drive.camera == Camera(1241, 376, 718.856, 718.856, 607.1928, 185.2157)
        assert reference.stamps_ns.tolist() == [frame.stamp_ns for frame in drive.frames()]
        assert reference.positions_m[0] == pytest.approx([455394.3736, 5425694.4726, 115.0])
        fixes = drive.gnss_fixes()
        truth = antenna_positions_m(reference, np.array([fix.stamp_ns for fix in fixes]), (0.0, 0.0, 0.0))
        measured = UtmGrid(32632).from_geodetic(
            *(np.array([getattr(fix, name) for fix in fixes]) for name in ("lat_deg", "lon_deg", "height_m"))
        )
        assert 0.02 < np.std(measured - truth) < 0.09
        assert np.abs(measured - truth).max() < 0.25

    def test_placing_the_poses_at_the_csvs_site_gives_the_csv(self, real_folder, tmp_path):
        """The flat folder's levelled reference was placed by its author: the same poses, site and heading."""
        convert_kitti_odometry(real_folder, tmp_path / "csv.mcap")
        csv = read_trajectory(tmp_path / "csv.reference.tum")
        lat, lon, height = (float(v) for v in UtmGrid(csv.epsg).to_geodetic(csv.positions_m[0]))
        forward = csv.rotations[0] @ [0.0, 0.0, 1.0]
        grid_heading = np.arctan2(forward[0], forward[1])
        heading = grid_heading + UtmGrid(csv.epsg).convergence_rad(lat, lon)
        convert_kitti_odometry(
            real_folder, tmp_path / "placed.mcap", origin=Origin(lat, lon, height, float(np.degrees(heading)))
        )
        placed = read_trajectory(tmp_path / "placed.reference.tum")
        assert np.linalg.norm(placed.positions_m - csv.positions_m, axis=1).max() < 0.01
