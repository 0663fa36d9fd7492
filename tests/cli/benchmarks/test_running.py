"""Rows run the commands they show; what is missing, fails or is interrupted does not take the rest along."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fleetmap.errors import InputError, OutputExistsError, RunError
from fleetmap_cli.benchmarks.row import Benchmark, Row
from fleetmap_cli.benchmarks.running import run_benchmark
from fleetmap_cli.benchmarks.workbench import CannotMeasureHereError, Workbench


def version_row(bench):
    return {"version": bench.fleetmap("--version").stdout.strip()}


def failing_row(bench):
    bench.fleetmap("info DATA/drives/nothing.mcap")
    raise AssertionError("a command that failed was taken for one that ended well")


def hopeless_row(bench):
    raise CannotMeasureHereError("needs 6 GB of free disk; there are 0.1")


def interrupted_row(bench):
    (bench.folder / "half.mcap").write_bytes(b"half")
    raise KeyboardInterrupt


def benchmark_of(*rows):
    return Benchmark("tiny", "rows for tests", rows)


def saved(folder):
    return json.loads((folder / "tiny.json").read_text())["rows"]


def test_rows_are_measured_skipped_or_failed_and_all_are_told(tmp_path):
    benchmark = benchmark_of(
        Row("good", "says its version", version_row),
        Row("bad", "fails", failing_row),
        Row("absent", "lacks its data", version_row, needs=("drives/absent",)),
        Row("hopeless", "lacks its disk", hopeless_row),
    )
    data = tmp_path / "data"
    lines: list[str] = []
    outcomes = run_benchmark(benchmark, data, tmp_path / "out", tell=lines.append)
    assert [outcome.status for outcome in outcomes] == ["measured", "failed", "skipped", "skipped"]
    good, bad, absent, hopeless = saved(tmp_path / "out")
    assert good["commands"] == ["fleetmap --version"]
    assert good["figures"]["version"].startswith("fleetmap")
    assert bad["commands"] == ["fleetmap info DATA/drives/nothing.mcap"]
    assert bad["reason"].startswith("'fleetmap info' ended with exit code 2: error: ")
    assert "DATA/drives/nothing.mcap" in bad["reason"]
    assert str(data) not in bad["reason"]
    assert absent["reason"] == "needs DATA/drives/absent"
    assert hopeless["reason"] == "needs 6 GB of free disk; there are 0.1"
    assert [line.split("]")[0] for line in lines] == [f"[{n}/4" for n in (1, 1, 2, 2, 3, 3, 4, 4)]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["tiny.json", "tiny.md"]


def test_the_commands_shown_give_the_same_when_typed_by_hand(tmp_path):
    bench = Workbench(tmp_path, tmp_path, tmp_path)
    printed = bench.fleetmap("--version").stdout
    (command,) = bench.commands
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])  # where fleetmap is installed
    typed = subprocess.run(
        command, shell=True, capture_output=True, text=True, check=True, env={**os.environ, "PATH": path}
    )
    assert typed.stdout == printed


def test_an_interrupted_run_keeps_its_finished_rows_and_removes_its_work(tmp_path):
    benchmark = benchmark_of(Row("good", "", version_row), Row("long", "", interrupted_row))
    with pytest.raises(KeyboardInterrupt):
        run_benchmark(benchmark, tmp_path, tmp_path / "out")
    assert [row["name"] for row in saved(tmp_path / "out")] == ["good"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["tiny.json", "tiny.md"]


def test_rows_are_chosen_by_name(tmp_path):
    benchmark = benchmark_of(Row("one", "", version_row), Row("two", "", version_row))
    assert [o.name for o in run_benchmark(benchmark, tmp_path, tmp_path / "out", row_names=["two"])] == ["two"]
    with pytest.raises(InputError, match="no row 'three'; its rows are one, two"):
        run_benchmark(benchmark, tmp_path, tmp_path / "other", row_names=["three"])
    assert not (tmp_path / "other").exists()


def test_results_of_an_earlier_run_are_replaced_by_force_only(tmp_path):
    benchmark = benchmark_of(Row("one", "", version_row))
    (tmp_path / "tiny.json").write_text("earlier")
    with pytest.raises(OutputExistsError, match="--force"):
        run_benchmark(benchmark, tmp_path, tmp_path)
    assert (tmp_path / "tiny.json").read_text() == "earlier"
    run_benchmark(benchmark, tmp_path, tmp_path, force=True)
    assert saved(tmp_path)[0]["status"] == "measured"


def test_exit_codes_that_are_accepted_are_no_failure(tmp_path):
    bench = Workbench(tmp_path, tmp_path, tmp_path)
    assert bench.fleetmap("info nothing.mcap", accepted_codes=(0, 2)).stdout == ""
    with pytest.raises(RunError, match=r"'fleetmap info' ended with exit code 2: error: "):
        bench.fleetmap("info nothing.mcap")


def test_rows_that_share_their_work_run_a_command_once_and_all_show_it(tmp_path):
    runs = []

    def row(bench):
        runs.append(bench.once("--version"))
        assert bench.once("--version") is runs[-1]
        bench.beside("of others", {"version": "2"})
        (bench.folder / f"of-{len(runs)}").touch()
        return {"files": len(list(bench.folder.iterdir()))}

    rows = (Row("one", "", row), Row("two", "", row))
    shared = run_benchmark(Benchmark("tiny", "", rows, shares_work=True), tmp_path, tmp_path / "shared")
    assert runs[1] is runs[0]
    assert [outcome.commands for outcome in shared] == [("fleetmap --version",)] * 2
    assert [outcome.figures["files"] for outcome in shared] == [1, 2]
    assert [outcome.lines for outcome in shared] == [{"of others": {"version": "2"}}] * 2
    run_benchmark(Benchmark("tiny", "", rows), tmp_path, tmp_path / "apart")
    assert runs[3] is not runs[2]
    for folder in ("shared", "apart"):
        assert sorted(path.name for path in (tmp_path / folder).iterdir()) == ["tiny.json", "tiny.md"]
