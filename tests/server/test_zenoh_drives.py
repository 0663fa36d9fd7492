"""Survey drives and jobs, spoken over Zenoh: sent, taken, mapped, given back, and published once."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest
from mcap.writer import Writer

from fleetmap.errors import ConflictError, InputError, JobLostError, ServerRefusedError
from fleetmap.jobs import DriveFinding, DriveSummary
from fleetmap.transport import MapClient

SUMMARY = DriveSummary(
    verdict="yes, with warnings",
    findings=(DriveFinding(aspect="image rate", severity="good", text="10 images/s; one every 0.8 m"),),
    start_ns=1_000_000_000,
    end_ns=61_000_000_000,
    trajectory_lonlat=((8.40, 49.00), (8.41, 49.01)),
    length_m=800.0,
    image_count=600,
)


@pytest.fixture
def recording(tmp_path) -> Path:
    """Somewhat longer than two pieces of an upload."""
    path = tmp_path / "street; rain=100 %|ü.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start()
        channel = writer.register_channel("/camera", "json", writer.register_schema("text", "jsonschema", b"{}"))
        for number in range(20):
            stamp_ns = 1_000_000_000 * (1 + number)
            writer.add_message(channel, stamp_ns, hashlib.shake_128(bytes([number])).digest(100_000), stamp_ns)
        writer.finish()
    return path


@pytest.fixture
def client(server):
    with MapClient(server.zenoh_endpoint) as client:
        yield client


def sha256_of(recording: Path) -> str:
    return hashlib.sha256(recording.read_bytes()).hexdigest()


def test_a_drive_is_sent_listed_and_fetched_again(client, recording, tmp_path):
    sha256, seen = sha256_of(recording), []
    sent = client.upload_drive(
        recording,
        sha256,
        map_id="street",
        summary=SUMMARY,
        progress=lambda done, total: seen.append((done, total)),
    )
    size_bytes = recording.stat().st_size
    assert (seen[0], seen[-1]) == ((0, size_bytes), (size_bytes, size_bytes))
    assert (sent.drive.name, sent.drive.summary, sent.drive.state) == (recording.name, SUMMARY, "received")
    assert sent.job is not None
    assert (sent.job.drive, sent.job.map_id, sent.job.state) == (sha256, "street", "queued")

    assert client.drives() == client.drives(sha256[:8]) == [client.drive(sha256)] == [sent.drive]
    assert client.drives(area_lonlat=(8.39, 48.99, 8.42, 49.02), from_ns=60_000_000_000) == [sent.drive]
    assert client.drives(area_lonlat=(9.0, 48.99, 9.1, 49.02)) == client.drives(from_ns=62_000_000_000) == []
    with pytest.raises(InputError, match="has 0 drives"):
        client.drive("0" * 64)

    client.download_drive(sent.drive, tmp_path / "fetched.mcap")
    assert (tmp_path / "fetched.mcap").read_bytes() == recording.read_bytes()
    again = client.upload_drive(recording, sha256, name="other.mcap", map_id="street")
    assert again == sent


def test_a_job_is_taken_reported_given_back_and_ends_with_one_version(client, recording, make_map):
    sha256 = sha256_of(recording)
    sent = client.upload_drive(recording, sha256, map_id="karlsruhe")
    assert sent.job is not None
    first = client.take_job("worker:1")
    assert first is not None
    assert client.take_job("worker:1") == first.model_copy(update=_times(client, first.job_id))
    assert client.take_job("worker:2") is None

    checked = SUMMARY.model_copy(update={"reasons": "all; is=well|really, 100 %"})
    told = client.report_job(first.job_id, first.fence, "tracking; 1=1", 40, checked)
    assert (told.stage, told.percent, told.cancel_requested) == ("tracking; 1=1", 40, False)
    assert client.drive(sha256).summary == checked
    assert client.drive(sha256).state == "checked"
    assert client.finish_job(first.job_id, first.fence, give_back=True).state == "queued"

    second = client.take_job("worker:2")
    assert second is not None
    assert (second.fence > first.fence, second.attempts) == (True, 1)
    with pytest.raises(JobLostError, match="taken over by 'worker:2'"):
        client.report_job(first.job_id, first.fence, "late", 99)
    one = make_map(part_sizes=(1000,))
    with pytest.raises(JobLostError):
        client.publish(one.manifest_bytes, one.parts.__getitem__, job=first)
    assert client.list_maps() == []
    assert client.publish(one.manifest_bytes, one.parts.__getitem__, job=second).version == one.version
    done = client.job(first.job_id)
    assert (done.state, done.version, client.jobs(state="done", drive=sha256)) == ("done", one.version, [done])
    assert client.jobs(state="queued") == []
    with pytest.raises(ConflictError, match="is done"):
        client.cancel_job(done.job_id)


def _times(client: MapClient, job_id: str) -> dict[str, int]:
    job = client.job(job_id)
    return {"lease_until_ns": job.lease_until_ns, "updated_ns": job.updated_ns}


def test_a_job_is_cancelled_and_tried_again_and_fails_with_its_reason(client, recording):
    sent = client.upload_drive(recording, sha256_of(recording), map_id="street")
    assert sent.job is not None
    job_id = sent.job.job_id
    assert client.cancel_job(job_id).state == "cancelled"
    assert client.retry_job(job_id).state == "queued"
    job = client.take_job("worker:1")
    assert job is not None
    assert client.cancel_job(job_id).cancel_requested
    assert client.report_job(job_id, job.fence, "mapping", 1).cancel_requested
    assert client.finish_job(job_id, job.fence).state == "cancelled"
    client.retry_job(job_id)
    job = client.take_job("worker:1")
    assert job is not None
    failed = client.finish_job(job_id, job.fence, "no GNSS; nothing to be done = sad | ü 100 %")
    assert (failed.state, failed.reason) == ("failed", "no GNSS; nothing to be done = sad | ü 100 %")
    with pytest.raises(ServerRefusedError, match="has no job 0123456789abcdef"):
        client.job("0123456789abcdef")


def test_what_is_no_recording_is_refused_and_not_listed(client, tmp_path):
    fake = tmp_path / "fake.mcap"
    fake.write_bytes(json.dumps({"not": "a recording"}).encode() * 100)
    with pytest.raises(ServerRefusedError, match="MCAP"):
        client.upload_drive(fake, sha256_of(fake), map_id="street")
    assert (client.drives(), client.jobs()) == ([], [])
    with pytest.raises(InputError, match="its name or length is no drive's"):
        client.upload_drive(fake, sha256_of(fake), name="folder/fake.mcap")
    with pytest.raises(InputError, match=r"cannot read .*absent"):
        client.upload_drive(tmp_path / "absent.mcap", "0" * 64)
