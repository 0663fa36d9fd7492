"""``fleetmap upload`` as a user types it, to servers in other processes that may die."""

from __future__ import annotations

import hashlib
import json
import subprocess
import threading

import pytest

from fleetmap.transport import MapClient


@pytest.fixture
def poor_drive(survey_frames, write_drive, tmp_path):
    """A recording that can be read, and has no GNSS fixes."""
    return write_drive(tmp_path / "Short Trip.mcap", survey_frames[60:64], fixes=())


def test_a_drive_that_is_not_good_enough_is_refused_with_the_reasons_and_sent_by_force(
    fleetmap, poor_drive, shared_server
):
    at = ["--server", shared_server]
    sha256 = hashlib.sha256(poor_drive.read_bytes()).hexdigest()
    code, out, err = fleetmap("upload", poor_drive, *at)
    assert (code, out) == (2, "")
    assert err.startswith(f"error: {poor_drive} is not good enough to map: ")
    assert "GNSS: " in err
    assert fleetmap("drives", "list", *at)[1].count(sha256[:12]) == 0

    code, out, err = fleetmap("upload", poor_drive, "--force", *at)
    assert (code, err) == (0, "")
    drive, job = out.splitlines()
    assert drive.split()[:2] == ["drive", sha256]
    assert job.endswith("map short-trip, queued")
    listed = json.loads(fleetmap("drives", "show", sha256, "--json", *at)[1])
    assert listed["summary"]["verdict"] == "no"
    assert [found["map_id"] for found in listed["jobs"]] == ["short-trip"]


def test_the_same_drive_twice_is_one_drive_and_one_job(
    fleetmap, poor_drive, survey_frames, write_drive, shared_server
):
    arguments = ["--force", "--map-id", "twice", "--server", shared_server]
    recording = write_drive(poor_drive.with_name("first.mcap"), survey_frames[50:54])
    first = fleetmap("upload", recording, *arguments)[1].splitlines()
    copy = recording.rename(recording.with_name("second.mcap"))
    again = fleetmap("upload", copy, *arguments)[1].splitlines()
    assert again[0] == f"{first[0]} (the server had it already, as first.mcap)"
    assert again[1] == first[1]
    listed = json.loads(fleetmap("drives", "list", "--json", "--server", shared_server)[1])
    assert [drive["name"] for drive in listed if drive["sha256"] == first[0].split()[1]] == ["first.mcap"]
    fleetmap("jobs", "cancel", first[1].split()[1], "--server", shared_server)


def test_a_drive_may_be_kept_without_a_map(fleetmap, survey_frames, write_drive, tmp_path, shared_server):
    recording = write_drive(tmp_path / "kept.mcap", survey_frames[40:44])
    code, out, _ = fleetmap("upload", recording, "--force", "--no-map", "--server", shared_server)
    assert (code, out.count("\n")) == (0, 1)
    listed = json.loads(fleetmap("drives", "show", out.split()[1], "--json", "--server", shared_server)[1])
    assert listed["jobs"] == []


def test_waiting_for_a_job_that_comes_to_nothing_is_an_error_with_its_reason(
    fleetmap, survey_frames, write_drive, tmp_path, shared_server
):
    recording = write_drive(tmp_path / "cancelled.mcap", survey_frames[30:34])
    sha256 = hashlib.sha256(recording.read_bytes()).hexdigest()
    with MapClient(shared_server) as client:
        job = client.upload_drive(recording, sha256, map_id="cancelled").job
        assert job is not None
        client.cancel_job(job.job_id)
        waiting = ["upload", recording, "--force", "--wait", "--map-id", "cancelled", "--server", shared_server]
        again = threading.Timer(0.0, lambda: cancel_next(client, sha256, job.job_id))
        again.start()
        code, out, err = fleetmap(*waiting)
        again.join()
    assert (code, out.count("\n")) == (1, 2)
    assert err.endswith(" was cancelled: cancelled\n")


def cancel_next(client: MapClient, drive: str, other_than: str) -> None:
    """Cancel the next job of a drive as soon as there is one."""
    found: list[str] = []
    while not found:
        found = [job.job_id for job in client.jobs(drive=drive) if job.job_id != other_than]
    client.cancel_job(found[0])


@pytest.mark.parametrize("contents", [b"", b"no recording", b"\x89MCAP0\r\n\x89MCAP0\r\n"])
def test_what_is_no_recording_is_bad_input(fleetmap, tmp_path, shared_server, contents):
    path = tmp_path / "broken.mcap"
    path.write_bytes(contents)
    code, out, err = fleetmap("upload", path, "--server", shared_server)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "broken.mcap" in err


def test_an_absent_server_is_told_before_the_drive_is_looked_at(fleetmap, tmp_path, absent_server):
    code, out, err = fleetmap("upload", tmp_path / "absent.mcap", "--server", absent_server)
    assert (code, out) == (1, "")
    assert err.startswith(f"error: no map server answers at {absent_server}; ")


@pytest.mark.parametrize("arguments", [["--no-map", "--wait"], ["--no-map", "--map-id", "x"], ["--map-id", "A b"]])
def test_options_that_contradict_are_usage_errors(fleetmap, tmp_path, arguments):
    code, out, _ = fleetmap("upload", tmp_path / "any.mcap", *arguments)
    assert (code, out) == (2, "")


class InterruptedUploadError(Exception):
    pass


def test_an_upload_goes_on_where_it_was_cut_whoever_died(survey, tmp_path, absent_server, start_server):
    sha256 = hashlib.sha256(survey.recording.read_bytes()).hexdigest()
    size_bytes = survey.recording.stat().st_size
    server = start_server(tmp_path / "store", absent_server)
    seen: list[int] = []

    def die_after_two_chunks(done_bytes: int, total_bytes: int) -> None:
        seen.append(done_bytes)
        if len(set(seen)) == 3:  # of two chunks under way the second may come first, and be sent again
            raise InterruptedUploadError

    with MapClient(absent_server) as client, pytest.raises(InterruptedUploadError):
        client.upload_drive(survey.recording, sha256, progress=die_after_two_chunks)
    assert seen == sorted(seen)
    assert 0 == seen[0] < seen[-1] < size_bytes

    servers: list[subprocess.Popen[str]] = []

    def kill_server(done_bytes: int, total_bytes: int) -> None:
        if resumed and done_bytes < total_bytes and not servers:
            server.kill()
            servers.append(start_server(tmp_path / "store", absent_server))
        resumed.append(done_bytes)

    resumed: list[int] = []
    with MapClient(absent_server) as client:
        committed = client.upload_drive(survey.recording, sha256, progress=kill_server)
        assert servers
        assert seen[-1] <= resumed[0] < size_bytes  # what was on its way may have arrived
        assert resumed[-1] == size_bytes
        assert committed.drive.sha256 == sha256
        client.download_drive(committed.drive, tmp_path / "back.mcap")
    assert (tmp_path / "back.mcap").read_bytes() == survey.recording.read_bytes()
