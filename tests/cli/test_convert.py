"""``fleetmap convert`` as a user types it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.camera_file import write_camera
from fleetmap.drives import open_drive
from fleetmap.trajectory import read_trajectory

NOON_NS = 1_714_564_800_000_000_000  # 2024-05-01T12:00:00Z
CAMERA = Camera(64, 48, 50.0, 51.0, 31.5, 23.5, (0.1, -0.2, 0.001, 0.002, 0.3))


@pytest.fixture
def flat_odometry(tmp_path) -> Path:
    """Two seconds straight ahead at 10 m/s, in the flat layout."""
    folder = tmp_path / "odometry"
    (folder / "cam0").mkdir(parents=True)
    rows = []
    for index in range(21):
        cv2.imwrite(str(folder / "cam0" / f"{index:06d}.jpg"), np.full((48, 64), 100, np.uint8))
        rows.append(f"{index},{index * 0.1:.6f},{455000 + index},5425000,115,0.5,-0.5,0.5,-0.5")
    header = "frame,t_sec,easting,northing,alt,qx,qy,qz,qw"
    (folder / "gt_cam0_utm32n.csv").write_text("\n".join([header, *rows]) + "\n")
    (folder / "times.txt").write_text("".join(f"{index * 0.1:.6f}\n" for index in range(21)))
    (folder / "K.txt").write_text("50 0 31\n0 50 23\n0 0 1\n")
    return folder


def fixes_ms(path):
    return [(fix.stamp_ns - 1_700_000_000_000_000_000) // 1_000_000 for fix in open_drive(path).gnss_fixes()]


def test_a_conversion_says_what_it_has_written(fleetmap, flat_odometry, tmp_path):
    output = tmp_path / "o.mcap"
    code, out, err = fleetmap("convert", "kitti-odometry", flat_odometry, output, "--gnss-error", "rtk")
    assert (code, err) == (0, "")
    assert f"{output}: 21 images, 21 GNSS fixes, reference in {tmp_path / 'o.reference.tum'}" in out
    assert len(read_trajectory(tmp_path / "o.reference.tum")) == 21


def test_without_gnss_error_there_is_no_gnss(fleetmap, flat_odometry, tmp_path):
    fleetmap("convert", "kitti-odometry", flat_odometry, tmp_path / "o.mcap")
    assert fixes_ms(tmp_path / "o.mcap") == []


def test_interval_and_gap(fleetmap, flat_odometry, tmp_path):
    options = ["--gnss-error", "consumer", "--gnss-interval-s", "0.5", "--gnss-gap", "0.5:0.6", "--seed", "7"]
    assert fleetmap("convert", "kitti-odometry", flat_odometry, tmp_path / "o.mcap", *options)[0] == 0
    assert fixes_ms(tmp_path / "o.mcap") == [37, 1537, 1999]


@pytest.mark.parametrize("spelling", [["--antenna-in-camera", "-0.5,-1.6,0"], ["--antenna-in-camera=-0.5,-1.6,0"]])
def test_an_antenna_with_a_leading_minus(fleetmap, flat_odometry, tmp_path, spelling):
    options = ["--gnss-error", "rtk", *spelling]
    assert fleetmap("convert", "kitti-odometry", flat_odometry, tmp_path / "o.mcap", *options)[0] == 0
    antenna = open_drive(tmp_path / "o.mcap").antenna()
    assert antenna.source == "static transform"
    assert antenna.position_in_cam_m == pytest.approx([-0.5, -1.6, 0.0])


def test_an_origin_with_a_leading_minus(fleetmap, flat_odometry, tmp_path):
    pose = "1 0 0 {x} 0 1 0 0 0 0 1 {z}\n"
    (flat_odometry / "poses_cam0_kitti.txt").write_text("".join(pose.format(x=0, z=z) for z in range(21)))
    options = ["--origin", "-33.9,151.2,20,0"]
    assert fleetmap("convert", "kitti-odometry", flat_odometry, tmp_path / "o.mcap", *options)[0] == 0
    reference = read_trajectory(tmp_path / "o.reference.tum")
    assert reference.epsg == 32756
    assert reference.positions_m[20, 1] - reference.positions_m[0, 1] == pytest.approx(20.0, abs=0.01)


def test_an_existing_recording_needs_force(fleetmap, flat_odometry, tmp_path):
    output = tmp_path / "o.mcap"
    assert fleetmap("convert", "kitti-odometry", flat_odometry, output)[0] == 0
    first = output.read_bytes()
    code, out, err = fleetmap("convert", "kitti-odometry", flat_odometry, output)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert err.startswith("error: ")
    assert "--force" in err
    assert output.read_bytes() == first
    assert fleetmap("convert", "kitti-odometry", flat_odometry, output, "--gnss-error", "rtk", "--force")[0] == 0
    assert len(fixes_ms(output)) == 21


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--gnss-interval-s", "1"], "need --gnss-error"),
        (["--gnss-gap", "1:1"], "need --gnss-error"),
        (["--gnss-outliers", "0.2"], "need --gnss-error"),
        (["--antenna-in-camera", "0,0,0"], "need --gnss-error"),
        (["--gnss-error", "perfect"], "'perfect' is not one of 'rtk', 'consumer'"),
        (["--gnss-error", "rtk", "--gnss-interval-s", "0"], "interval of 0.0 s"),
        (["--gnss-error", "rtk", "--gnss-gap", "11"], "START_S:LENGTH_S"),
        (["--gnss-error", "rtk", "--gnss-outliers", "20"], "share of 0 to 1"),
        (["--gnss-error", "rtk", "--gnss-gap", "1:-1"], "START_S:LENGTH_S"),
        (["--gnss-error", "rtk", "--antenna-in-camera", "1,2"], "X,Y,Z"),
        (["--origin", "49,8,100"], "LAT,LON,HEIGHT,HEADING_DEG"),
        (["--camera", "1"], "camera 1"),
    ],
)
def test_wrong_usage_is_exit_code_2_and_writes_nothing(fleetmap, flat_odometry, tmp_path, options, message):
    code, out, err = fleetmap("convert", "kitti-odometry", flat_odometry, tmp_path / "o.mcap", *options)
    assert (code, out) == (2, "")
    assert message in err
    assert not list(tmp_path.glob("*.mcap"))
    assert not list(tmp_path.glob("*.tum"))


@pytest.mark.parametrize("verb", ["kitti-raw", "kitti-odometry", "euroc", "tum-rgbd"])
@pytest.mark.parametrize("folder", ["nowhere", "empty"])
def test_a_wrong_folder_is_one_clear_line(fleetmap, tmp_path, verb, folder):
    (tmp_path / "empty").mkdir()
    code, _, err = fleetmap("convert", verb, tmp_path / folder, tmp_path / "o.mcap")
    assert code == 2
    assert err.count("\n") == 1
    assert str(tmp_path / folder) in err


@pytest.mark.parametrize("verb", ["kitti-raw", "kitti-odometry", "euroc", "tum-rgbd", "folder"])
def test_help_teaches_by_example(fleetmap, verb):
    code, out, _ = fleetmap("convert", verb, "--help")
    assert code == 0
    assert "Example" in out
    assert f"fleetmap convert {verb} " in " ".join(out.split())
    assert verb in fleetmap("convert", "--help")[1]


@pytest.fixture
def euroc(tmp_path) -> Path:
    """One second in the ASL layout: 11 images, IMU at 100 Hz, a truth that goes along the room's x axis."""
    root = tmp_path / "V9_01" / "mav0"
    for sensor in ("cam0/data", "imu0", "state_groundtruth_estimate0"):
        (root / sensor).mkdir(parents=True)
    for index in range(11):
        path = root / "cam0" / "data" / f"{NOON_NS + index * 10**8}.png"
        cv2.imwrite(str(path), np.full((48, 64), 100 + index, np.uint8))
    names = [f"{NOON_NS + index * 10**8},{NOON_NS + index * 10**8}.png" for index in range(11)]
    (root / "cam0" / "data.csv").write_text("\n".join(["#timestamp [ns],filename", *names]))
    stamps_ns = [NOON_NS + index * 10**7 for index in range(101)]
    (root / "imu0" / "data.csv").write_text("\n".join(f"{stamp_ns},0,0,0,0,0,9.8" for stamp_ns in stamps_ns))
    truth = [f"{stamp_ns},{index * 0.01},0,0,1,0,0,0" for index, stamp_ns in enumerate(stamps_ns)]
    (root / "state_groundtruth_estimate0" / "data.csv").write_text("\n".join(truth))
    mounting = "T_BS:\n  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
    lens = "camera_model: pinhole\nresolution: [64, 48]\nintrinsics: [50, 50, 31, 23]\n"
    distortion = "distortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n"
    (root / "cam0" / "sensor.yaml").write_text("%YAML:1.0\n" + mounting + lens + distortion)
    return root.parent


