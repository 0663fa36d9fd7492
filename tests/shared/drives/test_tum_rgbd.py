"""TUM RGB-D folders in the published layout, and frames of a real sequence unpacked into it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.drives import open_drive
from fleetmap.drives.conversion import SimulatedGnss
from fleetmap.drives.local_poses import Site
from fleetmap.drives.tum_rgbd import CAMERAS, convert_tum_rgbd
from fleetmap.errors import CalibrationError, DriveError
from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import rotations_from_quat_xyzw
from fleetmap.trajectory import read_trajectory

SMALL = Camera(64, 48, 50.0, 51.0, 31.5, 23.5, (0.1, -0.2, 0.001, 0.002, 0.3))
SITE = Site(48.2625, 11.668, 480.0)
COUNT = 10
QUAT_XYZW = np.array([0.6504, 0.6012, -0.3056, -0.3496])


def stamp_s(index: int) -> str:
    return f"1305031229.{528748 + 33_000 * index:06d}"


def stamp_ns(index: int, later_ns: int = 0) -> int:
    return 1_305_031_229_000_000_000 + (528748 + 33_000 * index) * 1000 + later_ns


def depth_units(index: int) -> np.ndarray:
    """Distances of 0 (no return) to 13 m in the data set's fifths of a millimetre."""
    return (np.arange(48 * 64, dtype=np.uint16).reshape(48, 64) * 21 + index).astype(np.uint16)


