"""Rows of ``fleetmap benchmark server``: a large map for one client, and a map of a million landmarks."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

from fleetmap.errors import RunError
from fleetmap.manifest import parse_manifest
from fleetmap.map_package import decode_cells, open_package
from fleetmap.transport import MapClient
from fleetmap.transport.download import Blob, blob_pieces, download_to
from fleetmap.transport.link import ServerLink
from fleetmap_cli.benchmarks.made_map import made_map
from fleetmap_cli.benchmarks.million_landmarks import write_large_map
from fleetmap_cli.benchmarks.row import Figures
from fleetmap_cli.benchmarks.server_process import map_server
from fleetmap_cli.benchmarks.tcp_yardstick import receive, receive_and_store, tcp_sender
from fleetmap_cli.benchmarks.workbench import Workbench

_PART_SIZES_BYTES = (12_500_000,) * 8
_REPEATS = 11


def fetch(bench: Workbench) -> Figures:
    """Publish and fetch 100 MB; in turns with it, carry as much over a plain socket."""
    bench.shown("fleetmap benchmark server --rows fetch")
    one = made_map("benchmark", _PART_SIZES_BYTES)
    blobs = [Blob(sha256, len(data), one.version, "the map") for sha256, data in one.parts.items()]
    sizes_bytes = {blob.sha256: blob.size_bytes for blob in blobs}
    size_bytes = sum(sizes_bytes.values())
    (bench.folder / "everything").write_bytes(b"".join(one.parts.values()))
    times_s: dict[str, list[float]] = {}

    def timed(name: str, work: Callable[[], object]) -> None:
        started = time.perf_counter()
        work()
        times_s.setdefault(name, []).append(time.perf_counter() - started)

    with map_server(bench.folder) as server, tcp_sender(bench.folder / "everything") as port:
        with MapClient(server.endpoint) as client:
            timed("publish", lambda: client.publish(one.manifest_bytes, one.parts.__getitem__))
            timed("publish again", lambda: client.publish(one.manifest_bytes, one.parts.__getitem__))
        link = ServerLink(server.endpoint, timeout_s=30.0, patience_s=15.0)
        for _ in range(_REPEATS):
            timed("raw TCP", lambda: receive(port, size_bytes))
            timed("transfer", lambda: _take(link, blobs))
            timed("TCP stored", lambda: receive_and_store(port, sizes_bytes, _new_folder(bench, "plain")))
            timed("stored", lambda: _store(link, blobs, _new_folder(bench, "fetched")))
        link.close()
    middle_s = {name: median(times) for name, times in times_s.items()}
    rates = {f"{name} MB/s": round(size_bytes / middle_s[name] / 1e6) for name in _RATES}
    return {
        **rates,
        "transfer / raw TCP": round(middle_s["raw TCP"] / middle_s["transfer"], 2),
        "stored / TCP stored": round(middle_s["TCP stored"] / middle_s["stored"], 2),
        "publish again ms": round(1e3 * middle_s["publish again"]),
    }


_RATES = ("raw TCP", "transfer", "TCP stored", "stored", "publish")


def million(bench: Workbench) -> Figures:
    """Publish and list a map of a million landmarks, and fetch one cell of it; what the server needed."""
    bench.shown("fleetmap benchmark server --rows million")
    landmarks = write_large_map(bench.folder / "large", "large")
    package = open_package(bench.folder / "large")
    with map_server(bench.folder) as server, MapClient(server.endpoint) as client:
        before_bytes = server.peak_memory_bytes
        publish_s = _timed(lambda: client.publish(package.manifest_bytes, package.part_bytes))
        list_s = _timed(client.list_maps)
        fetch_s = _timed(lambda: _fetch_one_cell(client, "large"))
        peak_bytes = server.peak_memory_bytes
    return {
        "landmarks": landmarks,
        "map MB": round(sum(record.size_bytes for record in package.manifest.parts) / 1e6),
        "publish s": round(publish_s, 2),
        "list ms": round(1e3 * list_s, 1),
        "one cell ms": round(1e3 * fetch_s, 1),
        "server before MB": round(before_bytes / 1e6),
        "server peak MB": round(peak_bytes / 1e6),
    }


def _fetch_one_cell(client: MapClient, map_id: str) -> None:
    """What a vehicle does that enters a map: manifest, and the cell with the most landmarks."""
    data = client.manifest(map_id)
    manifest = parse_manifest(data, map_id)
    record = max((part for part in manifest.parts if part.kind == "cell"), key=lambda part: part.landmarks)
    (entry,) = (one for one in client.list_maps() if one.map_id == map_id)
    content = decode_cells(manifest, [client.part(map_id, entry.version, record.sha256, record.size_bytes)])
    if len(content.landmarks) != record.landmarks:
        raise RunError("the cell that was fetched does not hold what its manifest says")


def _take(link: ServerLink, blobs: list[Blob]) -> None:
    received = sum(len(piece) for piece in blob_pieces(link, [(blob, 0) for blob in blobs]))
    if received != sum(blob.size_bytes for blob in blobs):
        raise RunError(f"{received} bytes arrived")


def _store(link: ServerLink, blobs: list[Blob], folder: Path) -> None:
    for blob in blobs:
        download_to(folder / blob.sha256, link, blob)


def _new_folder(bench: Workbench, name: str) -> Path:
    """An empty folder: what an earlier repeat has stored is removed."""
    folder = bench.folder / name
    folder.mkdir(exist_ok=True)
    for file in folder.iterdir():
        file.unlink()
    return folder


def _timed(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started
