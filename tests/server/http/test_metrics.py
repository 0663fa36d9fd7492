"""What monitoring reads: requests and transfers counted, sizes looked up, readiness told within a bound."""

from __future__ import annotations

import base64
import hashlib
import io
import time
from collections.abc import Callable
from threading import Event

import httpx
import pytest
from mcap.writer import Writer
from moto.server import ThreadedMotoServer
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse_openmetrics
from prometheus_client.parser import text_string_to_metric_families as parse_prometheus

from fleetmap import __version__
from fleetmap.errors import ConflictError, StorageError
from fleetmap.transport import MapClient
from fleetmap_server.catalogue_size import catalogue_size
from fleetmap_server.library import open_library
from fleetmap_server.metrics import ServerMetrics
from fleetmap_server.readiness import Readiness
from fleetmap_server.server import RunningServer, running_server
from fleetmap_server.settings import ServerSettings

Read = Callable[..., float]


def reader(server: RunningServer) -> Read:
    """Reads one value from the server's metrics, 0 if it is not there."""

    def read(name: str, **labels: str) -> float:
        text = httpx.get(f"{server.http_url}/metrics").text
        samples = [sample for family in parse_prometheus(text) for sample in family.samples]
        return sum(
            sample.value for sample in samples if sample.name == name and labels.items() <= sample.labels.items()
        )

    return read


def becomes(value: Callable[[], float], wanted: float) -> None:
    """Wait for a figure: a request is counted a moment after it was answered."""
    deadline_s = time.monotonic() + 20.0
    while (found := value()) != wanted:
        assert time.monotonic() < deadline_s, found


def test_metrics_come_in_the_format_that_is_asked_for(server):
    plain = httpx.get(f"{server.http_url}/metrics", headers={"Accept": "*/*"})
    assert plain.headers["content-type"].startswith("text/plain; version=0.0.4")
    names = {family.name for family in parse_prometheus(plain.text)}
    assert {"fleetmap_maps", "fleetmap_requests", "fleetmap_build_info", "process_resident_memory_bytes"} <= names
    wanted = {"Accept": "application/openmetrics-text;version=1.0.0,text/plain;q=0.5"}
    exact = httpx.get(f"{server.http_url}/metrics", headers=wanted)
    assert exact.headers["content-type"].startswith("application/openmetrics-text; version=1.0.0")
    assert exact.text.endswith("# EOF\n")
    families = {family.name: family for family in parse_openmetrics(exact.text)}
    assert families["fleetmap_build"].samples[0].labels == {"version": __version__}
    assert families["fleetmap_catalogue_up"].samples[0].value == 1.0


def test_uploads_downloads_and_requests_are_counted(server, make_map):
    read, one = reader(server), make_map(part_sizes=(1_000_000,))
    assert read("fleetmap_maps") == read("fleetmap_uploads_total") == 0.0
    with MapClient(server.zenoh_endpoint) as client:
        client.publish(one.manifest_bytes, one.parts.__getitem__)
    becomes(lambda: read("fleetmap_maps"), 1.0)  # it is counted now and then
    assert read("fleetmap_versions") == 1.0
    becomes(lambda: read("fleetmap_uploads_total", kind="map", outcome="committed"), 1.0)
    assert read("fleetmap_uploads_total", kind="map", outcome="begun") >= 1.0
    assert read("fleetmap_received_bytes_total", face="zenoh") >= one.size_bytes
    assert read("fleetmap_stored_bytes") == one.size_bytes
    assert read("fleetmap_store_free_bytes") > 0.0

    (sha256,) = one.parts
    labels = {"face": "http", "operation": "GET /blobs/{sha256}"}
    sent = read("fleetmap_sent_bytes_total", face="http")
    httpx.get(f"{server.http_url}/blobs/{sha256}")
    becomes(lambda: read("fleetmap_requests_total", **labels, status="200"), 1.0)
    assert read("fleetmap_sent_bytes_total", face="http") - sent >= 1_000_000
    assert read("fleetmap_request_duration_seconds_count", **labels) == 1.0
    assert 0.0 < read("fleetmap_request_duration_seconds_sum", **labels) < 60.0

    for number in range(20):
        httpx.get(f"{server.http_url}/nothing/{number}")
        httpx.request(f"METHOD{number}", f"{server.http_url}/")
    operations = {
        sample.labels["operation"]
        for family in parse_prometheus(httpx.get(f"{server.http_url}/metrics").text)
        for sample in family.samples
        if "operation" in sample.labels
    }
    assert not [operation for operation in operations if "METHOD" in operation or "nothing" in operation]


def test_an_upload_that_somebody_else_outran_is_counted_as_failed(server, make_map):
    read, slow, quick = reader(server), make_map(seed=1, part_sizes=(10,)), make_map(seed=2, part_sizes=(10,))
    with MapClient(server.zenoh_endpoint) as client, MapClient(server.zenoh_endpoint) as other:

        def part_after_another_map(sha256: str) -> bytes:
            other.publish(quick.manifest_bytes, quick.parts.__getitem__)
            return slow.parts[sha256]

        with pytest.raises(ConflictError):
            client.publish(slow.manifest_bytes, part_after_another_map)
    becomes(lambda: read("fleetmap_uploads_total", kind="map", outcome="failed"), 1.0)
    assert read("fleetmap_uploads_total", kind="map", outcome="committed") == 1.0
    assert read("fleetmap_requests_total", face="zenoh", operation="upload/commit", status="409") == 1.0


