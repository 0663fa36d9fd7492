"""Drives sent over HTTP by tus: whole, once, and from where it stopped whoever died."""

from __future__ import annotations

import base64
import hashlib
import io
import socket
import time
from urllib.parse import urlsplit

import httpx
import pytest
from mcap.writer import CompressionType, Writer
from tusclient.client import TusClient
from tusclient.exceptions import TusCommunicationError

from fleetmap_server.access import Access, Caller, Role
from fleetmap_server.http.app import create_app
from fleetmap_server.http.drive_uploads import PIECE_BYTES
from fleetmap_server.library import open_library

on_one_database = pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)  # it concerns HTTP alone
TUS = {"Tus-Resumable": "1.0.0"}
MB = 1_000_000


def recording(size_bytes: int = 300_000, seed: str = "monday") -> bytes:
    file = io.BytesIO()
    writer = Writer(file, chunk_size=100_000, compression=CompressionType.NONE)
    writer.start(profile="ros2", library="a recorder")
    schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"uint8[] data")
    channel = writer.register_channel("/camera", "cdr", schema)
    data = hashlib.shake_128(seed.encode()).digest(size_bytes)
    for number, begin in enumerate(range(0, size_bytes, 50_000)):
        stamp_ns = 1_700_000_000_000_000_000 + number * 100_000_000
        writer.add_message(channel, stamp_ns, data[begin : begin + 50_000], stamp_ns)
    writer.finish()
    return file.getvalue()


DRIVE = recording()


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def metadata(**values: str) -> str:
    return ",".join(f"{key} {base64.b64encode(value.encode()).decode()}".strip() for key, value in values.items())


def begin(web: httpx.Client, data: bytes = DRIVE, **values: str) -> httpx.Response:
    values = {"sha256": sha256(data), "filename": "Monday Drive.mcap"} | values
    headers = {**TUS, "Upload-Length": str(len(data)), "Upload-Metadata": metadata(**values)}
    return web.post("/drives/uploads", headers=headers)


def send(web: httpx.Client, url: str, offset: int, data: bytes, **headers: str) -> httpx.Response:
    told = {"Upload-Offset": str(offset), "Content-Type": "application/offset+octet-stream", **TUS}
    return web.patch(url, headers=told | headers, content=data)


def offset_of(web: httpx.Client, url: str) -> int:
    answer = web.head(url, headers=TUS)
    assert answer.status_code == 200
    return int(answer.headers["upload-offset"])


def uploader(base_url: str, data: bytes, **options):
    client = TusClient(f"{base_url}/drives/uploads")
    told = {"sha256": sha256(data), "filename": "Monday Drive.mcap"}
    return client.uploader(file_stream=io.BytesIO(data), metadata=told, **({"chunk_size": 100_000} | options))


def jobs_of(web: httpx.Client, data: bytes = DRIVE) -> list[tuple[str, str]]:
    jobs = web.get("/jobs", params={"drive": sha256(data)}).json()["jobs"]
    return [(job["map_id"], job["state"]) for job in jobs]


def address(web: httpx.Client) -> str:
    return str(web.base_url).rstrip("/")


def test_a_drive_arrives_by_another_tus_client_and_is_queued(web, library):
    uploader(address(web), DRIVE).upload()
    drive = library.drives.get(sha256(DRIVE))
    assert (drive.name, drive.size_bytes, drive.state) == ("Monday Drive.mcap", len(DRIVE), "received")
    assert drive.end_ns - drive.start_ns == 500_000_000
    assert web.get(f"/blobs/{drive.sha256}").content == DRIVE
    assert jobs_of(web) == [("monday-drive", "queued")]


def test_the_same_drive_twice_is_one_drive_with_one_job(web, library):
    uploader(address(web), DRIVE).upload()
    again = begin(web, filename="copy.mcap", map_id="monday-drive")
    assert (again.status_code, again.headers["upload-offset"]) == (201, str(len(DRIVE)))
    uploader(address(web), DRIVE, retries=1, retry_delay=0).upload()
    assert library.drives.count() == 1
    assert library.drives.get(sha256(DRIVE)).name == "Monday Drive.mcap"
    assert jobs_of(web) == [("monday-drive", "queued")]


