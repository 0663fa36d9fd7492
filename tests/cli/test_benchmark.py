"""``fleetmap benchmark`` through the command line."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from fleetmap_cli.verbs.benchmark import benchmark


def run(*arguments, **environment):
    return CliRunner().invoke(benchmark, [str(word) for word in arguments], env=environment)


def test_rows_without_data_are_skipped_with_a_line_each_and_it_is_no_failure(tmp_path):
    done = run("drives", "--data", tmp_path, "--output", tmp_path / "out", "--rows", "fair-world,large-file")
    assert done.exit_code == 0, done.output
    assert (
        "skipped: fair-world, needs DATA/drives/kitti_odo_00_first300 and DATA/drives/kitti_raw_20110926_1405"
        in (done.stdout)
    )
    assert "skipped: large-file, needs DATA/drives/kitti_odo_00_first300" in done.stdout
    assert str(tmp_path) not in done.stdout
    statuses = [row["status"] for row in json.loads((tmp_path / "out" / "drives.json").read_text())["rows"]]
    assert statuses == ["skipped", "skipped"]
    assert "skipped: large-file" in (tmp_path / "out" / "drives.md").read_text()


def test_the_server_benchmark_needs_no_data_and_prints_one_table(tmp_path):
    done = run("server", "--data", tmp_path, "--output", tmp_path / "out", "--rows", "fetch")
    assert done.exit_code == 0, done.output
    (row,) = json.loads((tmp_path / "out" / "server.json").read_text())["rows"]
    assert (row["name"], row["status"]) == ("fetch", "measured")
    assert done.stdout.count("**fetch**") + done.stdout.count("| fetch") >= 1
    speeds = [value for name, value in row["figures"].items() if "MB/s" in name]
    assert len(speeds) >= 3
    assert all(1 < value < 100_000 for value in speeds)


def test_the_data_folder_comes_from_the_environment_where_no_option_says_it(tmp_path):
    (tmp_path / "drives" / "kitti_odo_00_first300").mkdir(parents=True)
    done = run("drives", "--output", tmp_path / "out", "--rows", "large-file", FLEETMAP_DATA=str(tmp_path))
    assert "skipped: large-file, needs JPEG images in DATA/drives/kitti_odo_00_first300/cam0" in done.stdout


def test_a_row_that_fails_says_why_and_the_exit_code_is_one(tmp_path):
    (tmp_path / "drives" / "kitti_odo_00_first300").mkdir(parents=True)
    arguments = ["drives", "--data", str(tmp_path), "--output", str(tmp_path / "out"), "--rows", "spline-rtk"]
    done = CliRunner().invoke(benchmark, arguments, standalone_mode=False)  # as fleetmap's main calls it
    assert done.return_value == 1
    assert "failed: spline-rtk, 'fleetmap convert' ended with exit code 2: error: " in done.stdout
    assert "`fleetmap convert kitti-odometry DATA/drives/kitti_odo_00_first300 o00.mcap" in done.stdout


@pytest.mark.parametrize("name", ["drives", "mapper", "localizer", "server"])
def test_every_benchmark_lists_its_rows(name, tmp_path):
    done = run(name, "--list")
    assert done.exit_code == 0
    names = [line.split()[0] for line in done.stdout.splitlines()]
    assert len(names) == len(set(names)) > 0


def test_no_other_benchmark_is_accepted():
    done = run("nothing")
    assert done.exit_code == 2
    assert "'drives', 'mapper', 'localizer', 'server'" in done.output


def test_the_spline_yardstick_is_measured_on_the_real_drive(data_folder, tmp_path):
    done = run("drives", "--data", data_folder, "--output", tmp_path / "out", "--rows", "spline-rtk-5s")
    assert done.exit_code == 0, done.output
    (row,) = json.loads((tmp_path / "out" / "drives.json").read_text())["rows"]
    assert 0.2 < row["figures"]["smoothing spline mean m"] < 2.0
