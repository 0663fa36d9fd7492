"""The table, the JSON file and the machine of a benchmark."""

from __future__ import annotations

import json
import os
import platform
import socket
from pathlib import Path

from fleetmap_cli.benchmarks.machine import machine, versions
from fleetmap_cli.benchmarks.report import tables, write_report
from fleetmap_cli.benchmarks.row import Benchmark, Group, Outcome

BENCHMARK = Benchmark("tiny", "nothing much", (), columns=("mean m", "never measured"))
OUTCOMES = [
    Outcome(
        "one",
        "a first row",
        "measured",
        commands=("fleetmap convert x DATA/y out.mcap", "fleetmap map out.mcap"),
        figures={"mean m": 0.123, "posed": "3 of 4", "spread m": None},
        pictures=("one.png",),
        duration_s=1.26,
    ),
    Outcome("two", "a row | that failed", "failed", commands=("fleetmap map nothing",), reason="it said why"),
    Outcome("three", "a row without data", "skipped", reason="needs DATA/drives/elsewhere"),
]


def cells(line):
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_table_has_a_line_a_row_and_the_columns_that_are_filled():
    lines = tables(BENCHMARK, OUTCOMES).splitlines()
    assert cells(lines[0]) == ["row", "mean m", "figures", "command"]
    assert cells(lines[1]) == ["---"] * 4
    assert cells(lines[2]) == [
        "**one**: a first row",
        "0.123",
        "posed 3 of 4; spread m",
        "`fleetmap convert x DATA/y out.mcap`<br>`fleetmap map out.mcap`",
    ]
    assert cells(lines[3]) == ["**two**: a row / that failed", "", "failed", "`fleetmap map nothing`"]
    assert len(lines) == 4


def test_groups_have_tables_of_their_own_with_lines_beside_and_the_commands_come_last():
    slow, fast = Group("Slow", "Read slowly.", ("mean m", "posed")), Group("Fast", "", ("images/s",))
    peer = {"mean m": "0.2 to 0.3", "note": "theirs"}
    outcomes = [
        Outcome(
            "one", "first", "measured", ("a",), {"mean m": 0.1}, {"peer": peer}, group=slow, reach="mean <= 0.1"
        ),
        Outcome("two", "second", "failed", ("a", "b"), reason="it said why", group=slow),
        Outcome("three", "third", "measured", ("c",), {"images/s": 20.0}, group=fast),
        Outcome("four", "fourth", "skipped", reason="needs DATA/x", group=Group("Absent", "", ())),
    ]
    blocks = tables(BENCHMARK, outcomes).split("\n\n")
    assert blocks[:2] == ["## Slow", "Read slowly."]
    assert [cells(line) for line in blocks[2].splitlines()] == [
        ["", "mean m", "figures", "reach"],
        ["---"] * 4,
        ["**one**: first", "0.1", "", "mean <= 0.1"],
        ["peer", "0.2 to 0.3", "note theirs", ""],
        ["**two**: second", "", "failed", ""],
    ]
    assert blocks[3] == "## Fast"
    assert [cells(line) for line in blocks[4].splitlines()] == [
        ["", "images/s"],
        ["---"] * 2,
        ["**three**: third", "20"],
    ]
    assert blocks[5:] == ["## Commands", "**one**", "    a", "**two**", "    a\n    b", "**three**", "    c"]


def test_the_files_say_all_and_name_neither_host_nor_paths(tmp_path):
    write_report(tmp_path, BENCHMARK, OUTCOMES)
    text, content = (tmp_path / "tiny.md").read_text(), json.loads((tmp_path / "tiny.json").read_text())
    assert tables(BENCHMARK, OUTCOMES) in text
    assert "* skipped: three, needs DATA/drives/elsewhere\n" in text
    assert "* failed: two, it said why\n" in text
    assert "![one](one.png)" in text
    assert f"Python: {platform.python_version()}" in text
    assert [row["status"] for row in content["rows"]] == ["measured", "failed", "skipped"]
    assert content["rows"][0]["figures"] == {"mean m": 0.123, "posed": "3 of 4", "spread m": None}
    assert content["rows"][0]["duration_s"] == 1.3
    assert content["machine"] == machine()
    for private in (str(Path.home()), str(tmp_path), str(Path.cwd())):
        assert private not in text + json.dumps(content)
    assert socket.gethostname() not in text or socket.gethostname() == "localhost"


def test_the_machine_is_this_one():
    found = machine()
    assert 1 <= int(found["cores"]) <= (os.cpu_count() or 1)
    assert 0.5 < float(found["memory"].removesuffix(" GB")) < 20_000
    assert platform.release() in found["system"]
    assert found["processor"]


def test_the_versions_are_those_that_run():
    import cv2
    import numpy as np

    found = versions()
    assert found["numpy"] == np.__version__
    assert found["OpenCV"].startswith(cv2.__version__)
    assert "not installed" not in found.values()