@pytest.fixture
def tum_rgbd(tmp_path) -> Path:
    """Ten colour and depth images, and a truth."""
    folder = tmp_path / "office"
    lines = []
    for kind, image in (
        ("rgb", np.full((48, 64, 3), 90, np.uint8)),
        ("depth", np.full((48, 64), 9000, np.uint16)),
    ):
        (folder / kind).mkdir(parents=True)
        lines = [f"1714564800.{index} {kind}/{index}.png" for index in range(10)]
        for index in range(10):
            cv2.imwrite(str(folder / kind / f"{index}.png"), image)
        (folder / f"{kind}.txt").write_text("\n".join(lines))
    truth = [f"1714564800.{index:02d} {index} 0 0 0 0 0 1" for index in range(0, 100, 5)]
    (folder / "groundtruth.txt").write_text("\n".join(truth))
    return folder


@pytest.fixture
def phone(tmp_path) -> tuple[Path, Path]:
    """Images named by their times, and a track."""
    folder, table = tmp_path / "frames", tmp_path / "track.csv"
    folder.mkdir()
    for index in range(10):
        cv2.imwrite(str(folder / f"{NOON_NS // 10**6 + 100 * index}.jpg"), np.full((48, 64), 90 + index, np.uint8))
    rows = [f"2024-05-01T12:00:00.{index}Z,48.0,{11 + index * 1e-5:.6f}" for index in range(10)]
    table.write_text("\n".join(["time,lat,lon", *rows]))
    return folder, table


