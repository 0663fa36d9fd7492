"""``fleetmap jobs`` as a user types it, of a server in another process."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable

import pytest

from fleetmap.transport import MapClient


@pytest.fixture
def jobs(fleetmap, shared_server: str) -> Callable[..., tuple[int, str, str]]:
    def call(verb: str, *arguments: object) -> tuple[int, str, str]:
        return fleetmap("jobs", verb, *arguments, "--server", shared_server)

    return call


@pytest.fixture
def queue_job(survey_frames, write_drive, tmp_path, shared_server: str) -> Callable[[str], str]:
    """Has a small drive mapped under a name; the job's id."""

    def queue(map_id: str) -> str:
        recording = write_drive(tmp_path / "drive.mcap", survey_frames[:2])
        sha256 = hashlib.sha256(recording.read_bytes()).hexdigest()
        with MapClient(shared_server) as client:
            job = client.upload_drive(recording, sha256, map_id=map_id).job
        assert job is not None
        return job.job_id

    return queue


def row_of(listed: tuple[int, str, str], job_id: str) -> str | None:
    return next((line for line in listed[1].splitlines() if line.startswith(job_id)), None)


def test_a_job_is_listed_cancelled_and_repeated(jobs, queue_job):
    job_id = queue_job("cancelled-map")
    assert row_of(jobs("list"), job_id).split()[1:3] == ["queued", "cancelled-map"]
    assert jobs("cancel", job_id) == (0, f"job {job_id}: cancelled\n", "")
    assert row_of(jobs("list", "--state", "queued"), job_id) is None
    assert row_of(jobs("list", "--state", "cancelled"), job_id).split()[1] == "cancelled"
    assert jobs("retry", job_id) == (0, f"job {job_id}: queued\n", "")
    assert jobs("cancel", job_id)[0] == 0


def test_a_running_job_tells_its_stage_and_is_cancelled_by_asking_its_worker(jobs, queue_job, shared_server):
    job_id = queue_job("running-map")
    with MapClient(shared_server) as client:
        while (job := client.take_job("tester")) is not None and job.job_id != job_id:
            client.finish_job(job.job_id, job.fence, "it is in the way")
        assert job is not None
        client.report_job(job_id, job.fence, "tracking", 43)
        assert "  running: tracking 43 %  running-map  " in row_of(jobs("list"), job_id)
        assert jobs("cancel", job_id) == (0, f"job {job_id}: being cancelled\n", "")
        assert "  being cancelled  " in row_of(jobs("list"), job_id)
        assert client.report_job(job_id, job.fence, "tracking", 44).cancel_requested
        client.finish_job(job_id, job.fence, give_back=True)
    (entry,) = (job for job in json.loads(jobs("list", "--json")[1]) if job["job_id"] == job_id)
    assert (entry["state"], entry["attempts"], entry["worker"]) == ("cancelled", 1, "tester")


@pytest.mark.parametrize("verb", ["cancel", "retry"])
@pytest.mark.parametrize(
    ("job_id", "code", "complaint"), [("first", 2, "is no job"), ("0" * 16, 1, "has no job 0000000000000000")]
)
def test_a_job_that_is_not_there_is_one_line(jobs, verb, job_id, code, complaint):
    found_code, out, err = jobs(verb, job_id)
    assert (found_code, out, err.count("\n")) == (code, "", 1)
    assert complaint in err
