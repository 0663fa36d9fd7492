"""``fleetmap map`` as a user types it, and as an agent beside a server in processes of their own."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleetmap.drive import Frame
from fleetmap.drives.image_codec import encode_image
from fleetmap.gnss import RTK, sample_fixes
from fleetmap.manifest import manifest_version
from fleetmap.map_package import open_package
from fleetmap.trajectory import read_trajectory

FLEETMAP = [sys.executable, "-c", "from fleetmap_cli.main import main; main()"]
SHORT = 40  # images: 32 m


def black(frame: Frame) -> Frame:
    return replace(frame, image=np.zeros_like(frame.image))


@pytest.fixture(scope="module")
def short_drive(survey_frames, write_drive, tmp_path_factory) -> Path:
    """The first half of the survey drive."""
    path: Path = write_drive(tmp_path_factory.mktemp("short") / "short.mcap", survey_frames[:SHORT])
    return path


@pytest.fixture(scope="module")
def patchy_drive(survey_frames, write_drive, tmp_path_factory) -> Path:
    """The same, without sight for eight images in the middle."""
    frames = [black(f) if 20 <= i < 28 else f for i, f in enumerate(survey_frames[:SHORT])]
    path: Path = write_drive(tmp_path_factory.mktemp("patchy") / "patchy.mcap", frames)
    return path


def test_help_teaches(fleetmap):
    code, out, _ = fleetmap("map", "--help")
    assert code == 0
    for word in (
        "--output",
        "--trajectory",
        "--gnss",
        "[none|mapping|final|full]",
        "--watch",
        "--budget-mb-per-km",
        "--set",
        "exit code 3",
        "Examples:",
    ):
        assert word in out


# --- one drive


def test_a_survey_drive_becomes_a_map_and_a_trajectory(survey, mapped_survey):
    run = mapped_survey.run
    assert (run.returncode, run.stderr) == (0, "")
    assert (
        f"map:           {mapped_survey.package} (id my_map, EPSG:32632)\nimages posed:  76 of 76, " in run.stdout
    )
    package = open_package(mapped_survey.package)
    assert package.manifest.provenance.drive == "survey.mcap"
    assert package.manifest.quality.publishable
    assert len(package.visual_map().keyframes) == package.manifest.quality.keyframes
    chosen = package.manifest.localizable
    assert chosen is not None
    assert 0.9e5 < chosen.size_bytes <= 1.0e5  # 1 MB/km, and of less than 100 m as if they were
    assert f"cells:         {chosen.size_bytes / 1e6:.2f} MB, {chosen.keyframes} keyframes and" in run.stdout
    covariances = package.localization_map().keyframes.covariances
    assert covariances is not None
    assert np.isfinite(covariances).all()
    trajectory = read_trajectory(mapped_survey.trajectory)
    np.testing.assert_array_equal(trajectory.stamps_ns, survey.truth.stamps_ns // 1000 * 1000)
    assert 0.005 < survey.errors_m(trajectory).mean() < 0.1


def test_a_budget_without_room_is_refused_before_the_work_begins(fleetmap, tmp_path):
    code, out, err = fleetmap("map", "a.mcap", "--output", tmp_path / "map", "--budget-mb-per-km", "0.01")
    assert (code, out) == (2, "")
    assert err.startswith("error: the mapper setting 'cells.budget_mb_per_km' cannot be 0.01")
    assert err.endswith("must be 0 or at least 0.05: keyframes need some room\n")


def test_the_trajectory_is_tum_text_in_utm(mapped_survey):
    zone, *rows = mapped_survey.trajectory.read_text().splitlines()
    assert zone == "# epsg=32632"
    assert len(rows) == 76
    number = r"-?\d+\.\d+"
    assert all(re.fullmatch(rf"\d{{10}}\.\d{{6}}( {number}){{7}}", row) for row in rows)


def test_nothing_but_the_outputs_is_left(mapped_survey):
    assert {path.name for path in mapped_survey.package.parent.iterdir()} == {"my_map", "survey.tum"}


def test_an_existing_output_is_kept_unless_forced(fleetmap, short_drive, tmp_path, map_package):
    before = {path: path.read_bytes() for path in map_package.rglob("*") if path.is_file()}
    trajectory = tmp_path / "old.tum"
    trajectory.write_text("an older one")
    code, out, err = fleetmap("map", short_drive, "--output", map_package, "--trajectory", trajectory)
    assert (code, out) == (2, "")
    assert err == f"error: {map_package} exists already; give another name, or --force to replace it\n"
    assert {path: path.read_bytes() for path in map_package.rglob("*") if path.is_file()} == before
    assert trajectory.read_text() == "an older one"

    code, _, err = fleetmap("map", short_drive, "--output", map_package, "--trajectory", trajectory, "--force")
    assert (code, err) == (0, "")
    assert open_package(map_package).manifest.quality.frames_total == SHORT
    assert len(read_trajectory(trajectory)) == SHORT
    assert {path.name for path in tmp_path.iterdir()} == {map_package.name, "old.tum"}


def test_force_does_not_replace_what_is_no_map(fleetmap, short_drive, tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").write_bytes(b"precious")
    code, _, err = fleetmap("map", short_drive, "--output", tmp_path / "photos", "--force")
    assert code == 2
    assert "photos is not a map package, --force will not replace it" in err
    assert (tmp_path / "photos" / "cat.jpg").read_bytes() == b"precious"


def test_a_map_that_is_unfit_is_written_and_told_with_exit_code_3(fleetmap, patchy_drive, tmp_path):
    arguments = ["--gnss", "final", "--set", "quality.max_unposed_gap_s=0.5"]
    code, out, err = fleetmap("map", patchy_drive, "--output", tmp_path / "patchy", *arguments)
    assert code == 3
    assert "images posed:  32 of 40" in out
    assert err.splitlines() == [
        "warning: only 32 of 40 images could be posed",
        "warning: no image is posed for 0.9 s in mid-drive (limit 0.5 s)",
        "warning: this map should not be published",
    ]
    manifest = open_package(tmp_path / "patchy").manifest
    (weak,) = manifest.quality.weak_stretches
    assert "gap" in [reason.kind for reason in weak.reasons]
    assert 13.0 < weak.from_m < weak.to_m < 25.0  # images 19 to 28 of a drive of 0.8 m an image
    assert not manifest.quality.publishable
    assert manifest.quality.gnss_mode == manifest.provenance.settings["gnss"]["mode"] == "final"


def test_an_antenna_behind_and_to_the_right_is_given_with_a_leading_minus(
    fleetmap, survey, survey_frames, write_drive, tmp_path
):
    arm_in_cam = (0.4, -1.2, -0.7)  # right, down, forward of the camera
    fixes = sample_fixes(survey.truth, RTK, interval_s=0.5, antenna_in_cam_m=arm_in_cam, seed=4)
    path = write_drive(tmp_path / "roof.mcap", survey_frames[:SHORT], fixes=fixes, gnss_frame_id="roof")
    trajectory = tmp_path / "roof.tum"
    arguments = ["map", path, "--output", tmp_path / "m", "--trajectory", trajectory]
    code, _, err = fleetmap(*arguments, "--antenna-offset", "-0.7,-0.4,1.2")  # forward, left, up
    assert (code, err) == (0, "")
    assert 0.005 < survey.errors_m(read_trajectory(trajectory)).mean() < 0.15


def test_a_mask_of_another_size_is_refused_before_anything_is_mapped(fleetmap, short_drive, tmp_path):
    mask, output = tmp_path / "mask.png", tmp_path / "m"
    mask.write_bytes(encode_image(np.full((100, 200), 255, np.uint8), png=True))
    code, out, err = fleetmap("map", short_drive, "--output", output, "--mask", mask)
    assert (code, out) == (2, "")
    assert f"the mask {mask} is 200x100, but the images are 640x320" in err
    assert err.count("\n") == 1
    assert not output.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give a RECORDING and --output FOLDER, or --watch DIR"),
        (["drive.mcap"], "give a RECORDING and --output FOLDER, or --watch DIR"),
        (
            ["drive.mcap", "--output", "m", "--gnss", "some"],
            "'some' is not one of 'none', 'mapping', 'final', 'full'",
        ),
        (["drive.mcap", "--output", "m", "--antenna-offset", "-1,2"], "'-1,2' is not X,Y,Z"),
        (["drive.mcap", "--output", "m", "--seed", "-1"], "-1 is not in the range"),
        (["drive.mcap", "--output", "m", "--server", "tcp/127.0.0.1:7447"], "--server goes with --watch"),
        (["--watch", ".", "--output", "m"], "it takes no recording, output or map id"),
        (["drive.mcap", "--output", "m", "--trajectory", "."], "is a directory"),
        (["drive.mcap", "--output", "m", "--map-id", "Köln 1"], "'Köln 1' cannot be a map id"),
        (["drive.mcap", "--output", "ß"], "no map id can be made of 'ß'; give one with --map-id"),
        (["drive.mcap", "--output", "m", "--set", "quality.posed=1"], "no mapper setting 'quality.posed'"),
        (["drive.mcap", "--output", "m", "--set", "quality.weak_ties=x"], "'quality.weak_ties' cannot be 'x'"),
        (["drive.mcap", "--output", "m"], "there is no recording drive.mcap"),
    ],
)
def test_bad_usage_is_exit_code_2_and_writes_nothing(fleetmap, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    code, out, err = fleetmap("map", *arguments)
    assert (code, out) == (2, "")
    assert message in err.replace("\n", " ")
    assert list(tmp_path.iterdir()) == []


# --- the agent


class Agent:
    """``fleetmap map --watch`` in a process of its own; what it says is gathered as it comes."""

    def __init__(self, folder: Path, server: str) -> None:
        self.said = ""
        self.process = subprocess.Popen(
            [*FLEETMAP, "map", "--watch", str(folder), "--server", server, "--poll-s", "0.2"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.said += line

    def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        code = self.process.wait(timeout=60)
        self._reader.join(timeout=10)
        return code

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(timeout=10)
        self._reader.join(timeout=10)
        assert self.process.stderr is not None
        self.process.stderr.close()


@pytest.fixture
def start_agent() -> Iterator[Callable[[Path, str], Agent]]:
    agents: list[Agent] = []

    def start(folder: Path, server: str) -> Agent:
        agents.append(Agent(folder, server))
        return agents[-1]

    yield start
    for agent in agents:
        agent.kill()


@pytest.fixture
def serve() -> Iterator[Callable[[Path, str], None]]:
    """Starts a server at an endpoint that was free before."""
    servers: list[subprocess.Popen[str]] = []

    def start(store: Path, endpoint: str) -> None:
        arguments = ["serve", "--store", str(store), "--zenoh", endpoint, "--http", "127.0.0.1:0"]
        servers.append(subprocess.Popen([*FLEETMAP, *arguments], stdout=subprocess.PIPE, text=True))
        assert servers[-1].stdout is not None
        assert servers[-1].stdout.readline().startswith("serving ")

    yield start
    for server in servers:
        server.send_signal(signal.SIGINT)
        server.communicate(timeout=20)


def wait_until(condition: Callable[[], Any], agent: Agent, timeout_s: float = 120.0) -> None:
    ends_s = time.monotonic() + timeout_s
    never = threading.Event()
    while not condition():
        assert agent.process.poll() is None, agent.said
        assert time.monotonic() < ends_s, agent.said
        never.wait(0.1)


def test_the_agent_publishes_what_is_dropped_in_and_holds_back_what_is_unfit(
    fleetmap, map_server, start_agent, short_drive, patchy_drive, tmp_path
):
    drives = tmp_path / "drives"
    drives.mkdir()
    agent = start_agent(drives, map_server)
    shutil.copy(patchy_drive, drives / "Patchy Road.mcap")
    shutil.copy(short_drive, drives / "short.mcap")
    (drives / "broken.mcap").write_bytes(short_drive.read_bytes()[:60] + short_drive.read_bytes()[-8:])
    records = {name: drives / ".fleetmap" / f"{name}.mcap.json" for name in ("Patchy Road", "short", "broken")}
    wait_until(lambda: all(path.exists() for path in records.values()), agent)
    assert agent.stop() == 0

    record = {name: json.loads(path.read_text()) for name, path in records.items()}
    assert {name: record[name]["status"] for name in record} == {
        "Patchy Road": "unfit",
        "short": "done",
        "broken": "failed",
    }
    assert record["Patchy Road"]["reason"] == "only 32 of 40 images could be posed"
    assert "no message in it can be read" in record["broken"]["reason"]
    assert "Traceback" not in agent.said
    code, out, _ = fleetmap("maps", "list", "--server", map_server, "--json")
    assert code == 0
    assert [entry["map_id"] for entry in json.loads(out)] == ["short"]
    kept = drives / ".fleetmap" / "maps"
    assert [path.name for path in kept.iterdir()] == ["Patchy Road.mcap"]  # to be looked at; the other was sent
    assert open_package(kept / "Patchy Road.mcap").manifest.map_id == "patchy-road"


def test_a_map_made_while_the_server_is_away_is_sent_when_it_comes_and_not_made_again(
    fleetmap, absent_server, start_agent, serve, short_drive, tmp_path
):
    drives = tmp_path / "drives"
    drives.mkdir()
    shutil.copy(short_drive, drives / "short.mcap")
    agent = start_agent(drives, absent_server)
    wait_until(lambda: "will be tried again" in agent.said, agent)
    record, package = drives / ".fleetmap" / "short.mcap.json", drives / ".fleetmap" / "maps" / "short.mcap"
    assert not record.exists()
    version = manifest_version((package / "manifest.json").read_bytes())
    serve(tmp_path / "store", absent_server)
    wait_until(record.exists, agent)
    assert agent.stop() == 0
    (entry,) = json.loads(fleetmap("maps", "list", "--server", absent_server, "--json")[1])
    assert entry["version"] == version
    assert not package.exists()