@pytest.fixture
def camera_file(tmp_path) -> Path:
    write_camera(tmp_path / "camera.yaml", CAMERA)
    return tmp_path / "camera.yaml"


def test_a_room_placed_on_earth(fleetmap, euroc, tmp_path):
    options = ["--origin", "47.4,8.5,450", "--gnss-error", "rtk", "--gnss-interval-s", "0.2", "--seed", 3]
    code, out, err = fleetmap("convert", "euroc", euroc, tmp_path / "e.mcap", *options)
    assert (code, err) == (0, "")
    assert "e.mcap: 11 images, 6 GNSS fixes, 101 IMU measurements, reference in" in out
    reference = read_trajectory(tmp_path / "e.reference.tum")
    assert reference.positions_m[10] - reference.positions_m[0] == pytest.approx([1.0, 0.0, 0.0], abs=1e-5)


def test_a_room_without_a_place_is_said(fleetmap, euroc, tmp_path):
    code, out, err = fleetmap("convert", "euroc", euroc, tmp_path / "e.mcap")
    assert code == 0
    assert "0 GNSS fixes, 101 IMU measurements, no reference" in out
    assert err.startswith("note: the truth is in the room's own frame; --origin LAT,LON,HEIGHT")


def test_a_camera_file_for_each_layout(fleetmap, euroc, tum_rgbd, camera_file, tmp_path):
    assert fleetmap("convert", "euroc", euroc, tmp_path / "e.mcap", "--calibration", camera_file)[0] == 0
    code, out, _ = fleetmap("convert", "tum-rgbd", tum_rgbd, tmp_path / "t.mcap", "--camera", camera_file)
    assert code == 0
    assert "t.mcap: 10 images, 0 GNSS fixes, 10 depth images, no reference" in out
    assert open_drive(tmp_path / "e.mcap").camera == open_drive(tmp_path / "t.mcap").camera == CAMERA


