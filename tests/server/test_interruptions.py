"""Killed servers, killed clients, cut connections and full disks, each with real processes."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable

import pytest

from fleetmap.errors import StorageError, TransferError
from fleetmap.transport import MapClient
from fleetmap_cli.benchmarks.throttling_proxy import Fault, ThrottlingProxy

MIB = 1024 * 1024
CUT_BYTES = 3 * MIB


def once_past(limit_bytes: int, act: Callable[[], object]) -> Callable[[int, int], None]:
    """A progress callback that acts one time, when so much has been sent."""
    left = [act]

    def progress(done_bytes: int, total_bytes: int) -> None:
        if done_bytes >= limit_bytes and left:
            left.pop()()

    return progress


def items(http_url: str) -> list[str]:
    with urllib.request.urlopen(f"{http_url}/collections/maps/items", timeout=5) as answer:
        return [feature["id"] for feature in json.load(answer)["features"]]


def port_of(endpoint: str) -> int:
    return int(endpoint.rpartition(":")[2])


def test_a_server_killed_during_an_upload_costs_one_clear_error_and_only_the_missing_is_sent_again(
    start_server, tmp_path, endpoint, make_map
):
    original = make_map(part_sizes=(2 * MIB, 6 * MIB))
    server = start_server(tmp_path, endpoint)
    with MapClient(endpoint, patience_s=1.0) as client:
        begun_s = time.monotonic()
        with pytest.raises(
            TransferError, match=r"upload of map 'karlsruhe' ended at \d+\.\d of 8\.4 MB: .* again"
        ):
            client.publish(original.manifest_bytes, original.parts.__getitem__, once_past(CUT_BYTES, server.kill))
        assert time.monotonic() - begun_s < 10.0

    server = start_server(tmp_path, endpoint)
    assert server.announcement.startswith("serving 0 maps")
    assert items(server.http_url) == []
    seen: list[int] = []
    with MapClient(endpoint) as client:
        assert client.list_maps() == []
        client.publish(original.manifest_bytes, original.parts.__getitem__, lambda done, total: seen.append(done))
        assert [entry.map_id for entry in client.list_maps()] == ["karlsruhe"]
    assert seen[0] >= CUT_BYTES
    assert items(server.http_url) == ["karlsruhe"]


def test_an_upload_outlives_a_restart_of_the_server(start_server, tmp_path, endpoint, make_map):
    original = make_map(part_sizes=(6 * MIB,))
    server = start_server(tmp_path, endpoint)

    def restart() -> None:
        server.kill()
        start_server(tmp_path, endpoint)

    with MapClient(endpoint) as client:
        client.publish(original.manifest_bytes, original.parts.__getitem__, once_past(CUT_BYTES, restart))
        assert [entry.version for entry in client.list_maps()] == [original.version]


def test_a_server_killed_during_a_download_costs_one_clear_error(start_server, tmp_path, endpoint, make_map):
    original = make_map(part_sizes=(16 * MIB,))
    ((sha256, data),) = original.parts.items()
    server = start_server(tmp_path, endpoint)
    with MapClient(endpoint) as client:
        client.publish(original.manifest_bytes, original.parts.__getitem__)

    killing = ThrottlingProxy(
        port_of(endpoint), faults=[Fault(CUT_BYTES, stall_s=0.0)], on_fault=lambda fault: server.kill()
    )
    with killing as proxy, MapClient(proxy.endpoint, patience_s=1.0) as client:
        begun_s = time.monotonic()
        with pytest.raises(
            TransferError, match=r"download of part .* of map 'karlsruhe' ended .* of 16\.8 MB: map server at"
        ):
            client.part("karlsruhe", original.version, sha256, len(data))
        assert time.monotonic() - begun_s < 10.0

    server = start_server(tmp_path, endpoint)
    assert server.announcement.startswith("serving 1 map ")
    with MapClient(endpoint) as client:
        assert client.part("karlsruhe", original.version, sha256, len(data)) == data


def test_a_cut_connection_costs_a_retry_and_no_data(server, make_map):
    original = make_map(part_sizes=(16 * MIB,))
    ((sha256, data),) = original.parts.items()
    faults = [Fault(CUT_BYTES), Fault(original.size_bytes + CUT_BYTES)]  # in the upload, and in the download
    with ThrottlingProxy(port_of(server.zenoh_endpoint), faults=faults) as proxy:
        with MapClient(proxy.endpoint) as client:
            client.publish(original.manifest_bytes, original.parts.__getitem__)
            assert client.part("karlsruhe", original.version, sha256, len(data)) == data
        assert proxy.faults_left == 0


DYING_CLIENT = """
import hashlib, os, signal, sys
from fleetmap.transport import MapClient
endpoint, manifest, part, limit_bytes = sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4])
def die(done, total):
    if done >= limit_bytes:
        os.kill(os.getpid(), signal.SIGKILL)
MapClient(endpoint).publish(open(manifest, "rb").read(), lambda sha256: open(part, "rb").read(), die)
"""


def test_a_client_killed_in_mid_upload_goes_on_where_it_stopped(server, make_map, tmp_path):
    original = make_map(part_sizes=(6 * MIB,))
    ((_, data),) = original.parts.items()
    (tmp_path / "manifest").write_bytes(original.manifest_bytes)
    (tmp_path / "part").write_bytes(data)
    arguments = [server.zenoh_endpoint, str(tmp_path / "manifest"), str(tmp_path / "part"), str(CUT_BYTES)]
    died = subprocess.run([sys.executable, "-c", DYING_CLIENT, *arguments], timeout=30, check=False)
    assert died.returncode == -9

    seen: list[int] = []
    with MapClient(server.zenoh_endpoint) as client:
        assert client.list_maps() == []
        client.publish(original.manifest_bytes, original.parts.__getitem__, lambda done, total: seen.append(done))
        assert [entry.version for entry in client.list_maps()] == [original.version]
    assert CUT_BYTES <= seen[0] < original.size_bytes


def test_a_full_disk_is_told_and_the_upload_goes_on_once_there_is_room(start_server, tmp_path, endpoint, make_map):
    original = make_map(part_sizes=(5 * MIB,))
    server = start_server(tmp_path, endpoint)
    _, hard = resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, (CUT_BYTES, hard))
    with MapClient(endpoint) as client:
        with pytest.raises(StorageError, match=r"cannot write .*: File too large; free some space"):
            client.publish(original.manifest_bytes, original.parts.__getitem__)
        assert client.list_maps() == []
        assert items(server.http_url) == []
        resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, (hard, hard))
        seen: list[int] = []
        client.publish(original.manifest_bytes, original.parts.__getitem__, lambda done, total: seen.append(done))
        assert seen[0] >= CUT_BYTES
        assert items(server.http_url) == ["karlsruhe"]
    assert server.stop() == (0, "")
