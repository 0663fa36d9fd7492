from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.covariances import PoseCovariances, write_covariances
from fleetmap.drive import GnssFix
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import so3_exp
from fleetmap.map_package import open_package
from fleetmap.trajectory import Trajectory, write_trajectory
from fleetmap_cli.main import main

START_NS = 1_700_000_000_000_000_000
OFFSET_IN_CAM_M = (-0.54, 0.02, 0.1)


def straight_drive(epsg: int = 32632, count: int = 50) -> Trajectory:
    stamps_ns = START_NS + np.arange(count, dtype=np.int64) * 100_000_000
    positions_m = np.array([455_300.0, 5_425_500.0, 120.0]) + np.arange(count)[:, None] * [0.3, 0.8, 0.0]
    forward = so3_exp(np.array([0.0, 0.0, -0.36])) @ so3_exp(np.array([-np.pi / 2.0, 0.0, 0.0]))
    return Trajectory(epsg, stamps_ns, positions_m, np.tile(forward, (count, 1, 1)))


def shifted(drive: Trajectory, shift_m: np.ndarray) -> Trajectory:
    return Trajectory(drive.epsg, drive.stamps_ns, drive.positions_m + shift_m, drive.rotations)


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """reference.tum, estimate.tum 0.5 m beside and 1.2 m above it, second.tum seen by a second camera."""
    monkeypatch.chdir(tmp_path)
    truth = straight_drive()
    write_trajectory(tmp_path / "reference.tum", truth)
    write_trajectory(tmp_path / "estimate.tum", shifted(truth, np.array([0.3, -0.4, 1.2])))
    write_trajectory(tmp_path / "second.tum", shifted(truth, truth.rotations[0] @ np.array(OFFSET_IN_CAM_M)))
    write_trajectory(tmp_path / "other_zone.tum", straight_drive(32633))
    return tmp_path


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as exit_:
        main(["evaluate", *arguments])
    assert isinstance(exit_.value.code, int)
    return exit_.value.code


