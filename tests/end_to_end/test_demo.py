"""``fleetmap demo`` as a newcomer types it: every stage real, nothing but a picture left."""

from __future__ import annotations

import os
import re
import signal
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from fleetmap.drives import open_drive

FLEETMAP = [sys.executable, "-c", "from fleetmap_cli.main import main; main()"]
ROWS = ["max", "mean", "median", "min", "rmse", "sse", "std", "p95"]


@pytest.fixture
def alone(tmp_path: Path) -> dict[str, str]:
    """An environment whose temporary files and caches are its own; every process in it can be told by that."""
    folders = {name: tmp_path / name.lower() for name in ("TMPDIR", "XDG_CACHE_HOME")}
    for folder in folders.values():
        folder.mkdir()
    return {**os.environ, "COLUMNS": "80", **{name: str(folder) for name, folder in folders.items()}}


def processes_in(environment: dict[str, str]) -> list[str]:
    """Command lines of the processes that were started in an environment and have not ended."""
    marker = f"TMPDIR={environment['TMPDIR']}".encode()
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if marker in (process / "environ").read_bytes().split(b"\0"):
                found.append((process / "cmdline").read_bytes().replace(b"\0", b" ").decode())
        except OSError:
            continue
    return found


def tables(out: str) -> list[dict[str, list[float]]]:
    """Row name -> columns of each printed error table."""
    blocks = re.split(r"^Position error .*$", out, flags=re.MULTILINE)[1:]
    return [
        {row: [float(v) for v in re.findall(rf"^  {row} +(.*)$", block, re.MULTILINE)[0].split()] for row in ROWS}
        for block in blocks
    ]


def test_the_demonstration_maps_a_street_and_localises_a_second_vehicle_in_it(
    tmp_path: Path, alone: dict[str, str]
) -> None:
    here, kept = tmp_path / "here", tmp_path / "kept"
    here.mkdir()
    done = subprocess.run(
        [*FLEETMAP, "demo", "--length-m", "40", "--keep", str(kept)],
        cwd=here,
        env=alone,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert processes_in(alone) == []

    survey, second = tables(done.stdout)
    assert 0.003 < survey["mean"][0] < 0.15
    assert survey["max"][0] < 0.4
    assert 0.003 < survey["mean"][2] < 0.3  # the spline through the fixes
    assert 0.003 < second["mean"][0] < 0.15
    assert second["max"][0] < 0.5
    compared = re.findall(r"^  coverage: (\d+) of (\d+) poses compared", done.stdout, re.MULTILINE)
    assert [int(count) / int(total) for count, total in compared] == [1.0, pytest.approx(1.0, abs=0.05)]
    assert int(compared[0][1]) >= 50
    assert int(compared[1][1]) >= 30
    assert re.search(r"^my_map: EPSG:32632, .* 40 m, \d{4,} landmarks, ", done.stdout, re.MULTILINE)  # over HTTP
    assert done.stderr == ""  # bars are for terminals

    assert [item.name for item in here.iterdir()] == ["fleetmap_demo.png"]
    picture = (here / "fleetmap_demo.png").read_bytes()
    assert picture.startswith(b"\x89PNG\r\n\x1a\n")
    width_px, height_px = struct.unpack(">II", picture[16:24])
    assert 1200 <= width_px <= 3000
    assert 700 <= height_px <= 2000
    assert len(picture) > 100_000
    assert list(Path(alone["TMPDIR"]).glob("fleetmap*")) == []
    assert list(Path(alone["XDG_CACHE_HOME"]).glob("fleetmap*")) == []
    drives = [f"{name}.{end}" for name in ("second", "survey") for end in ("mcap", "reference.tum", "tum")]
    assert sorted(item.name for item in kept.iterdir()) == ["my_map", *drives]
    assert open_drive(kept / "second.mcap").gnss_fixes() == []
    assert len(open_drive(kept / "survey.mcap").gnss_fixes()) == 7


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_demonstration_leaves_nothing_behind(
    tmp_path: Path, alone: dict[str, str], number: int
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    process = subprocess.Popen(
        [*FLEETMAP, "demo", "--length-m", "30", "--keep", "kept"],
        cwd=here,
        env=alone,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert any(line.startswith("survey.mcap: ") for line in process.stdout)
    os.kill(process.pid, number)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert err.endswith("interrupted\n")
    assert "Traceback" not in err
    assert list(here.iterdir()) == []
    assert list(Path(alone["TMPDIR"]).glob("fleetmap*")) == []
    assert processes_in(alone) == []


TWO_SERVERS = """
import sys
from pathlib import Path
from fleetmap_cli.demo_processes import free_port, interrupted_once, run_verb, running_map_server
folder = Path(sys.argv[1])
try:
    with interrupted_once(), running_map_server("first", folder) as server:
        assert server.http_url.startswith("http://127.0.0.1:")
        another = f"tcp/127.0.0.1:{free_port()}"
        run_verb(["serve", "--store", "second", "--zenoh", another, "--http", "127.0.0.1:0"], folder)
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_verbs_in_processes_of_their_own_end_with_their_caller(
    tmp_path: Path, alone: dict[str, str], number: int
) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", TWO_SERVERS, str(tmp_path)],
        env=alone,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert any(line.startswith("serving 0 maps of second: ") for line in process.stdout)
    assert len(processes_in(alone)) == 3
    os.kill(process.pid, number)
    _, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (130, "")
    assert processes_in(alone) == []