def test_drives_sent_over_http_are_counted_by_what_became_of_them(server):
    file = io.BytesIO()
    writer = Writer(file)
    writer.start()
    channel = writer.register_channel(
        "/camera", "cdr", writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"")
    )
    writer.add_message(channel, 1, b"an image", 1)
    writer.finish()
    read = reader(server)
    for data, outcome, status in ((file.getvalue(), "committed", 204), (b"no recording", "failed", 422)):
        sha256 = hashlib.sha256(data).hexdigest()
        upload = {
            "Tus-Resumable": "1.0.0",
            "Upload-Length": str(len(data)),
            "Upload-Metadata": f"sha256 {base64.b64encode(sha256.encode()).decode()}",
        }
        begun = httpx.post(f"{server.http_url}/drives/uploads", headers=upload)
        for offset, piece in ((0, data[:5]), (5, data[5:])):
            told = {
                "Tus-Resumable": "1.0.0",
                "Upload-Offset": str(offset),
                "Content-Type": "application/offset+octet-stream",
            }
            answer = httpx.patch(begun.headers["location"], headers=told, content=piece)
        assert answer.status_code == status
        becomes(lambda outcome=outcome: read("fleetmap_uploads_total", kind="drive", outcome=outcome), 1.0)
    assert read("fleetmap_uploads_total", kind="drive", outcome="begun") == 2.0
    becomes(lambda: read("fleetmap_drives"), 1.0)


def test_vehicles_are_counted_while_they_are_connected(server):
    read = reader(server)
    assert read("fleetmap_vehicles_online") == 0.0
    with MapClient(server.zenoh_endpoint, vehicle_id="vehicle-1") as client:
        client.list_maps()
        becomes(lambda: read("fleetmap_vehicles_online"), 1.0)
    becomes(lambda: read("fleetmap_vehicles_online"), 0.0)


def test_servers_in_one_process_count_for_themselves():
    first, second = ServerMetrics(), ServerMetrics()
    first.observe("http", "GET /", 200, 0.1, 2, 3)
    assert first.registry.get_sample_value("fleetmap_sent_bytes_total", {"face": "http"}) == 3.0
    assert second.registry.get_sample_value("fleetmap_sent_bytes_total", {"face": "http"}) == 0.0


def test_the_size_of_the_catalogue_is_the_same_in_either_database(database_url, tmp_path, publish, make_map):
    with open_library(ServerSettings(store=tmp_path / "store", catalogue=database_url)) as library:
        published = [make_map(seed=seed, part_sizes=(10,)) for seed in (1, 2, 3)]
        published.append(make_map(map_id="other", part_sizes=(10,)))
        for one in published:
            publish(library, one)
        library.retire("karlsruhe", 1)
        sha256 = hashlib.sha256(b"drive").hexdigest()
        with library.storage.database.writing() as connection:
            library.drives.add(connection, sha256, "a.mcap", 10)
            library.jobs.queue(connection, sha256, "a")
            library.jobs.queue(connection, sha256, "b")
        library.jobs.take("worker")
        size = catalogue_size(library.storage.database)
    assert (size.maps, size.versions, size.drives) == (2, 3, 1)
    assert size.stored_bytes == sum(one.size_bytes for one in published)
    assert size.jobs == {"queued": 1, "running": 1, "done": 0, "failed": 0, "cancelled": 0}


def test_what_does_not_answer_is_told_within_a_bound_and_asked_once():
    release, asked = Event(), []

    def hang() -> None:
        asked.append(1)
        release.wait(30.0)

    def fail() -> None:
        raise StorageError("no bucket")

    ready = Readiness({"catalogue": hang, "store": fail}, within_s=0.05)
    expected = ["the catalogue does not answer within 0.05 s", "the store fails: no bucket"]
    assert [ready.failures() for _ in range(3)] == [expected] * 3
    assert len(asked) == 1
    release.set()
    assert Readiness({"catalogue": lambda: None}).failures() == []


def test_a_server_whose_catalogue_is_gone_is_alive_but_not_ready(postgresql, tmp_path, endpoint):
    url = postgresql.new_database()
    settings = ServerSettings(tmp_path / "store", endpoint, http_port=0, catalogue=url)
    with running_server(settings) as server:
        assert httpx.get(f"{server.http_url}/readyz").json() == {"status": "ready"}
        postgresql.execute(f"DROP DATABASE {url.rpartition('/')[2]} WITH (FORCE)")
        answer = httpx.get(f"{server.http_url}/readyz", timeout=30.0)
        assert (answer.status_code, answer.headers["content-type"]) == (503, "application/problem+json")
        assert "the catalogue" in answer.json()["detail"]
        assert httpx.get(f"{server.http_url}/healthz").json()["status"] == "ok"
        assert reader(server)("fleetmap_catalogue_up") == 0.0


def test_a_server_whose_bucket_is_gone_is_not_ready(tmp_path, endpoint, monkeypatch):
    service = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    service.start()
    try:
        host, port = service.get_host_and_port()
        for name, value in {
            "AWS_ENDPOINT_URL": f"http://{host}:{port}",
            "AWS_ACCESS_KEY_ID": "test",
            "AWS_SECRET_ACCESS_KEY": "test",
            "AWS_REGION": "us-east-1",
        }.items():
            monkeypatch.setenv(name, value)
        httpx.put(f"http://{host}:{port}/bucket").raise_for_status()
        catalogue = f"sqlite:///{tmp_path / 'catalogue.sqlite'}"
        with running_server(
            ServerSettings("s3://bucket/maps", endpoint, http_port=0, catalogue=catalogue)
        ) as server:
            assert httpx.get(f"{server.http_url}/readyz").status_code == 200
            service.stop()
            answer = httpx.get(f"{server.http_url}/readyz", timeout=30.0)
            assert (answer.status_code, answer.json()["detail"].count("the store")) == (503, 1)
    finally:
        service.stop()
