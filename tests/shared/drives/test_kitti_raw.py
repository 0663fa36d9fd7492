"""KITTI raw folders in both layouts, and the real drive."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.drives import open_drive
from fleetmap.drives.kitti_raw import convert_kitti_raw
from fleetmap.errors import CalibrationError, DriveError, OutputExistsError
from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import interpolate_pose
from fleetmap.trajectory import read_trajectory

# Small images of an invented rig: every number differs, so that no two can be mistaken for each other.
CAM_TO_CAM = """calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
S_00: 6.400000e+01 4.800000e+01
K_00: 5.0e+01 0 3.1e+01 0 5.1e+01 2.3e+01 0 0 1
D_00: -3.0e-01 1.0e-01 1.0e-03 2.0e-03 -5.0e-02
R_00: 1 0 0 0 1 0 0 0 1
T_00: 0 0 0
S_rect_00: 6.000000e+01 4.000000e+01
R_rect_00: 0 -1 0 1 0 0 0 0 1
P_rect_00: 4.5e+01 0 3.0e+01 0 0 4.5e+01 2.0e+01 0 0 0 1 0
S_01: 6.400000e+01 4.800000e+01
K_01: 5.2e+01 0 3.2e+01 0 5.3e+01 2.4e+01 0 0 1
D_01: -2.0e-01 2.0e-01 3.0e-03 4.0e-03 -6.0e-02
R_01: 1 0 0 0 0 -1 0 1 0
T_01: -5.0e-01 1.0e-01 2.0e-01
S_rect_01: 6.000000e+01 4.000000e+01
R_rect_01: 1 0 0 0 1 0 0 0 1
P_rect_01: 4.5e+01 0 3.0e+01 -2.25e+01 0 4.5e+01 2.0e+01 0 0 0 1 0
"""
IMU_TO_VELO = "calib_time: 25-May-2012\nR: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.7\n"
VELO_TO_CAM = "calib_time: 15-Mar-2012\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0.01 -0.08 -0.27\ndelta_f: 0 0\ndelta_c: 0 0\n"
# x_cam0 = R (x_velo) + T of the IMU's origin (-0.8, 0.3, -0.7): right -0.3, down 0.7, forward -0.8, plus T.
IMU_IN_CAM0 = np.array([-0.3 + 0.01, 0.7 - 0.08, -0.8 - 0.27])
MIDNIGHT_NS = 1_316_995_200_000_000_000  # 2011-09-26T00:00:00Z
FIRST_NS = MIDNIGHT_NS + 50_735_964_389_445
OXTS = "49.015 8.434 116.4 0.03 0.01 -0.5 " + "0 " * 17 + "0.25 0.04 4 8 4 4 0"


def clock(index: int) -> str:
    return f"2011-09-26 14:05:3{5 + index}.964389445"


def write_calibration(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "calib_cam_to_cam.txt").write_text(CAM_TO_CAM)
    (folder / "calib_imu_to_velo.txt").write_text(IMU_TO_VELO)
    (folder / "calib_velo_to_cam.txt").write_text(VELO_TO_CAM)


def image(size: tuple[int, int], index: int) -> np.ndarray:
    return np.full((size[1], size[0]), 20 * index, np.uint8)


@pytest.fixture
def published(tmp_path):
    """``2011_09_26/2011_09_26_drive_0005_sync`` with four images of two cameras, image 2 missing."""

    def build(size: tuple[int, int] = (64, 48)) -> Path:
        date = tmp_path / "2011_09_26"
        write_calibration(date)
        drive = date / "2011_09_26_drive_0005_sync"
        for sensor in ("image_00", "image_01", "oxts"):
            (drive / sensor / "data").mkdir(parents=True)
            (drive / sensor / "timestamps.txt").write_text("\n".join(clock(index) for index in range(4)) + "\n")
        for index in (0, 1, 3):
            for sensor in ("image_00", "image_01"):
                path = drive / sensor / "data" / f"{index:010d}.png"
                cv2.imwrite(str(path), image(size, index))
            (drive / "oxts" / "data" / f"{index:010d}.txt").write_text(OXTS)
        return drive

    return build


def test_the_published_layout_keeps_numbers_clocks_and_pixels(published, tmp_path):
    done = convert_kitti_raw(published(), tmp_path / "out.mcap", camera=0)
    assert (done.frame_count, done.fix_count, done.reference) == (3, 3, None)
    drive = open_drive(tmp_path / "out.mcap")
    frames = list(drive.frames())
    assert [frame.stamp_ns for frame in frames] == [FIRST_NS + index * 1_000_000_000 for index in (0, 1, 3)]
    assert [int(frame.image[0, 0]) for frame in frames] == [0, 20, 60]
    fixes = drive.gnss_fixes()
    assert [fix.stamp_ns for fix in fixes] == [frame.stamp_ns for frame in frames]
    assert (fixes[0].lat_deg, fixes[0].lon_deg, fixes[0].height_m) == (49.015, 8.434, 116.4)
    assert fixes[0].covariance_enu_m2 == pytest.approx(np.eye(3) * 0.25**2)


def test_another_tool_reads_back_what_the_folder_holds(published, tmp_path, read_by_rosbags):
    folder = published()
    convert_kitti_raw(folder, tmp_path / "out.mcap", camera=1)
    messages = read_by_rosbags(tmp_path / "out.mcap")
    assert sorted(messages) == ["/cam1/camera_info", "/cam1/image/compressed", "/gnss/fix", "/tf_static"]
    files = sorted((folder / "image_01" / "data").iterdir())
    assert [m.data.tobytes() for m in messages["/cam1/image/compressed"]] == [path.read_bytes() for path in files]
    for topic in ("/cam1/image/compressed", "/gnss/fix"):
        stamps_ns = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in messages[topic]]
        assert stamps_ns == [FIRST_NS + index * 1_000_000_000 for index in (0, 1, 3)]
    assert {(m.latitude, m.longitude, m.altitude) for m in messages["/gnss/fix"]} == {(49.015, 8.434, 116.4)}
    assert tuple(messages["/cam1/camera_info"][0].d) == (-0.2, 0.2, 0.003, 0.004, -0.06)
    (mounting,) = messages["/tf_static"]
    assert [(t.header.frame_id, t.child_frame_id) for t in mounting.transforms] == [
        ("imu", "velo"), ("velo", "cam0"), ("cam0", "cam1"),
    ]  # fmt: skip


def test_unrectified_images_use_their_own_matrix_and_distortion(published, tmp_path):
    convert_kitti_raw(published(), tmp_path / "out.mcap", camera=1)
    drive = open_drive(tmp_path / "out.mcap")
    assert drive.camera == Camera(64, 48, 52.0, 53.0, 32.0, 24.0, (-0.2, 0.2, 0.003, 0.004, -0.06))
    R_01, T_01 = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([-0.5, 0.1, 0.2])
    assert drive.antenna().position_in_cam_m == pytest.approx(R_01 @ IMU_IN_CAM0 + T_01)


def test_rectified_images_use_the_projection_without_distortion(published, tmp_path):
    convert_kitti_raw(published((60, 40)), tmp_path / "out.mcap", camera=1)
    drive = open_drive(tmp_path / "out.mcap")
    assert drive.camera == Camera(60, 40, 45.0, 45.0, 30.0, 20.0)
    R_rect_00 = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert drive.antenna().position_in_cam_m == pytest.approx(R_rect_00 @ IMU_IN_CAM0 + [-0.5, 0.0, 0.0])


def test_camera_0_needs_no_further_transform(published, tmp_path):
    convert_kitti_raw(published(), tmp_path / "out.mcap", camera=0)
    assert open_drive(tmp_path / "out.mcap").antenna().position_in_cam_m == pytest.approx(IMU_IN_CAM0)


def test_images_of_another_size_are_refused_with_numbers(published, tmp_path):
    with pytest.raises(CalibrationError, match=r"62x40.*64x48.*60x40"):
        convert_kitti_raw(published((62, 40)), tmp_path / "out.mcap")


def test_without_gnss_neither_fixes_nor_mounting_are_needed(published, tmp_path, read_by_rosbags):
    folder = published()
    shutil.rmtree(folder / "oxts")
    (folder.parent / "calib_imu_to_velo.txt").unlink()
    with pytest.raises(DriveError, match="--no-gnss"):
        convert_kitti_raw(folder, tmp_path / "out.mcap")
    convert_kitti_raw(folder, tmp_path / "out.mcap", gnss=False)
    assert sorted(read_by_rosbags(tmp_path / "out.mcap")) == ["/cam0/camera_info", "/cam0/image/compressed"]


def break_layout(folder: Path, how: str) -> None:
    if how == "no calibration":
        (folder.parent / "calib_cam_to_cam.txt").unlink()
    elif how == "no mounting":
        (folder.parent / "calib_velo_to_cam.txt").unlink()
    elif how == "no images":
        shutil.rmtree(folder / "image_00" / "data")
        (folder / "image_00" / "data").mkdir()
    elif how == "image without time":
        cv2.imwrite(str(folder / "image_00" / "data" / "0000000009.png"), image((64, 48), 9))
    elif how == "no timestamps":
        (folder / "image_00" / "timestamps.txt").unlink()
    elif how == "strange timestamps":
        (folder / "image_00" / "timestamps.txt").write_text("yesterday\n")
    elif how == "timestamps that go back":
        (folder / "image_00" / "timestamps.txt").write_text("\n".join(clock(index) for index in (2, 1, 0, 3)))
    elif how == "first image damaged":
        (folder / "image_00" / "data" / "0000000000.png").write_bytes(b"no image")
    elif how == "short OXTS record":
        (folder / "oxts" / "data" / "0000000001.txt").write_text("49.0 8.4 116.0")
    elif how == "no such camera":
        shutil.rmtree(folder / "image_00")
    elif how == "the folder above":
        shutil.rmtree(folder)
        folder.mkdir()


@pytest.mark.parametrize(
    ("how", "error", "message"),
    [
        ("no calibration", CalibrationError, "cannot read calibration .*calib_cam_to_cam.txt"),
        ("no mounting", CalibrationError, "cannot read calibration .*calib_velo_to_cam.txt"),
        ("no images", DriveError, "holds no images"),
        ("image without time", DriveError, "0000000009.png has no time"),
        ("no timestamps", DriveError, "cannot read .*timestamps.txt"),
        ("strange timestamps", DriveError, "line 1 is no time"),
        ("timestamps that go back", DriveError, "0000000001.png is not later"),
        ("first image damaged", DriveError, "0000000000.png cannot be decoded"),
        ("short OXTS record", DriveError, "0000000001.txt is no OXTS record"),
        ("no such camera", DriveError, "no images of camera 0; it has image_01"),
        ("the folder above", DriveError, "is no KITTI raw drive"),
    ],
)
def test_a_damaged_folder_is_refused_and_nothing_is_written(published, tmp_path, how, error, message):
    folder = published()
    break_layout(folder, how)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(error, match=message):
        convert_kitti_raw(folder, tmp_path / "out.mcap")
    assert sorted(tmp_path.iterdir()) == before


def test_an_existing_recording_and_its_reference_are_kept_unless_forced(published, tmp_path):
    folder = published()
    (tmp_path / "out.mcap").write_text("mine")
    (tmp_path / "out.reference.tum").write_text("of another recording")
    with pytest.raises(OutputExistsError):
        convert_kitti_raw(folder, tmp_path / "out.mcap")
    assert (tmp_path / "out.mcap").read_text() == "mine"
    assert (tmp_path / "out.reference.tum").exists()
    convert_kitti_raw(folder, tmp_path / "out.mcap", force=True)
    assert open_drive(tmp_path / "out.mcap").frame_count == 3
    assert not (tmp_path / "out.reference.tum").exists()  # a stale reference would judge the new recording


def test_the_flat_layout_counts_images_by_number(tmp_path):
    flat = tmp_path / "flat"
    write_calibration(flat)
    (flat / "cam1").mkdir()
    (flat / "cam1_timestamps.txt").write_text("\n".join(clock(index) for index in range(4)))
    for index in (1, 3):
        cv2.imwrite(str(flat / "cam1" / f"{index:06d}.jpg"), image((64, 48), index))
    (flat / "gnss_oxts.csv").write_text(
        "t_sec_of_day,lat,lon,alt,pos_accuracy_m\n50736.031,49.015,8.434,116.4,0.25\n50736.1,49.016,8.435,116.5,0.5\n"
    )
    (flat / "gt_cam1_raw_utm32n.csv").write_text(
        "frame,t_sec_of_day,easting,northing,alt,qx,qy,qz,qw\n"
        "0,50735.9,1,2,3,0,0,0,1\n3,50738.96,451968.5,5431264.5,113.5,0.5,-0.5,0.5,-0.5\n"
    )
    done = convert_kitti_raw(flat, tmp_path / "out.mcap", camera=1)
    assert (done.frame_count, done.fix_count) == (2, 2)
    drive = open_drive(tmp_path / "out.mcap")
    assert [frame.stamp_ns for frame in drive.frames()] == [FIRST_NS + 1_000_000_000, FIRST_NS + 3_000_000_000]
    assert [fix.stamp_ns - MIDNIGHT_NS for fix in drive.gnss_fixes()] == [50_736_031_000_000, 50_736_100_000_000]
    assert done.reference == tmp_path / "out.reference.tum"
    reference = read_trajectory(tmp_path / "out.reference.tum")
    assert reference.epsg == 32632
    assert reference.stamps_ns.tolist() == [(FIRST_NS + 3_000_000_000) // 1000 * 1000]
    assert reference.positions_m[0] == pytest.approx([451968.5, 5431264.5, 113.5])


@pytest.fixture(scope="module")
def real_folder(drives_folder) -> Path:
    return drives_folder / "kitti_raw_20110926_1405"


@pytest.fixture(scope="module")
def survey(real_folder, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("survey") / "survey.mcap"
    convert_kitti_raw(real_folder, path, camera=0)
    return path


class TestTheRealDrive:
    def test_images_clocks_and_calibration(self, survey):
        drive = open_drive(survey)
        stamps = [frame.stamp_ns for frame in drive.frames()]
        assert len(stamps) == drive.frame_count == 400
        assert stamps[0] == 1_317_045_935_500_923_136  # 2011-09-26T14:05:35.500923136Z
        assert stamps[2] == 1_317_045_935_706_851_072
        assert np.argmax(np.diff(stamps)) == 22  # image 23 is missing
        assert drive.camera.distortion == (-0.3728755, 0.2037299, 0.002219027, 0.001383707, -0.07233722)

    def test_the_lever_arm_is_the_chain_of_the_three_calibration_files(self, survey):
        # Computed by hand: R_vc @ (-0.8086759, 0.3195559, -0.7997231) + T_vc with calib_velo_to_cam.txt.
        antenna = open_drive(survey).antenna()
        assert antenna.source == "static transform"
        expected = [-0.3292157, 0.7115814, -1.0897827]
        assert antenna.position_in_cam_m == pytest.approx(expected, abs=1e-5)

    def test_fixes_carried_by_the_lever_arm_agree_with_the_reference(self, survey):
        drive, reference = open_drive(survey), read_trajectory(survey.with_name("survey.reference.tum"))
        fixes = drive.gnss_fixes()
        assert len(fixes) == 671
        arm, grid = drive.antenna().position_in_cam_m, UtmGrid(reference.epsg)
        errors = []
        for fix in fixes:
            after = int(np.searchsorted(reference.stamps_ns, fix.stamp_ns))
            if not 0 < after < len(reference):
                continue
            step_ns = int(reference.stamps_ns[after] - reference.stamps_ns[after - 1])
            fraction = (fix.stamp_ns - int(reference.stamps_ns[after - 1])) / step_ns
            utm_from_cam = interpolate_pose(reference.pose(after - 1), reference.pose(after), fraction)
            position = grid.from_geodetic(*(np.array(v) for v in (fix.lat_deg, fix.lon_deg, fix.height_m)))
            errors.append(np.linalg.norm(utm_from_cam.transform(arm) - position))
        assert len(errors) > 600
        assert 0.0 < np.median(errors) < 0.15  # without the arm it would be 1.3 m

    def test_the_reference_has_the_images_stamps(self, survey):
        reference = read_trajectory(survey.with_name("survey.reference.tum"))
        stamps_ns = [frame.stamp_ns for frame in open_drive(survey).frames()]
        assert len(reference) == 398  # images 0 and 1 come before the first OXTS record
        assert np.abs(reference.stamps_ns - np.array(stamps_ns[2:])).max() <= 500  # six decimals

    def test_the_second_vehicle_carries_no_gnss(self, real_folder, tmp_path):
        done = convert_kitti_raw(real_folder, tmp_path / "second.mcap", camera=1, gnss=False)
        drive = open_drive(tmp_path / "second.mcap")
        assert (done.frame_count, drive.gnss_fixes()) == (200, [])
        assert drive.camera.fx_px == 989.5267
        assert (
            len(read_trajectory(tmp_path / "second.reference.tum")) == 199
        )  # image 1 comes before the first OXTS
