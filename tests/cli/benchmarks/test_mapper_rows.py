"""The rows of ``fleetmap benchmark mapper`` around a circuit of a few metres, and what they compute themselves."""

from __future__ import annotations

import json
from typing import get_args

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.camera_file import write_camera
from fleetmap.errors import RunError
from fleetmap.evaluation import TrajectoryErrors
from fleetmap.geodesy import UtmGrid
from fleetmap.gnss import CONSUMER, sample_fixes
from fleetmap.trajectory import Trajectory
from fleetmap_cli.benchmarks.mapper import mapper_benchmark
from fleetmap_cli.benchmarks.mapper_ablation import MODES
from fleetmap_cli.benchmarks.mapper_drives import Circuit
from fleetmap_cli.benchmarks.mapper_gnss import injected_bias_m, shape_error_m
from fleetmap_cli.benchmarks.mapper_speed import speed_figures
from fleetmap_cli.benchmarks.mapper_stress import TunnelErrors, longest_gap
from fleetmap_cli.benchmarks.running import run_benchmark
from fleetmap_mapper.settings import GnssMode

T0_NS = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """The folder of a run of three rows, and their outcomes by name: three maps of 45 m of a street."""
    folder = tmp_path_factory.mktemp("benchmark")
    write_camera(folder / "small.yaml", Camera(480, 240, 320.0, 320.0, 239.5, 119.5))
    world = f"--kind street --world 1 --rate-hz 5 --camera {folder / 'small.yaml'}"
    circuit = Circuit(length_m=45.0, tunnel_s=2.0, world=world)
    rows = ["circuit-slam", "circuit-tunnel", "ablation-circuit"]
    outcomes = run_benchmark(mapper_benchmark(circuit, ("none", "full")), folder, folder / "out", row_names=rows)
    assert [outcome.reason for outcome in outcomes] == [""] * 3
    return folder / "out", {outcome.name: outcome for outcome in outcomes}


def test_plain_slam_is_judged_by_its_shape(results):
    _, outcomes = results
    plain = outcomes["circuit-slam"]
    assert 0.002 < plain.figures["mean m"] < 0.5
    assert plain.figures["posed"] == "26 of 26"
    assert plain.figures["50 m windows: RMSE m"] is None  # the drive is shorter


def test_a_tunnel_is_held_against_the_run_without_one(results):
    _, outcomes = results
    tunnel = outcomes["circuit-tunnel"]
    figures = tunnel.figures
    assert 16.0 < figures["without fixes m"] < 28.0  # two seconds, and up to the fixes beside
    assert 0.01 < figures["inside: mean m"] <= figures["max m"] < 0.5
    assert figures["max, % of the way"] == pytest.approx(
        100 * figures["max m"] / figures["without fixes m"], rel=0.05
    )
    assert figures["ratio"] == pytest.approx(figures["outside: mean m"] / figures["clean run's m"], rel=0.05)
    assert 0.3 < figures["ratio"] < 3.0


def test_each_use_of_the_fixes_has_a_line_and_together_they_have_a_picture(results):
    folder, outcomes = results
    ablation = outcomes["ablation-circuit"]
    *modes, spline = ablation.lines
    means = [ablation.lines[mode]["mean m"] for mode in modes]
    assert [mode.split("`")[1] for mode in modes] == ["none", "full"]
    assert 0.01 < ablation.lines[spline]["mean m"] < 0.5
    assert 0.01 < means[1] < means[0] < 1.0
    assert ablation.lines["`full`: both"]["mean, times below none"] == pytest.approx(means[0] / means[1], rel=0.1)
    assert ablation.pictures == ("ablation.png",)
    assert (folder / "ablation.png").read_bytes().startswith(b"\x89PNG")


def test_rows_share_maps_and_every_row_shows_the_commands_that_make_it(results):
    folder, outcomes = results
    plain, ablation = (outcomes[name].commands for name in ("circuit-slam", "ablation-circuit"))
    (mapping,) = (command for command in plain if command.startswith("fleetmap map "))
    assert mapping in ablation
    assert plain[0] == ablation[0]
    assert plain[0].startswith("fleetmap simulate circuit-rtk-1hz.mcap --kind street")
    assert len([command for command in ablation if command.startswith("fleetmap map ")]) == 2
    taken = [command for command in outcomes["circuit-tunnel"].commands if "--images-from" in command]
    assert [command.split()[2] for command in taken] == ["circuit-tunnel.mcap"]
    assert sorted(path.name for path in folder.iterdir()) == ["ablation.png", "mapper.json", "mapper.md"]