@pytest.mark.usefixtures("files")
def test_the_table_shows_the_printed_rows_in_3d_and_horizontally(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("estimate.tum", "reference.tum") == 0
    out, err = capsys.readouterr()
    rows = {line.split()[0]: line.split()[1:] for line in out.splitlines()[2:10]}
    assert list(rows) == ["max", "mean", "median", "min", "rmse", "sse", "std", "p95"]
    assert rows["rmse"] == ["1.3000", "0.5000"]
    assert rows["sse"] == ["84.5000", "12.5000"]
    assert rows["std"] == ["0.0000", "0.0000"]
    assert "50 of 50 poses compared (100.0 %)" in out
    assert "rotation error (deg): median 0.000" in out
    assert err == ""


@pytest.mark.usefixtures("files")
def test_json_is_one_object_with_the_documented_keys_and_nothing_else(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run("second.tum", "reference.tum", "--against-map", "reference.tum", "--json") == 0
    figures = json.loads(capsys.readouterr().out)
    assert set(figures) == {"reference", "against_map"}
    for entry in figures.values():
        assert entry["position_m"]["median"] == pytest.approx(np.linalg.norm(OFFSET_IN_CAM_M), abs=1e-5)
        assert entry["matched"] == 50
        assert entry["coverage"] == 1.0
        assert entry["over_2m"] == 0


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize("joined", [True, False])
def test_a_camera_offset_may_begin_with_a_minus(joined: bool, capsys: pytest.CaptureFixture[str]) -> None:
    text = ",".join(str(number) for number in OFFSET_IN_CAM_M)
    offset = [f"--camera-offset={text}"] if joined else ["--camera-offset", text]
    assert run("second.tum", "--against-map", "reference.tum", *offset, "--json") == 0
    assert json.loads(capsys.readouterr().out)["against_map"]["position_m"]["max"] < 1e-5


@pytest.mark.usefixtures("files")
def test_a_known_mounting_is_no_rotation_error(capsys: pytest.CaptureFixture[str]) -> None:
    half = np.radians(30.0) / 2.0
    for rotation, expected_deg in (("0,0,0,1", 0.0), (f"0,{np.sin(half)},0,{np.cos(half)}", 30.0)):
        arguments = ["--against-map", "reference.tum", "--camera-rotation", rotation, "--json"]
        assert run("second.tum", *arguments) == 0
        figures = json.loads(capsys.readouterr().out)["against_map"]
        assert figures["rotation_deg"]["median"] == pytest.approx(expected_deg, abs=1e-4)


@pytest.mark.usefixtures("files")
def test_a_mounting_that_is_no_rotation_is_a_usage_error(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--against-map", "reference.tum", "--camera-rotation", "0,0,0.1,0"]
    assert run("second.tum", *arguments) == 2
    assert "no unit quaternion" in capsys.readouterr().err


@pytest.mark.usefixtures("files")
def test_sim3_alignment_takes_a_shift_away_and_reports_the_scale(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("estimate.tum", "reference.tum", "--align", "sim3", "--json") == 0
    figures = json.loads(capsys.readouterr().out)["reference"]
    assert figures["position_m"]["max"] < 1e-5
    assert figures["scale"] == pytest.approx(1.0, abs=1e-6)


def test_the_spline_through_the_recorded_fixes_stands_beside(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = straight_drive()
    # A fix a second, 0.75 m west of the camera: on a straight road the spline errs by just that.
    lat_deg, lon_deg, height_m = UtmGrid(truth.epsg).to_geodetic(truth.positions_m[5:46:10] - [0.75, 0.0, 0.0])
    fixes = zip(truth.stamps_ns[5:46:10].tolist(), lat_deg, lon_deg, height_m, strict=True)
    with DriveWriter(files / "drive.mcap", Camera(64, 48, 50.0, 50.0, 31.5, 23.5)) as writer:
        writer.write_image(int(truth.stamps_ns[0]), np.zeros((48, 64), dtype=np.uint8))
        for stamp_ns, lat, lon, height in fixes:
            writer.write_fix(GnssFix(stamp_ns, lat, lon, height, np.eye(3) * 0.0025), "camera")
    judged = ["estimate.tum", "reference.tum", "--spline-through", "drive.mcap"]
    assert run(*judged, "--json") == 0
    figures = json.loads(capsys.readouterr().out)
    for name in ("spline", "smoothing_spline"):
        spline = figures[name]
        assert spline["position_m"]["mean"] == pytest.approx(0.75, abs=1e-4)
        assert (spline["matched"], spline["comparable"]) == (41, 50)
        assert "rotation_deg" not in spline
    assert figures["reference"]["yardstick"] == {
        "common": 41, "mean_m": pytest.approx(1.3, abs=1e-4), "yardstick_mean_m": pytest.approx(0.75, abs=1e-4),
        "difference_m": pytest.approx(0.55, abs=1e-4), "interval": None, "better": False,
    }  # fmt: skip
    assert run(*judged, "--plot", "out.png") == 0
    out = capsys.readouterr().out
    heading = "3-D horizontal spline 3-D spline horizontal smooth 3-D smooth horizontal"
    assert out.splitlines()[1].split() == heading.split()
    assert "NOT better than GNSS alone" in out
    assert "spline coverage: 41 of 50" in out
    assert (files / "out.png").is_file()


def test_the_plot_is_a_picture_and_replaces_an_older_one(files: Path) -> None:
    (files / "out.png").write_text("an older picture")
    assert run("estimate.tum", "reference.tum", "--against-map", "second.tum", "--plot", "out.png") == 0
    data = (files / "out.png").read_bytes()
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    width, height = struct.unpack(">II", data[16:24])
    assert (width, height) == (1560, 720)
    assert not list(files.glob(".*"))


def test_landmarks_beside_the_road_are_drawn(map_package: Path, tmp_path: Path) -> None:
    content = open_package(map_package).localization_map()
    keyframes = content.keyframes
    drive = Trajectory(
        content.anchor.epsg,
        keyframes.stamps_ns,
        content.anchor.utm_from_map(keyframes.positions_m),
        keyframes.rotations,
    )
    survey, without, with_ = (tmp_path / name for name in ("survey.tum", "without.png", "with.png"))
    write_trajectory(survey, drive)
    assert run(str(survey), str(survey), "--plot", str(without)) == 0
    assert run(str(survey), str(survey), "--plot", str(with_), "--landmarks", str(map_package)) == 0
    assert without.read_bytes() != with_.read_bytes()


def test_landmarks_of_another_zone_are_refused(
    files: Path, map_package: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["other_zone.tum", "other_zone.tum", "--plot", "out.png", "--landmarks", str(map_package)]
    assert run(*arguments) == 2
    assert "EPSG:32632, the trajectory in EPSG:32633" in capsys.readouterr().err
    assert not (files / "out.png").exists()


def test_a_map_far_from_the_road_leaves_the_picture_as_it_is(files: Path, map_package: Path) -> None:
    judged = ["estimate.tum", "reference.tum", "--plot", "out.png", "--landmarks", str(map_package)]
    assert run(*judged) == 0
    assert (files / "out.png").is_file()


def test_a_drive_shorter_than_the_window_has_no_windows_and_says_so(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("estimate.tum", "reference.tum", "--json") == 0
    figures = json.loads(capsys.readouterr().out)["reference"]
    assert figures["windows"] is None
    assert figures["intervals"]["position_m"]["mean"] is None
    assert run("estimate.tum", "reference.tum") == 0
    out = capsys.readouterr().out
    assert "windows of 50 m: none fits, the compared poses span 41.9 m of road" in out
    assert "no intervals: 41.9 m of road are one segment only" in out


@pytest.fixture
def long_files(files: Path) -> Path:
    """long.tum, 400 m, and drifting.tum: a hundredth longer, 0.1 m of noise."""
    truth = straight_drive(count=470)
    write_trajectory(files / "long.tum", truth)
    noise = np.random.default_rng(0).normal(0.0, 0.1, truth.positions_m.shape)
    along = truth.positions_m - truth.positions_m[0]
    write_trajectory(files / "drifting.tum", shifted(truth, 0.01 * along + noise))
    return files


@pytest.mark.usefixtures("long_files")
def test_windows_and_intervals_are_printed_and_in_the_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("drifting.tum", "long.tum", "--window-m", "40", "--json") == 0
    figures = json.loads(capsys.readouterr().out)["reference"]
    windows = figures["windows"]
    assert set(windows) == {
        "window_m", "count", "left_out", "mean_rmse_m", "max_rmse_m", "scale_min", "scale_max", "scale_ratio",
        "log_scale_std",
    }  # fmt: skip
    assert windows["window_m"] == 40.0
    assert windows["count"] > 300
    assert windows["mean_rmse_m"] == pytest.approx(0.1 * np.sqrt(3.0), rel=0.1)
    assert 0.97 < windows["scale_min"] < 0.99 < windows["scale_max"] < 1.01
    assert windows["scale_ratio"] == pytest.approx(windows["scale_max"] / windows["scale_min"])
    assert figures["intervals"]["segments"] == 8
    for group in ("position_m", "horizontal_m"):
        for name in ("mean", "median", "rmse", "p95"):
            low, high = figures["intervals"][group][name]
            assert low < figures[group][name] < high
    assert run("drifting.tum", "long.tum") == 0
    out = capsys.readouterr().out
    assert "95 % intervals, bootstrapped over 8 segments of 50.1 m:" in out
    assert "3-D (m): mean " in out
    assert "windows of 50 m, each with a Sim(3) of its own: " in out


@pytest.mark.usefixtures("long_files")
def test_another_trajectory_is_judged_likewise(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("long.tum", "long.tum", "--compare", "drifting.tum", "--align", "sim3", "--json") == 0
    figures = json.loads(capsys.readouterr().out)
    assert set(figures) == {"reference", "compare"}
    assert figures["reference"]["position_m"]["max"] < 1e-5
    assert 0.1 < figures["compare"]["position_m"]["mean"] < 0.25
    assert figures["compare"]["scale"] == pytest.approx(1.0 / 1.01, abs=1e-3)
    assert run("long.tum", "long.tum", "--compare", "drifting.tum", "--plot", "both.pdf") == 0
    assert "of the compared trajectory against the reference" in capsys.readouterr().out


def test_covariances_are_judged_against_reference_and_map(
    long_files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    count = 470
    claims = np.tile(np.diag([1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.01]), (count, 1, 1))
    write_covariances(long_files / "long.csv", PoseCovariances(straight_drive(count=count).stamps_ns, claims))
    noise = np.random.default_rng(1).normal(0.0, 0.1, (count, 3))
    write_trajectory(long_files / "noisy.tum", shifted(straight_drive(count=count), noise))
    judged = ["noisy.tum", "long.tum", "--against-map", "long.tum", "--covariances", "long.csv"]
    assert run(*judged, "--json") == 0
    figures = json.loads(capsys.readouterr().out)
    for entry in figures.values():
        nees = entry["nees"]
        assert nees["count"] == count
        assert nees["position"]["mean"] == pytest.approx(3.0, abs=0.3)
        assert nees["position"]["inside_95"] == pytest.approx(0.95, abs=0.03)
        low, high = entry["intervals"]["nees"]["position_mean"]
        assert low < 3.0 < high
    assert run(*judged) == 0
    assert (
        f"NEES of their positions: mean {nees['position']['mean']:.3f} (consistent: 3;" in capsys.readouterr().out
    )


def test_a_failed_judgement_leaves_no_picture(files: Path) -> None:
    assert run("estimate.tum", "other_zone.tum", "--plot", "out.png") == 2
    assert not (files / "out.png").exists()


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["estimate.tum"], "nothing to judge against"),
        (["estimate.tum", "absent.tum"], "absent.tum"),
        (["estimate.tum", "other_zone.tum"], "EPSG:32632"),
        (["estimate.tum", "reference.tum", "--plot", "out.docx"], ".png"),
        (["estimate.tum", "reference.tum", "--camera-offset", "1,2,3"], "--against-map"),
        (["estimate.tum", "--against-map", "reference.tum", "--camera-offset", "1,2"], "X,Y,Z"),
        (["estimate.tum", "--against-map", "reference.tum", "--align", "sim3"], "REFERENCE.tum"),
        (["estimate.tum", "--against-map", "reference.tum", "--spline-through", "a.mcap"], "REFERENCE.tum"),
        (["estimate.tum", "reference.tum", "--spline-through", "absent.mcap"], "absent.mcap"),
        (["estimate.tum", "--against-map", "reference.tum", "--compare", "second.tum"], "--compare needs"),
        (["estimate.tum", "reference.tum", "--compare", "other_zone.tum"], "EPSG:32633"),
        (["estimate.tum", "reference.tum", "--antenna-offset", "0,0,1"], "--antenna-offset needs"),
        (["estimate.tum", "reference.tum", "--gnss-topic", "/fix"], "--gnss-topic needs"),
        (["estimate.tum", "reference.tum", "--landmarks", "my_map"], "--landmarks needs"),
        (["estimate.tum", "reference.tum", "--landmarks", "my_map", "--plot", "out.png"], "my_map"),
        (["estimate.tum", "reference.tum", "--window-m", "0"], "--window-m"),
        (["estimate.tum", "reference.tum", "--window-m", "nan"], "makes no sense"),
        (["estimate.tum", "reference.tum", "--covariances", "absent.csv"], "absent.csv"),
        (["estimate.tum", "reference.tum", "--covariances", "estimate.tum"], "first line"),
    ],
)
def test_bad_usage_and_bad_input_end_with_exit_code_2(
    arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert complaint in err
    assert "Traceback" not in err


def test_an_estimate_without_any_pose_is_told_apart(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (files / "empty.tum").write_text("# epsg=32632\n")
    assert run("empty.tum", "reference.tum") == 2
    assert "no pose at all" in capsys.readouterr().err