def test_a_phones_folder(fleetmap, phone, camera_file, tmp_path):
    code, out, err = fleetmap("convert", "folder", *phone, tmp_path / "p.mcap", "--camera", camera_file)
    assert code == 0
    assert "p.mcap: 10 images, 10 GNSS fixes" in out
    assert err == f"note: {phone[1]} has no heights: all fixes are written at 0 m above the ellipsoid\n"
    drive = open_drive(tmp_path / "p.mcap")
    assert [frame.stamp_ns for frame in drive.frames()] == [fix.stamp_ns for fix in drive.gnss_fixes()]
    code, out, _ = fleetmap("info", tmp_path / "p.mcap")
    assert code == 0
    assert "10 on /camera/image/compressed, 64x48 pixels" in out


def test_a_phones_folder_with_every_option(fleetmap, phone, camera_file, tmp_path):
    options = ["--camera", camera_file, "--rate-hz", 10, "--start", "2024-05-01T14:00:00", "--height-m", "-12.5"]
    options += ["--image-clock-offset-s", "-7200", "--accuracy-m", 3, "--antenna-in-camera", "-0.1,-0.2,0.3"]
    code, _, err = fleetmap("convert", "folder", *phone, tmp_path / "p.mcap", *options)
    assert (code, "-12.5 m" in err) == (0, True)
    drive = open_drive(tmp_path / "p.mcap")
    assert next(drive.frames()).stamp_ns == NOON_NS
    assert drive.gnss_fixes()[0].height_m == -12.5
    assert drive.gnss_fixes()[0].covariance_enu_m2[0, 0] == pytest.approx(9.0)
    assert drive.antenna().position_in_cam_m == pytest.approx([-0.1, -0.2, 0.3])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "Missing option '--camera'"),
        (["--camera", "nowhere.yaml"], "nowhere.yaml"),
        (["--rate-hz", "10"], "--rate-hz and --start go together"),
        (["--start", "0"], "--rate-hz and --start go together"),
        (["--rate-hz", "10", "--start", "noon"], "'noon' is no time"),
        (["--rate-hz", "10", "--image-times", "t.csv"], "give one of them"),
        (["--accuracy-m", "0"], "0.0 is not in the range"),
        (["--accuracy-m", "nan"], "an accuracy of nan m makes no sense"),
        (["--image-clock-offset-s", "7200"], "no overlap"),
    ],
)
def test_wrong_usage_of_folder_is_one_line_and_writes_nothing(
    fleetmap, phone, camera_file, tmp_path, options, message
):
    given = options if not options or "--camera" in options else ["--camera", camera_file, *options]
    code, out, err = fleetmap("convert", "folder", *phone, tmp_path / "p.mcap", *given)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert message in err
    assert not list(tmp_path.glob("*.mcap"))


@pytest.mark.parametrize("layout", ["kitti-odometry", "euroc", "tum-rgbd", "folder"])
def test_the_same_conversion_gives_the_same_bytes_and_needs_force(
    fleetmap, flat_odometry, euroc, tum_rgbd, phone, camera_file, tmp_path, layout
):
    site = ["--origin", "48.1,11.5,500", "--gnss-error", "consumer"]
    arguments = {
        "kitti-odometry": ([flat_odometry], ["--gnss-error", "consumer"]),
        "euroc": ([euroc], site),
        "tum-rgbd": ([tum_rgbd], ["--camera", camera_file, *site]),
        "folder": (phone, ["--camera", camera_file]),
    }
    sources, options = arguments[layout]
    output = tmp_path / "out.mcap"
    assert fleetmap("convert", layout, *sources, output, *options)[0] == 0
    first = output.read_bytes()
    code, _, err = fleetmap("convert", layout, *sources, output, *options)
    assert (code, "--force" in err, err.count("\n")) == (2, True, 1)
    assert fleetmap("convert", layout, *sources, output, *options, "--force")[0] == 0
    assert output.read_bytes() == first


def open_after(pipe: Path, process: subprocess.Popen[str]) -> None:
    """Frees whoever waits for a process to read a pipe, should the process end without."""
    process.wait()
    os.close(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK))