def test_the_report_has_a_table_a_group(results):
    folder, _ = results
    text, rows = (folder / "mapper.md").read_text(), json.loads((folder / "mapper.json").read_text())["rows"]
    headings = [line for line in text.splitlines() if line.startswith("## ")]
    assert headings == ["## Plain SLAM", "## Without fixes", "## Ablation", "## Commands"]
    assert "| full <= final <= none |" in text
    assert [row["group"] for row in rows] == ["Plain SLAM", "Without fixes", "Ablation"]
    assert len(rows[2]["lines"]) == 3
    assert rows[1]["reach"].startswith("inside <= 0.5 %")


def test_every_line_of_what_is_asked_is_a_row():
    rows = {row.name: row for row in mapper_benchmark(Circuit()).rows}
    real, simulated = (
        {name.partition("-")[2] for name in rows if name.startswith(drive)} for drive in ("odo-", "circuit-")
    )
    assert real == {"slam", "rtk-5s", "rtk-gap", "rtk", "arm", "consumer"}
    assert simulated == real - {"arm"} | {"rtk-1hz", "outliers", "clock", "tunnel"}
    assert {"raw", "raw-slam", "throughput", "ablation-odo", "ablation-raw", "ablation-circuit"} < set(rows)
    assert all(row.group is not None for row in rows.values())
    assert {name for name, row in rows.items() if not row.needs} == {
        name for name in rows if name.startswith("circuit-") or name == "ablation-circuit"
    }


def test_the_ablation_compares_every_use_of_the_fixes():
    assert MODES == ("none", "mapping", "final", "full") == get_args(GnssMode)


def straight_drive(count):
    positions = np.array([455_000.0, 5_425_000.0, 115.0]) + np.arange(count)[:, None] * [0.8, 0.0, 0.0]
    return Trajectory(32632, T0_NS + np.arange(count) * 100_000_000, positions, np.tile(np.eye(3), (count, 1, 1)))


def test_the_bias_is_the_one_that_the_fixes_carry():
    reference = straight_drive(600)
    fixes = sample_fixes(reference, CONSUMER, seed=7)
    stamps_ns = np.array([fix.stamp_ns for fix in fixes])
    grid = UtmGrid(32632)
    places = np.array([(fix.lat_deg, fix.lon_deg, fix.height_m) for fix in fixes])
    true = reference.positions_m[0] + (stamps_ns[:, None] - T0_NS) * 1e-9 * [8.0, 0.0, 0.0]
    errors_m = grid.from_geodetic(*places.T) - true
    enu_from_grid = grid.grid_from_enu(*places[0, :2]).T
    white = errors_m @ enu_from_grid.T - injected_bias_m(stamps_ns, 7)
    assert white.std(axis=0) == pytest.approx([0.1] * 3, rel=0.1)
    assert np.abs(white.mean(axis=0)).max() < 0.02
    other = errors_m @ enu_from_grid.T - injected_bias_m(stamps_ns, 8)
    assert other.std() > 0.3


def test_a_shape_has_no_place():
    offsets_m = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, -2.0, 0.0]])
    assert shape_error_m(offsets_m) == pytest.approx(1.5)
    assert shape_error_m(offsets_m + np.array([30.0, -4.0, 7.0])) == pytest.approx(1.5)


def test_errors_are_counted_inside_and_outside_the_longest_gap():
    reference = straight_drive(100)
    fixes = [fix for fix in sample_fixes(reference, CONSUMER) if not 3.0 < (fix.stamp_ns - T0_NS) * 1e-9 < 6.0]
    gap_ns = longest_gap(fixes)
    assert [(stamp - T0_NS) // 1_000_000 for stamp in gap_ns] == [2937, 6037]
    height_m = np.where((np.arange(100) >= 30) & (np.arange(100) <= 60), 0.4, 0.1)
    height_m[45] = 0.9
    errors = TrajectoryErrors(
        stamps_ns=reference.stamps_ns,
        true_positions_m=reference.positions_m,
        offsets_m=np.stack([0 * height_m, 0 * height_m, height_m], axis=1),
        road_m=np.arange(100) * 0.8,
        compared=np.arange(100),
    )
    found = TunnelErrors.of(errors, gap_ns)
    assert (found.max_m, found.outside_mean_m) == pytest.approx((0.9, 0.1))
    assert found.mean_m == pytest.approx((30 * 0.4 + 0.9) / 31)
    assert found.length_m == pytest.approx(24.0)
    with pytest.raises(RunError, match="no image was posed inside"):
        TunnelErrors.of(errors, (T0_NS - 2, T0_NS - 1))


def test_the_share_of_each_stage_is_read_off_what_map_says():
    told = (
        "warning: something else\n"
        "INFO: 300 images in 12.5 s, 24.0 images/s before the map is placed: reading 0.5 s, "
        "finding features 9.9 s, adjusting 2.5 s\n"
    )
    assert speed_figures(told) == {
        "images/s": 24.0,
        "before the final adjustment s": 12.5,
        "reading": "4 %",
        "finding features": "79 %",
        "adjusting": "20 %",
    }
    with pytest.raises(RunError, match="how fast"):
        speed_figures("nothing of the kind")