def test_the_last_answer_says_where_to_look(web):
    url = begin(web, map_id="town").headers["location"]
    assert send(web, url, 0, DRIVE[:1000]).headers["upload-offset"] == "1000"
    assert "link" not in web.head(url, headers=TUS).headers
    answer = send(web, url, 1000, DRIVE[1000:])
    assert (answer.status_code, answer.headers["upload-offset"]) == (204, str(len(DRIVE)))
    assert answer.headers["tus-resumable"] == "1.0.0"
    drive, job = (link["url"] for link in answer.links.values())
    assert drive.endswith(f"/collections/drives/items/{sha256(DRIVE)}")
    assert web.get(job).json()["map_id"] == "town"
    assert offset_of(web, url) == len(DRIVE)


@on_one_database
def test_a_drive_that_is_not_to_be_mapped_has_no_job(web):
    url = begin(web, map_id="").headers["location"]
    assert send(web, url, 0, DRIVE).status_code == 204
    assert jobs_of(web) == []


@on_one_database
@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (DRIVE[:-1], "damaged at byte"),
        (DRIVE + b"!", "1 bytes follow"),
        (b"#ROSBAG V2.0\n" + bytes(1000), "no MCAP recording"),
    ],
    ids=["cut", "padded", "foreign"],
)
def test_what_is_no_recording_is_refused_and_thrown_away(web, library, content, reason):
    url = begin(web, content).headers["location"]
    send(web, url, 0, content[:500])
    answer = send(web, url, 500, content[500:])
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert reason in answer.json()["detail"]
    assert web.head(url, headers=TUS).status_code == 404
    assert library.drives.count() == 0


