"""The process that checks and maps a drive: what it tells, and how it ends."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fleetmap.geodesy import UtmGrid
from fleetmap.jobs import MAX_SUMMARY_BYTES
from fleetmap_cli.drive_summary import summarise_drive
from fleetmap_cli.mapping_process import Failed, MappingProcess, MappingTask, Message, mapping_process
from fleetmap_mapper.settings import MapperSettings


@pytest.fixture
def task(survey, tmp_path: Path) -> MappingTask:
    return MappingTask(survey.recording, "survey.mcap", tmp_path / "map", "karlsruhe", MapperSettings())


def messages(child: MappingProcess) -> Iterator[Message]:
    end_s = time.monotonic() + 60.0
    while time.monotonic() < end_s:
        if (message := child.next_message(1.0)) is not None:
            yield message
    raise AssertionError("the child says nothing")


def is_alive(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def test_a_summary_says_what_info_says_and_where_it_was_driven(
    survey, survey_frames, write_drive, tmp_path, fleetmap
):
    recording = write_drive(tmp_path / "part.mcap", survey_frames[:20])
    summary = summarise_drive(recording, lambda stage, done, total: None)
    _, out, _ = fleetmap("info", recording, "--json")
    told = json.loads(out)
    assert (summary.verdict, summary.reasons) == (told["verdict"], told["summary"])
    assert [finding.aspect for finding in summary.findings] == [finding["aspect"] for finding in told["findings"]]
    assert summary.start_ns == told["start_ns"] == survey.truth.stamps_ns[0]
    assert summary.end_ns == pytest.approx(survey_frames[19].stamp_ns, abs=1000)
    lon_deg, lat_deg = np.array(summary.trajectory_lonlat).T
    driven_m = UtmGrid(survey.truth.epsg).from_geodetic(lat_deg, lon_deg, np.zeros(len(lat_deg)))[:, :2]
    gaps_m = [np.linalg.norm(survey.truth.positions_m[:, :2] - place, axis=1).min() for place in driven_m]
    assert max(gaps_m) < 3.0
    assert len(summary.model_dump_json()) < MAX_SUMMARY_BYTES


def test_a_recording_that_cannot_be_read_is_the_drives_fault(task, tmp_path):
    other = tmp_path / "other.mcap"
    other.write_text("no recording")
    with mapping_process(MappingTask(other, "other", task.output, "karlsruhe", task.settings)) as child:
        failed = next(messages(child))
    assert isinstance(failed, Failed)
    assert not failed.is_own_fault
    assert "other.mcap" in failed.reason


def test_a_child_that_is_killed_ends_as_a_failure_and_not_as_silence(task):
    with mapping_process(task) as child:
        told = messages(child)
        next(told)
        os.kill(child.pid, signal.SIGKILL)
        last = next(message for message in told if isinstance(message, Failed))
    assert "SIGKILL" in last.reason
    assert not task.output.exists()


PARENT = """
import sys
from pathlib import Path
from fleetmap_cli.mapping_process import Checked, Failed, MappingTask, mapping_process
from fleetmap_mapper.settings import MapperSettings

task = MappingTask(Path(sys.argv[1]), "survey.mcap", Path(sys.argv[2]), "karlsruhe", MapperSettings())
with mapping_process(task) as child:
    while not isinstance(message := child.next_message(1.0), Checked):
        assert not isinstance(message, Failed), message
    print(child.pid, flush=True)
    sys.stdin.read()
"""


def test_the_child_of_a_killed_parent_is_gone_at_once(task):
    command = [sys.executable, "-c", PARENT, str(task.recording), str(task.output)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        assert is_alive(child)
        parent.kill()
        end_s = time.monotonic() + 10.0
        while is_alive(child):
            assert time.monotonic() < end_s, "it lives on"
            time.sleep(0.01)
    assert not task.output.exists()
