"""``fleetmap simulate`` as a user runs it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from fleetmap.camera import Camera
from fleetmap.camera_file import write_camera
from fleetmap.drives import open_drive
from fleetmap.geodesy import UtmGrid
from fleetmap.simulation.mounting import Mounting
from fleetmap.trajectory import read_trajectory

Run = Callable[..., tuple[int, str, str]]

SMALL = Camera(96, 64, 60.0, 60.0, 47.5, 31.5)
LENSES = {
    "plumb_bob": SMALL,
    "rational_polynomial": Camera(
        96, 64, 60.0, 61.0, 46.0, 32.0, (0.3, -0.1, 1e-3, -5e-4, 0.01, 0.6, 0.02, 0.001), "rational_polynomial"
    ),
    "equidistant": Camera(96, 64, 40.0, 40.0, 47.0, 31.0, (-0.01, 0.02, -0.01, 0.002), "equidistant"),
}


@pytest.fixture
def camera_file(tmp_path: Path) -> Path:
    write_camera(tmp_path / "camera.yaml", SMALL)
    return tmp_path / "camera.yaml"


@pytest.fixture
def short(camera_file: Path) -> list[object]:
    """A drive that takes little time: 12 m of a short road, with small images."""
    return ["--world", 3, "--kind", "straight", "--length-m", 12, "--camera", camera_file]


def test_a_drive_with_every_sensor_reads_back_as_it_was(fleetmap: Run, tmp_path: Path, camera_file: Path) -> None:
    out = tmp_path / "all.mcap"
    options = [
        "--world",
        3,
        "--world-length-m",
        150,
        "--length-m",
        12,
        "--camera",
        camera_file,
        "--sensors",
        "all",
    ]
    mounted = ["--antenna-offset", "-1.5,0.2,0.4", "--gnss-interval-s", "0.2", "--rolling-shutter-ms", 20]
    traffic = ["--moving-cars", 20, "--look", "wet", "--imu-model", "industrial"]
    code, stdout, stderr = fleetmap("simulate", out, *options, *mounted, *traffic)
    assert (code, stdout.count("\n")) == (0, 1), stderr
    assert "16 images in 1.6 s around a circuit" in stdout
    assert "all.reference.tum" in stdout

    drive, reference = open_drive(out), read_trajectory(tmp_path / "all.reference.tum")
    assert drive.camera == SMALL
    assert [frame.stamp_ns for frame in drive.frames()] == reference.stamps_ns.tolist()
    np.testing.assert_allclose(drive.antenna().position_in_cam_m, [-0.2, -0.4, -1.5], atol=1e-9)
    fixes = drive.gnss_fixes()
    assert 7 <= len(fixes) <= 9
    forces = np.array([sample.linear_acceleration_m_s2 for sample in drive.imu_samples()])
    assert 300 <= len(forces) <= 320
    assert 9.0 < np.median(forces[:, 2]) < 10.6
    imu, wheels, usual = drive.imu_mounting(), drive.wheel_mounting(), Mounting()
    assert imu is not None
    assert wheels is not None
    for found, mounted_at in ((imu, usual.cam_from_imu), (wheels, usual.cam_from_vehicle)):
        np.testing.assert_allclose(found.cam_from_sensor.rotation, mounted_at.rotation, atol=1e-9)
        np.testing.assert_allclose(found.cam_from_sensor.translation_m, mounted_at.translation_m, atol=1e-9)
    speeds = np.array([speed.speed_mps for speed in drive.wheel_speeds()])
    assert 75 <= len(speeds) <= 80
    way_m = np.linalg.norm(np.diff(reference.positions_m, axis=0), axis=1).sum()
    seconds = (reference.stamps_ns[-1] - reference.stamps_ns[0]) * 1e-9
    assert np.mean(speeds) == pytest.approx(way_m / seconds, rel=0.03)
    with AnyReader([out]) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        stamps = [stamp for _, stamp, _ in reader.messages()]
    assert counts["/camera/depth/image"] == counts["/camera/image/compressed"] == len(reference)
    assert 14 <= counts["/scan"] <= 16
    assert stamps == sorted(stamps)

    markers = json.loads((tmp_path / "all.markers.json").read_text())
    assert markers["epsg"] == reference.epsg
    assert np.shape(markers["markers"][0]["corners_utm_m"]) == (4, 3)


@pytest.mark.parametrize("model", list(LENSES))
def test_any_lens_of_a_calibration_file_is_in_the_recording(
    fleetmap: Run, tmp_path: Path, short: list[object], model: str
) -> None:
    write_camera(tmp_path / "lens.yaml", LENSES[model])
    out = tmp_path / "lens.mcap"
    code, _, stderr = fleetmap("simulate", out, *short, "--camera", tmp_path / "lens.yaml", "--rate-hz", 2)
    assert code == 0, stderr
    drive = open_drive(out)
    assert drive.camera.distortion_model == model
    assert drive.camera == LENSES[model]
    assert next(drive.frames()).image.std() > 15.0


def test_equal_options_give_equal_bytes_and_another_drive_others(
    fleetmap: Run, tmp_path: Path, short: list[object]
) -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert fleetmap("simulate", tmp_path / f"{name}.mcap", *short, "--drive", seed, "--sensors", "imu")[0] == 0
    first, again, other = ((tmp_path / f"{name}.mcap").read_bytes() for name in "abc")
    assert first == again
    assert first != other
    assert (tmp_path / "a.reference.tum").read_bytes() == (tmp_path / "b.reference.tum").read_bytes()


def test_drives_of_different_length_share_a_world(fleetmap: Run, tmp_path: Path, camera_file: Path) -> None:
    small = ["--camera", camera_file, "--rate-hz", 1, "--gnss", "none", "--kind", "open"]
    assert fleetmap("simulate", tmp_path / "a.mcap", *small, "--length-m", 10, "--drive", 1)[0] == 0
    other = ["--length-m", 20, "--drive", 2, "--start-m", 30, "--lane-m", 3.5]
    assert fleetmap("simulate", tmp_path / "b.mcap", *small, *other)[0] == 0
    assert (tmp_path / "a.markers.json").read_bytes() == (tmp_path / "b.markers.json").read_bytes()
    first, second = (read_trajectory(tmp_path / f"{name}.reference.tum") for name in "ab")
    assert open_drive(tmp_path / "a.mcap").gnss_fixes() == []
    assert 15.0 < np.linalg.norm(second.positions_m[0] - first.positions_m[0]) < 35.0


def test_receivers_err_as_they_are_told(fleetmap: Run, tmp_path: Path, short: list[object]) -> None:
    often = ["--gnss-interval-s", 0.1]
    variants = {
        "rtk": ["--gnss", "rtk", *often],
        "consumer": ["--gnss", "consumer", *often],
        "wild": ["--gnss", "rtk", *often, "--gnss-outliers", 0.25],
        "late": ["--gnss", "rtk", *often, "--gnss-clock-offset-s", 0.25, "--gnss-gap", "0.3:0.5"],
    }
    fixes = {}
    for name, options in variants.items():
        code, _, stderr = fleetmap("simulate", tmp_path / f"{name}.mcap", *short, *options)
        assert code == 0, stderr
        fixes[name] = open_drive(tmp_path / f"{name}.mcap").gnss_fixes()
    assert len(fixes["rtk"]) - 6 <= len(fixes["late"]) <= len(fixes["rtk"]) - 4
    assert fixes["late"][0].stamp_ns - fixes["rtk"][0].stamp_ns == 250_000_000
    reference = read_trajectory(tmp_path / "rtk.reference.tum")
    since_s = (reference.stamps_ns - reference.stamps_ns[0]) * 1e-9
    grid = UtmGrid(reference.epsg)
    errors_m = {}
    for name in ("rtk", "consumer"):
        places = [(fix.lat_deg, fix.lon_deg, fix.height_m) for fix in fixes[name]]
        in_utm = grid.from_geodetic(*np.array(places).T)
        at_s = [(fix.stamp_ns - int(reference.stamps_ns[0])) * 1e-9 for fix in fixes[name]]
        true = np.stack([np.interp(at_s, since_s, reference.positions_m[:, i]) for i in range(3)], axis=1)
        errors_m[name] = np.abs(in_utm - true)
    wild = {fix.stamp_ns: fix for fix in fixes["wild"]}
    moved = [
        fix
        for fix in fixes["rtk"]
        if (wild[fix.stamp_ns].lat_deg, wild[fix.stamp_ns].lon_deg) != (fix.lat_deg, fix.lon_deg)
    ]
    assert len(moved) == round(0.25 * len(fixes["rtk"]))
    assert 0.02 < errors_m["rtk"].mean() < 0.07
    assert 0.2 < errors_m["consumer"].mean() < 3.0
    assert [np.sqrt(fixes[name][0].covariance_enu_m2[0, 0]) for name in ("rtk", "consumer")] == [0.05, 1.5]


BROKEN = {
    "speed": (["--speed-mps", "-3"], "speed of -3 m/s"),
    "no speed": (["--speed-mps", "nan"], "speed of nan m/s"),
    "length": (["--length-m", "0"], "drive of 0 m"),
    "endless": (["--length-m", "1e9"], "drive of 1e+09 m"),
    "world too long": (["--kind", "tunnel", "--world-length-m", "90000"], "90000"),
    "start": (["--start-m", "500", "--world-length-m", "200"], "the road ends at"),
    "rate": (["--rate-hz", "0"], "0 images/s"),
    "lane": (["--lane-m", "40"], "lane 40 m"),
    "height": (["--camera-height-m", "-1"], "camera -1 m above"),
    "shutter": (["--rolling-shutter-ms", "-5"], "shutter of -0.005 s"),
    "interval": (["--gnss-interval-s", "0"], "interval of 0.0 s"),
    "clock": (["--gnss-clock-offset-s", "1000"], "clock"),
    "gap": (["--gnss-gap", "soon"], "START_S:LENGTH_S"),
    "outliers": (["--gnss-outliers", "20"], "share of 0 to 1"),
    "receiver": (["--gnss", "perfect"], "perfect"),
    "kind": (["--kind", "moon"], "moon"),
    "look": (["--look", "fog"], "fog"),
    "sensor": (["--sensors", "imu,radar"], "'radar' is no sensor"),
    "site": (["--site", "91,0,0"], "outside UTM"),
    "antenna": (["--antenna-offset", "1,2"], "X,Y,Z"),
    "seed": (["--world", "-1"], "-1"),
    "no camera": (["--camera", "nowhere.yaml"], "nowhere.yaml"),
}


@pytest.mark.parametrize("case", list(BROKEN))
def test_what_makes_no_sense_is_one_line_and_writes_nothing(
    fleetmap: Run, tmp_path: Path, short: list[object], case: str
) -> None:
    options, complaint = BROKEN[case]
    folder = tmp_path / "out"
    folder.mkdir()
    code, stdout, stderr = fleetmap("simulate", folder / "a.mcap", *short, *options)
    assert (code, stdout) == (2, "")
    assert stderr.startswith("error: ")
    assert stderr.count("\n") == 1
    assert complaint in stderr
    assert list(folder.iterdir()) == []


def test_a_broken_camera_file_is_one_line(fleetmap: Run, tmp_path: Path, short: list[object]) -> None:
    (tmp_path / "bad.yaml").write_text("image_width: 640\n")
    code, _, stderr = fleetmap("simulate", tmp_path / "a.mcap", *short, "--camera", tmp_path / "bad.yaml")
    assert (code, stderr.count("\n")) == (2, 1)
    assert "bad.yaml" in stderr


def test_an_existing_recording_is_kept_unless_forced(fleetmap: Run, tmp_path: Path, short: list[object]) -> None:
    out = tmp_path / "a.mcap"
    out.write_bytes(b"precious")
    code, _, stderr = fleetmap("simulate", out, *short)
    assert code == 2
    assert "--force" in stderr
    assert out.read_bytes() == b"precious"
    assert fleetmap("simulate", out, *short, "--force")[0] == 0
    assert open_drive(out).frame_count > 10


def test_images_of_the_same_drive_are_taken_over_and_the_bytes_are_the_same(
    fleetmap: Run, tmp_path: Path, short: list[object]
) -> None:
    assert fleetmap("simulate", tmp_path / "rtk.mcap", *short)[0] == 0
    other = [*short, "--gnss", "consumer", "--gnss-interval-s", 0.2]
    assert fleetmap("simulate", tmp_path / "rendered.mcap", *other)[0] == 0
    code, _, stderr = fleetmap("simulate", tmp_path / "taken.mcap", *other, "--images-from", tmp_path / "rtk.mcap")
    assert code == 0, stderr
    assert (tmp_path / "taken.mcap").read_bytes() == (tmp_path / "rendered.mcap").read_bytes()
    assert len(open_drive(tmp_path / "taken.mcap").gnss_fixes()) > len(
        open_drive(tmp_path / "rtk.mcap").gnss_fixes()
    )
    refused = ["--look", "dusk", "--images-from", tmp_path / "rtk.mcap"]
    code, stdout, stderr = fleetmap("simulate", tmp_path / "dusk.mcap", *short, *refused)
    assert (code, stdout) == (2, "")
    assert "does not show the drive that these options make: its image 0 looks different" in stderr
    assert list(tmp_path.glob("dusk.*")) == []