@on_one_database
def test_bytes_with_another_hash_are_thrown_away_and_the_right_ones_taken(web, library):
    wrong = bytearray(DRIVE)
    wrong[len(wrong) // 2] ^= 1
    url = begin(web).headers["location"]
    answer = send(web, url, 0, bytes(wrong))
    assert (answer.status_code, answer.headers["tus-resumable"]) == (422, "1.0.0")
    assert "other bytes than its name says" in answer.json()["detail"]
    assert web.head(url, headers=TUS).status_code == 404
    uploader(address(web), DRIVE).upload()
    assert library.drives.count() == 1


@on_one_database
def test_only_the_next_bytes_are_taken(web):
    url = begin(web).headers["location"]
    send(web, url, 0, DRIVE[:1000])
    for offset in (0, 999, 1001):
        answer = send(web, url, offset, DRIVE[offset:])
        assert (answer.status_code, answer.headers["upload-offset"]) == (409, "1000")
    assert send(web, url, 1000, DRIVE[1000:] + b"more").status_code == 413
    assert offset_of(web, url) == 1000


@on_one_database
def test_bytes_are_compared_with_their_checksum_before_any_is_kept(web):
    def checksum(algorithm: str, data: bytes) -> str:
        return f"{algorithm} {base64.b64encode(hashlib.new(algorithm, data).digest()).decode()}"

    url = begin(web).headers["location"]
    wrong = send(web, url, 0, DRIVE[:1000], **{"Upload-Checksum": checksum("sha256", DRIVE[1:1001])})
    assert wrong.status_code == 460
    for unknown in ("md5 AAAA", "sha256 !!", "sha256"):
        assert send(web, url, 0, DRIVE[:1000], **{"Upload-Checksum": unknown}).status_code in (400, 460)
    assert offset_of(web, url) == 0
    for offset, algorithm in ((0, "sha256"), (1000, "sha1")):
        piece = DRIVE[offset : offset + 1000]
        right = send(web, url, offset, piece, **{"Upload-Checksum": checksum(algorithm, piece)})
        assert (right.status_code, right.headers["upload-offset"]) == (204, str(offset + 1000))


@on_one_database
def test_requests_that_do_not_hold_are_told_why(web):
    def told(**headers: str) -> tuple[int, str]:
        answer = web.post("/drives/uploads", headers=headers)
        return answer.status_code, answer.json()["detail"]

    length = {"Upload-Length": "1000"}
    status, detail = told(**TUS, **length, **{"Upload-Metadata": metadata(filename="a.mcap")})
    assert status == 400
    assert "lacks 'sha256'" in detail
    named = {"Upload-Metadata": metadata(sha256=sha256(DRIVE))}
    assert told(**length, **named)[0] == 412
    assert told(**{"Tus-Resumable": "0.2.2"}, **length, **named)[0] == 412
    assert told(**TUS, **named)[0] == 400
    for wrong in ("sha256 ???", metadata(sha256="abc"), metadata(sha256=sha256(DRIVE), filename="../x.mcap")):
        assert told(**TUS, **length, **{"Upload-Metadata": wrong})[0] == 400
    url = begin(web).headers["location"]
    assert send(web, url, 0, DRIVE, **{"Content-Type": "application/octet-stream"}).status_code == 415
    assert send(web, f"/drives/uploads/{64 * '0'}", 0, DRIVE).status_code == 404
    assert web.options("/drives/uploads").headers["tus-extension"] == "creation,checksum,termination,expiration"


def test_an_upload_can_be_given_up_until_it_is_a_drive(web):
    url = begin(web).headers["location"]
    send(web, url, 0, DRIVE[:1000])
    assert "GMT" in web.head(url, headers=TUS).headers["upload-expires"]
    assert web.delete(url, headers=TUS).status_code == 204
    assert web.head(url, headers=TUS).status_code == 404
    with pytest.raises(TusCommunicationError):
        TusClient(address(web)).uploader(file_stream=io.BytesIO(DRIVE), url=url)
    uploader(address(web), DRIVE, retries=1, retry_delay=0).upload()
    assert web.delete(url, headers=TUS).status_code == 409


def test_jobs_are_listed_cancelled_and_tried_again(web, library):
    uploader(address(web), DRIVE).upload()
    (job,) = web.get("/jobs").json()["jobs"]
    path = f"/jobs/{job['job_id']}"
    assert web.get(path).json() == job
    assert web.post(f"{path}/cancel").json()["state"] == "cancelled"
    assert web.get("/jobs", params={"state": "queued"}).json()["jobs"] == []
    assert web.post(f"{path}/retry").json()["state"] == "queued"
    taken = library.jobs.take("one")
    library.jobs.finish(taken.job_id, taken.fence, "no GNSS")
    assert web.get(path).json()["reason"] == "no GNSS"
    assert web.post(f"{path}/cancel").status_code == 409
    assert web.get("/jobs/0123456789abcdef").status_code == 404
    assert web.get("/jobs/x").status_code == 400
    assert web.delete(f"/drives/{sha256(DRIVE)}").status_code == 204
    assert web.get(f"/blobs/{sha256(DRIVE)}").status_code == 404
    assert web.post(f"{path}/retry").status_code == 404


def test_a_drive_whose_server_died_before_listing_it_is_listed_when_asked_for(web, library):
    url = begin(web, map_id="town").headers["location"]
    library.reception.receive(sha256(DRIVE), len(DRIVE), 0, DRIVE)
    assert library.drives.count() == 0
    assert offset_of(web, url) == len(DRIVE)
    assert library.drives.get(sha256(DRIVE)).size_bytes == len(DRIVE)
    assert jobs_of(web) == [("town", "queued")]
    library.jobs.cancel(library.jobs.page().jobs[0].job_id)
    assert offset_of(web, url) == len(DRIVE)
    assert jobs_of(web) == [("town", "cancelled")]  # to ask once more is no wish for another map


@on_one_database
def test_what_came_as_something_else_is_looked_at_before_it_is_a_drive(web, library):
    for data in (DRIVE, b"no recording"):
        library.blobs.append(sha256(data), len(data), 0, data)
    assert begin(web).headers["upload-offset"] == str(len(DRIVE))
    assert library.drives.get(sha256(DRIVE)).start_ns == 1_700_000_000_000_000_000
    answer = begin(web, b"no recording")
    assert answer.status_code == 422
    assert "no MCAP recording" in answer.json()["detail"]
    assert web.head(f"/drives/uploads/{sha256(b'no recording')}", headers=TUS).status_code == 404


@pytest.mark.parametrize("database_url", ["postgresql"], indirect=True)
def test_another_server_of_the_fleet_goes_on(library, web, serving):
    url = begin(web).headers["location"]
    send(web, url, 0, DRIVE[:100_000])
    with (
        open_library(library.settings) as second,
        serving(create_app(second)) as base_url,
        httpx.Client(base_url=base_url) as other,
    ):
        path = url.removeprefix(address(web))
        assert offset_of(other, path) == 100_000
        assert send(other, path, 100_000, DRIVE[100_000:200_000]).status_code == 204
        assert send(web, url, 200_000, DRIVE[200_000:]).status_code == 204
        assert jobs_of(other) == [("monday-drive", "queued")]
        assert other.get(f"/blobs/{sha256(DRIVE)}").content == DRIVE


@on_one_database
def test_sending_drives_takes_the_right_to_write(library, serving):
    def holder(name: str, role: Role) -> dict[str, Caller]:
        return {sha256(name.encode()): Caller(name, role)}

    access = Access("read", holder("mapper", "write") | holder("vehicle", "read"))
    with serving(create_app(library, access)) as base_url, httpx.Client(base_url=base_url) as web:
        for token, status in ((None, 401), ("vehicle", 403), ("mapper", 201)):
            web.headers.update({"Authorization": f"Bearer {token}"} if token else {})
            answer = begin(web)
            assert answer.status_code == status
        url = answer.headers["location"]
        assert send(web, url, 0, DRIVE).status_code == 204
        (job,) = web.get("/jobs").json()["jobs"]
        web.headers["authorization"] = "Bearer vehicle"
        assert web.get("/jobs").status_code == 200
        assert web.head(url, headers=TUS).status_code == 403
        assert web.post(f"/jobs/{job['job_id']}/cancel").status_code == 403
        assert web.delete(f"/drives/{sha256(DRIVE)}").status_code == 403


def send_half(url: str, data: bytes, offset: int, sent_bytes: int) -> socket.socket:
    """A connection over which only the first bytes of a body come."""
    parts = urlsplit(url)
    connection = socket.create_connection((parts.hostname, parts.port), timeout=30)
    head = (
        f"PATCH {parts.path}?{parts.query} HTTP/1.1\r\nHost: {parts.netloc}\r\nTus-Resumable: 1.0.0\r\n"
        f"Upload-Offset: {offset}\r\nContent-Type: application/offset+octet-stream\r\n"
        f"Content-Length: {len(data) - offset}\r\n\r\n"
    )
    connection.sendall(head.encode() + data[offset : offset + sent_bytes])
    return connection


def wait_for_offset(web: httpx.Client, url: str, expected: int) -> None:
    deadline_s = time.monotonic() + 30
    while (found := offset_of(web, url)) < expected:
        assert time.monotonic() < deadline_s, f"{found} of {expected} bytes"
    assert found == expected


@on_one_database
def test_what_arrived_before_a_connection_broke_stays(web, library):
    data = recording(9 * MB)
    url = begin(web, data).headers["location"]
    send_half(url, data, 0, PIECE_BYTES + 12_345).close()
    wait_for_offset(web, url, PIECE_BYTES + 12_345)
    resuming = TusClient(address(web)).uploader(file_stream=io.BytesIO(data), url=url, chunk_size=3 * MB)
    assert resuming.offset == PIECE_BYTES + 12_345
    resuming.upload()
    assert library.drives.get(sha256(data)).size_bytes == len(data)


def test_an_upload_goes_on_after_the_server_was_killed(start_server, tmp_path, endpoint):
    data = recording(9 * MB)
    first = start_server(tmp_path / "store", endpoint)
    with httpx.Client(base_url=first.http_url) as web:
        url = begin(web, data).headers["location"]
        with send_half(url, data, 0, PIECE_BYTES + MB):
            wait_for_offset(web, url, PIECE_BYTES)
            first.kill()
    second = start_server(tmp_path / "store", endpoint)
    url = url.replace(first.http_url, second.http_url)
    resuming = TusClient(second.http_url).uploader(file_stream=io.BytesIO(data), url=url, chunk_size=3 * MB)
    assert resuming.offset == PIECE_BYTES
    resuming.upload()
    with httpx.Client(base_url=second.http_url) as web:
        assert web.get(f"/blobs/{sha256(data)}").content == data
        assert jobs_of(web, data) == [("monday-drive", "queued")]
