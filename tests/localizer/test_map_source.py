"""Maps from a folder and from a real server: the same map, verified and kept."""

from __future__ import annotations

import json
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import MapPackageError, NoPoseError, ServerRefusedError
from fleetmap.manifest import manifest_version
from fleetmap.map_package import open_package
from fleetmap.transport import MapClient
from fleetmap_localizer.map_source import fetch_candidates, fetch_map, read_map
from fleetmap_localizer.map_view import LocalizableMap
from fleetmap_localizer.part_cache import PartCache
from fleetmap_server.server import running_server
from fleetmap_server.settings import ServerSettings


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MapClient]:
    """A client of a server that has nothing yet."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    store = tmp_path_factory.mktemp("server") / "store"
    with running_server(ServerSettings(store, endpoint, http_port=0)), MapClient(endpoint) as client:
        yield client


@pytest.fixture(scope="module")
def published(client: MapClient, mapped_street, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the street's map, which the server has, and an older one of another name beside it."""
    older = Path(shutil.copytree(mapped_street.package, tmp_path_factory.mktemp("older") / "older"))
    manifest = json.loads((older / "manifest.json").read_bytes())
    (older / "manifest.json").write_text(json.dumps(manifest | {"map_id": "older"}))
    for folder in (older, mapped_street.package):
        package = open_package(folder)
        client.publish(package.manifest_bytes, package.part_bytes)
    return mapped_street.package


def assert_same(first: LocalizableMap, second: LocalizableMap) -> None:
    assert (first.map_id, first.version, first.camera) == (second.map_id, second.version, second.camera)
    for group in ("keyframes", "landmarks"):
        for name, values in vars(getattr(first.content, group)).items():
            assert np.array_equal(values, getattr(getattr(second.content, group), name)), name
    assert np.array_equal(first.content.seen_landmark, second.content.seen_landmark)


def test_a_server_without_maps_is_told_apart(client: MapClient, tmp_path: Path) -> None:  # so it comes first
    with pytest.raises(NoPoseError, match=r"has no map; 'fleetmap maps list"):
        next(fetch_candidates(client, None, PartCache(tmp_path)))


def test_a_fetched_map_equals_the_one_on_disk(client: MapClient, published: Path, tmp_path: Path) -> None:
    assert_same(fetch_map(client, "street", None, PartCache(tmp_path)), read_map(published))


def test_only_cells_are_fetched_and_only_once(client: MapClient, published: Path, tmp_path: Path) -> None:
    cells = {record.sha256 for record in open_package(published).manifest.parts if record.kind == "cell"}
    assert cells
    fetch_map(client, "street", None, PartCache(tmp_path))
    kept = {file.stem: file.stat().st_mtime_ns for file in tmp_path.iterdir()}
    assert set(kept) == cells
    fetch_map(client, "street", None, PartCache(tmp_path))
    assert {file.stem: file.stat().st_mtime_ns for file in tmp_path.iterdir()} == kept


def test_a_tampered_cache_does_not_reach_the_localizer(client: MapClient, published: Path, tmp_path: Path) -> None:
    fetch_map(client, "street", None, PartCache(tmp_path))
    victim = sorted(tmp_path.iterdir())[0]
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= 1
    victim.write_bytes(data)
    assert_same(fetch_map(client, "street", None, PartCache(tmp_path)), read_map(published))
    assert victim.read_bytes() != bytes(data)


def test_candidates_come_newest_first_and_nearest_only_where_near(
    client: MapClient, published: Path, tmp_path: Path
) -> None:
    cache = PartCache(tmp_path)
    assert [candidate.map_id for candidate in fetch_candidates(client, None, cache)] == ["street", "older"]
    lon, lat = open_package(published).manifest.trajectory_lonlat[0]
    near = {candidate.map_id for candidate in fetch_candidates(client, (lat, lon), cache)}
    assert near == {"street", "older"}
    with pytest.raises(NoPoseError, match=r"no map near 40\.000000,-3\.000000"):
        next(fetch_candidates(client, (40.0, -3.0), cache))


def test_an_older_version_can_be_named_and_a_missing_map_is_refused(
    client: MapClient, published: Path, tmp_path: Path
) -> None:
    version = manifest_version((published / "manifest.json").read_bytes())
    assert fetch_map(client, "street", version, PartCache(tmp_path)).version == version
    with pytest.raises(ServerRefusedError, match="atlantis"):
        fetch_map(client, "atlantis", None, PartCache(tmp_path))


def test_a_tampered_part_on_disk_is_refused(published: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(published, tmp_path / "street"))
    cell = next(record for record in open_package(folder).manifest.parts if record.kind == "cell")
    path = folder / "parts" / f"{cell.sha256}.bin"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(MapPackageError, match=cell.sha256):
        read_map(folder)