def test_an_interrupted_conversion_leaves_nothing(phone, camera_file, tmp_path):
    """The last image is a pipe: once the conversion waits in it, all before is written."""
    folder, table = phone
    pipe = folder / f"{NOON_NS // 10**6 + 5000}.jpg"
    os.mkfifo(pipe)
    output = tmp_path / "results" / "out.mcap"
    arguments = ["convert", "folder", str(folder), str(table), str(output), "--camera", str(camera_file)]
    command = [sys.executable, "-c", "from fleetmap_cli.main import main; main()", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    threading.Thread(target=open_after, args=(pipe, process), daemon=True).start()
    with pipe.open("wb"):  # returns when the other side reads
        assert [path.suffix for path in output.parent.iterdir()] == [".part"]
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, "")
    assert "interrupted" in err
    assert list(output.parent.iterdir()) == []


def test_a_real_camera_and_receiver_as_a_folder_and_a_table(fleetmap, drives_folder, tmp_path):
    """The raw drive's second camera through ``folder`` is what ``kitti-raw`` makes of it, at a mounted antenna."""
    raw = drives_folder / "kitti_raw_20110926_1405"
    assert fleetmap("convert", "kitti-raw", raw, tmp_path / "raw.mcap", "--camera", 1)[0] == 0
    drive = open_drive(tmp_path / "raw.mcap")
    write_camera(tmp_path / "cam1.yaml", drive.camera)
    names = sorted(path.name for path in (raw / "cam1").iterdir())
    stamps_ns = [frame.stamp_ns for frame in drive.frames()]
    rows = [f"{name},{stamp_ns}" for name, stamp_ns in zip(names, stamps_ns, strict=True)]
    (tmp_path / "times.csv").write_text("\n".join(["image,timestamp_ns", *rows]))
    fixes = drive.gnss_fixes()
    track = [
        f"{f.stamp_ns},{f.lat_deg!r},{f.lon_deg!r},{f.height_m!r},{float(f.covariance_enu_m2[0, 0]) ** 0.5!r}"
        for f in fixes
    ]
    (tmp_path / "track.csv").write_text("\n".join(["time_ns,lat,lon,alt,accuracy", *track]))
    antenna = ",".join(f"{value!r}" for value in drive.antenna().position_in_cam_m.tolist())
    options = ["--camera", tmp_path / "cam1.yaml", "--image-times", tmp_path / "times.csv"]
    arguments = [raw / "cam1", tmp_path / "track.csv", tmp_path / "folder.mcap", *options]
    assert fleetmap("convert", "folder", *arguments, "--antenna-in-camera", antenna)[0] == 0
    again = open_drive(tmp_path / "folder.mcap")
    assert again.camera == drive.camera
    assert again.antenna().position_in_cam_m == pytest.approx(drive.antenna().position_in_cam_m)
    assert [(f.stamp_ns, f.lat_deg, f.lon_deg, f.height_m) for f in again.gnss_fixes()] == [
        (f.stamp_ns, f.lat_deg, f.lon_deg, f.height_m) for f in fixes
    ]
    for frame, original in zip(again.frames(), drive.frames(), strict=True):
        assert frame.stamp_ns == original.stamp_ns
        assert np.array_equal(frame.image, original.image)


def test_the_real_drives_as_the_readme_writes_them(fleetmap, drives_folder, tmp_path):
    raw, odometry = drives_folder / "kitti_raw_20110926_1405", drives_folder / "kitti_odo_00_first300"
    assert fleetmap("convert", "kitti-raw", raw, tmp_path / "survey.mcap", "--camera", 0)[0] == 0
    assert fleetmap("convert", "kitti-raw", raw, tmp_path / "second.mcap", "--camera", 1, "--no-gnss")[0] == 0
    options = ["--gnss-error", "rtk", "--gnss-interval-s", "1", "--gnss-gap", "11:10"]
    assert fleetmap("convert", "kitti-odometry", odometry, tmp_path / "o00.mcap", *options, "--seed", "7")[0] == 0
    assert fixes_ms(tmp_path / "o00.mcap")[10:13] == [10_037, 21_037, 22_037]
    survey = open_drive(tmp_path / "survey.mcap")
    assert (survey.frame_count, survey.camera.width_px, survey.camera.height_px) == (400, 1392, 512)
    assert survey.antenna().source == "static transform"
    assert len(survey.gnss_fixes()) == 671
