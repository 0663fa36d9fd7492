"""``fleetmap convert`` as a user types it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.drives import open_drive
from fleetmap.trajectory import read_trajectory


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
        (["--antenna-in-camera", "0,0,0"], "need --gnss-error"),
        (["--gnss-error", "perfect"], "'perfect' is not one of 'rtk', 'consumer'"),
        (["--gnss-error", "rtk", "--gnss-interval-s", "0"], "interval of 0.0 s"),
        (["--gnss-error", "rtk", "--gnss-gap", "11"], "START_S:LENGTH_S"),
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


@pytest.mark.parametrize("verb", ["kitti-raw", "kitti-odometry"])
@pytest.mark.parametrize("folder", ["nowhere", "empty"])
def test_a_wrong_folder_is_one_clear_line(fleetmap, tmp_path, verb, folder):
    (tmp_path / "empty").mkdir()
    code, _, err = fleetmap("convert", verb, tmp_path / folder, tmp_path / "o.mcap")
    assert code == 2
    assert err.count("\n") == 1
    assert str(tmp_path / folder) in err


@pytest.mark.parametrize("verb", [[], ["kitti-raw"], ["kitti-odometry"]])
def test_help_teaches_by_example(fleetmap, verb):
    code, out, _ = fleetmap("convert", *verb, "--help")
    assert code == 0
    assert "Example" in out or not verb


def test_the_real_drives_as_the_readme_writes_them(fleetmap, drives_folder, tmp_path):
    raw, odometry = drives_folder / "kitti_raw_20110926_1405", drives_folder / "kitti_odo_00_first300"
    assert fleetmap("convert", "kitti-raw", raw, tmp_path / "survey.mcap", "--camera", 0)[0] == 0
    assert fleetmap("convert", "kitti-raw", raw, tmp_path / "second.mcap", "--camera", 1, "--no-gnss")[0] == 0
    options = ["--gnss-error", "rtk", "--gnss-interval-s", "1", "--gnss-gap", "11:10"]
    assert fleetmap("convert", "kitti-odometry", odometry, tmp_path / "o00.mcap", *options, "--seed", "7")[0] == 0
    assert fixes_ms(tmp_path / "o00.mcap")[10:13] == [10_037, 21_037, 22_037]
    code, out, err = fleetmap("info", tmp_path / "survey.mcap")
    assert (code, err) == (0, "")
    assert "400 on /cam0/image/compressed, 1392x512 pixels" in out
    assert "missing    nothing" in out