@pytest.fixture
def sequence(tmp_path, pictures) -> Path:
    folder = tmp_path / "rgbd_dataset_test"
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    head = "# color images\n# file: 'rgbd_dataset_test.bag'\n# timestamp filename\n"
    rgb, depth, truth = [], [], []
    for index in range(COUNT):
        colour = cv2.merge([pictures[index], pictures[index] // 2, 255 - pictures[index]])
        cv2.imwrite(str(folder / "rgb" / f"{stamp_s(index)}.png"), colour)
        cv2.imwrite(str(folder / "depth" / f"{stamp_s(index)}.png"), depth_units(index))
        rgb.append(f"{stamp_s(index)} rgb/{stamp_s(index)}.png")
        depth.append(f"{stamp_s(index)[:-1]}9 depth/{stamp_s(index)}.png")
    for index in range(2 * COUNT):
        stamp = 1_305_031_229.52 + 0.02 * index
        truth.append(f"{stamp:.4f} {1.0 + 0.04 * index:.4f} -0.5 1.6 " + " ".join(f"{v:.4f}" for v in QUAT_XYZW))
    for name, lines in (("rgb.txt", rgb), ("depth.txt", depth), ("groundtruth.txt", truth)):
        (folder / name).write_text(head + "\n".join(lines) + "\n")
    (folder / "accelerometer.txt").write_text("# timestamp ax ay az\n1305031229.5 0.1 9.7 0.2\n")
    return folder


def test_another_tool_reads_back_what_the_folder_holds(sequence, tmp_path, read_by_rosbags):
    done = convert_tum_rgbd(sequence, tmp_path / "out.mcap", calibration=SMALL)
    assert (done.frame_count, done.depth_count, done.fix_count) == (COUNT, COUNT, 0)
    messages = read_by_rosbags(tmp_path / "out.mcap")
    assert sorted(messages) == [
        "/camera/camera_info",
        "/camera/depth/camera_info",
        "/camera/depth/image",
        "/camera/image/compressed",
    ]
    for index, image in enumerate(messages["/camera/image/compressed"]):
        assert image.data.tobytes() == (sequence / "rgb" / f"{stamp_s(index)}.png").read_bytes()
        assert image.header.stamp.sec * 10**9 + image.header.stamp.nanosec == stamp_ns(index)
    for index, depth in enumerate(messages["/camera/depth/image"]):
        millimetres = depth.data.view("<u2").reshape(48, 64)
        assert depth.encoding == "16UC1"
        assert np.abs(millimetres / 1000.0 - depth_units(index) / 5000.0).max() <= 0.0005001
        assert np.array_equal(millimetres == 0, depth_units(index) < 3)
    assert tuple(messages["/camera/camera_info"][0].d) == SMALL.distortion


def test_the_drive_is_the_folder_and_its_colour_images_are_the_camera(sequence, tmp_path):
    convert_tum_rgbd(sequence, tmp_path / "out.mcap", calibration=SMALL)
    drive = open_drive(tmp_path / "out.mcap")
    assert drive.camera == SMALL
    frames = list(drive.frames())
    assert [frame.stamp_ns for frame in frames] == [stamp_ns(index) for index in range(COUNT)]
    grey = cv2.imread(str(sequence / "rgb" / f"{stamp_s(4)}.png"), cv2.IMREAD_GRAYSCALE)
    assert np.array_equal(frames[4].image, grey)
    assert list(drive.imu_samples()) == []


@pytest.mark.parametrize(
    ("name", "camera"),
    [
        ("rgbd_dataset_freiburg1_rpy", CAMERAS["1"]),
        ("rgbd_dataset_freiburg2_desk", CAMERAS["2"]),
        ("tum_fr3_office", CAMERAS["3"]),
    ],
)
def test_the_folders_name_says_whose_camera_it_is(sequence, tmp_path, name, camera):
    for path in (sequence / "rgb").iterdir():
        cv2.imwrite(str(path), np.full((480, 640, 3), 90, np.uint8))
    (sequence / "depth.txt").unlink()
    done = convert_tum_rgbd(sequence.rename(tmp_path / name), tmp_path / "out.mcap")
    assert open_drive(tmp_path / "out.mcap").camera == camera
    assert any("no depth" in remark for remark in done.remarks)


@pytest.mark.parametrize("name", ["my_office", "fr10_hall"])
def test_a_name_that_says_nothing_needs_a_camera(sequence, tmp_path, name):
    with pytest.raises(CalibrationError, match="give --camera"):
        convert_tum_rgbd(sequence.rename(tmp_path / name), tmp_path / "out.mcap")


def test_at_a_site_the_truth_is_a_reference_and_fixes_can_be_made(sequence, tmp_path):
    gnss = SimulatedGnss("rtk", interval_s=0.1, antenna_in_camera_m=(0.1, -0.2, 0.3))
    done = convert_tum_rgbd(sequence, tmp_path / "out.mcap", calibration=SMALL, site=SITE, gnss=gnss)
    reference = read_trajectory(done.reference)
    origin_m = UtmGrid(32632).from_geodetic(
        np.array(SITE.lat_deg), np.array(SITE.lon_deg), np.array(SITE.height_m)
    )
    for index in range(COUNT):
        east_m = 1.0 + 2.0 * (stamp_ns(index) * 1e-9 - 1_305_031_229.52)
        assert reference.positions_m[index] - origin_m == pytest.approx([east_m, -0.5, 1.6], abs=1e-4)
        assert reference.rotations[index] == pytest.approx(rotations_from_quat_xyzw(QUAT_XYZW), abs=1e-6)
    antenna = open_drive(tmp_path / "out.mcap").antenna()
    assert antenna.position_in_cam_m == pytest.approx([0.1, -0.2, 0.3])
    assert done.fix_count == len(open_drive(tmp_path / "out.mcap").gnss_fixes()) == 4


def test_without_a_site_a_line_says_why_there_is_no_reference(sequence, tmp_path):
    done = convert_tum_rgbd(sequence, tmp_path / "out.mcap", calibration=SMALL)
    assert done.reference is None
    assert any("--origin" in remark for remark in done.remarks)


@pytest.mark.parametrize(
    ("table", "line", "text", "message"),
    [
        ("rgb.txt", 6, "then rgb/x.png", "rgb.txt line 6: 'then' is no time"),
        ("rgb.txt", 6, "1305031229.6", "rgb.txt line 6 is not 'timestamp filename'"),
        ("rgb.txt", 6, "1305031229.6 ../../x.png", "rgb.txt line 6 is not 'timestamp filename' of a file in"),
        ("rgb.txt", 6, "1305031229.6 rgb/x.png", "cannot read .*rgb/x.png"),
        ("rgb.txt", 6, f"1305031229.4 rgb/{stamp_s(2)}.png", "is not later than the image before it"),
        ("depth.txt", 6, f"1305031229.6 rgb/{stamp_s(2)}.png", "is no depth image"),
        ("depth.txt", 6, f"1305031229.4 depth/{stamp_s(2)}.png", "not later than the depth image before it"),
        ("groundtruth.txt", 6, "1305031229.56 1 2 3 0 0 1", "groundtruth.txt line 6 is not 'timestamp tx"),
        ("groundtruth.txt", 6, "1305031229.56 1 2 3 0 0 0 2", "groundtruth.txt line 6 holds no unit quaternion"),
        ("groundtruth.txt", 6, "1305031229.5 1 2 3 0 0 0 1", "groundtruth.txt line 6 is not later"),
    ],
)
def test_a_damaged_line_is_named_and_nothing_is_left(sequence, tmp_path, table, line, text, message):
    lines = (sequence / table).read_text().splitlines()
    lines[line - 1] = text
    (sequence / table).write_text("\n".join(lines))
    with pytest.raises(DriveError, match=message):
        convert_tum_rgbd(sequence, tmp_path / "out.mcap", calibration=SMALL, site=SITE)
    assert [p.name for p in tmp_path.iterdir()] == [sequence.name]


def test_depth_images_of_another_size_are_refused_with_the_numbers(sequence, tmp_path):
    cv2.imwrite(str(sequence / "depth" / f"{stamp_s(3)}.png"), np.ones((24, 32), np.uint16))
    with pytest.raises(CalibrationError, match=f"{stamp_s(3)}.png: a depth image of 32x24 .* 64x48"):
        convert_tum_rgbd(sequence, tmp_path / "out.mcap", calibration=SMALL)


def test_a_folder_of_another_kind_is_refused(tmp_path):
    with pytest.raises(DriveError, match=r"holds no rgb\.txt"):
        convert_tum_rgbd(tmp_path, tmp_path / "out.mcap")


def test_frames_of_the_real_sequence(data_folder, tmp_path, read_by_rosbags):
    packed = data_folder / "rgbd" / "tum_fr1_rpy"
    if not packed.is_dir():
        pytest.skip(f"no TUM RGB-D sequence at {packed}")
    folder = tmp_path / "rgbd_dataset_freiburg1_rpy"
    unpack_first_frames(packed, folder, 5)
    done = convert_tum_rgbd(folder, tmp_path / "out.mcap", site=SITE)
    assert (done.frame_count, done.depth_count, len(read_trajectory(done.reference))) == (5, 5, 5)
    for depth, path in zip(
        read_by_rosbags(tmp_path / "out.mcap")["/camera/depth/image"],
        sorted((folder / "depth").iterdir()),
        strict=True,
    ):
        units = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        millimetres = depth.data.view("<u2").reshape(480, 640)
        assert np.abs(millimetres - units / 5.0).max() <= 0.5001
        assert 500 < np.median(millimetres[millimetres > 0]) < 3000  # a desk


def unpack_first_frames(packed: Path, folder: Path, count: int) -> None:
    """The packed sequence's first frames as it was published."""
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    colours, depths = (cv2.VideoCapture(str(packed / name)) for name in ("rgb_h264.mkv", "depth_ffv1.mkv"))
    depths.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    metres_5000 = np.load(packed / "depth_lut.npy")
    lines: dict[str, list[str]] = {"rgb": [], "depth": []}
    for row in (packed / "frames.txt").read_text().splitlines()[:count]:
        _, rgb_s, depth_s = row.split()
        for name, stamp, image in (
            ("rgb", rgb_s, colours.read()[1]),
            ("depth", depth_s, metres_5000[depths.read()[1]]),
        ):
            cv2.imwrite(str(folder / name / f"{stamp}.png"), image)
            lines[name].append(f"{stamp} {name}/{stamp}.png")
    for name, entries in lines.items():
        (folder / f"{name}.txt").write_text("\n".join(entries))
    (folder / "groundtruth.txt").write_text((packed / "groundtruth.txt").read_text())
    for video in (colours, depths):
        video.release()
