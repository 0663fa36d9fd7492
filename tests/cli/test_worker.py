"""``fleetmap worker`` as a user runs it; jobs that are mapped to the end are in tests/end_to_end."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fleetmap.jobs import DriveEntry, JobEntry
from fleetmap.transport import MapClient

PARTIAL = "drives/.new.mcap.part"
FLEETMAP = [sys.executable, "-c", "from fleetmap_cli.main import main; main()"]


def start_worker(*arguments: object) -> subprocess.Popen[str]:
    command = [*FLEETMAP, "worker", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def queue_drive(server: str, recording: Path) -> tuple[DriveEntry, JobEntry]:
    sha256 = hashlib.sha256(recording.read_bytes()).hexdigest()
    with MapClient(server) as client:
        sent = client.upload_drive(recording, sha256, map_id="karlsruhe")
    assert sent.job is not None
    return sent.drive, sent.job


def test_a_drive_that_is_not_good_enough_fails_its_job_with_the_reasons(
    fleetmap, map_server, survey_frames, write_drive, tmp_path
):
    drive, job = queue_drive(map_server, write_drive(tmp_path / "poor.mcap", survey_frames[:4], fixes=()))
    folder = tmp_path / "work"
    code, out, err = fleetmap("worker", "--once", "--server", map_server, "--folder", folder)
    assert (code, out) == (0, "")
    assert err.splitlines()[0] == f"job {job.job_id[:12]}: map 'karlsruhe' of poor.mcap, attempt 1"
    with MapClient(map_server) as client:
        ended, checked = client.job(job.job_id), client.drive(drive.sha256)
    assert ended.state == "failed"
    assert ended.reason.startswith("the drive is not good enough to map: GNSS: ")
    assert ended.reason in err
    assert checked.summary is not None
    assert (checked.state, checked.summary.verdict) == ("checked", "no")
    assert [path for path in folder.rglob("*") if path.is_file()] == [folder / "worker.lock"]


def test_a_worker_without_a_job_clears_what_a_killed_one_left_but_for_recordings_that_may_be_wanted(
    fleetmap, map_server, tmp_path
):
    folder = tmp_path / "work"
    for name, age_s in (("maps/0123-1/manifest.json", 0), ("drives/old.mcap", 8 * 86_400), (PARTIAL, 86_400)):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("left")
        os.utime(path, (time.time() - age_s,) * 2)
    assert fleetmap("worker", "--once", "--server", map_server, "--folder", folder) == (0, "", "")
    assert {path for path in folder.rglob("*") if path.is_file()} == {folder / "worker.lock", folder / PARTIAL}


def test_a_worker_waits_for_a_server_that_is_away_and_says_so_once(absent_server, start_server, tmp_path):
    with start_worker("--once", "--server", absent_server, "--folder", tmp_path / "work") as worker:
        assert worker.stderr is not None
        first = worker.stderr.readline()
        assert first.startswith(f"no map server answers at {absent_server}; ")
        assert first.endswith("will be tried again\n")
        start_server(tmp_path / "store", absent_server)
        _, rest = worker.communicate(timeout=30)
    assert (worker.returncode, rest) == (0, "the map server answers again\n")


def test_a_folder_has_one_worker(fleetmap, absent_server, tmp_path):
    folder = tmp_path / "work"
    with start_worker("--server", absent_server, "--folder", folder) as first:
        assert first.stderr is not None
        first.stderr.readline()  # it works, and waits for its server
        code, out, err = fleetmap("worker", "--once", "--server", absent_server, "--folder", folder)
        assert (code, out) == (1, "")
        assert err == f"error: another worker works in {folder}; give each a --folder of its own\n"
        first.terminate()
        assert first.wait(20) == 0


def test_a_server_that_forbids_ends_the_worker(fleetmap, absent_server, start_server, tmp_path):
    access = tmp_path / "access"
    access.write_text("read *\n")
    start_server(tmp_path / "store", absent_server, "--access", str(access))
    code, out, err = fleetmap("worker", "--server", absent_server, "--folder", tmp_path / "work")
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "token" in err


@pytest.mark.parametrize("assignment", ["quality.min_posed_ratio", "nothing.like_this=1"])
def test_a_wrong_setting_is_bad_input_before_any_job_is_taken(fleetmap, tmp_path, assignment):
    code, out, err = fleetmap("worker", "--set", assignment, "--folder", tmp_path / "work")
    assert (code, out, err.count("\n")) == (2, "", 1)
