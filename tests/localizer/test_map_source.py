"""A folder and a real server give the same maps."""

from __future__ import annotations

import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from fleetmap.errors import MapPackageError, ServerError, ServerRefusedError
from fleetmap.map_package import open_package
from fleetmap.transport import MapClient
from fleetmap_localizer.map_source import Circle, FolderMap, MapFolder, MapServer, MapSource, ServerMaps, read_map
from fleetmap_server.server import running_server
from fleetmap_server.settings import ServerSettings


@pytest.fixture(scope="module")
def endpoint(mapped_street, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A server with the map of the street."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    store = tmp_path_factory.mktemp("server") / "store"
    with running_server(ServerSettings(store, endpoint, http_port=0)), MapClient(endpoint) as client:
        package = open_package(mapped_street.package)
        client.publish(package.manifest_bytes, package.part_bytes)
        yield endpoint


@pytest.fixture
def server(endpoint: str) -> Iterator[ServerMaps]:
    source = MapServer(endpoint, lambda **how: MapClient(endpoint, **how)).open()
    yield source
    source.close()


@pytest.fixture
def folder(mapped_street) -> FolderMap:
    return MapFolder(mapped_street.package).open()


def test_both_give_the_same_bytes(server: ServerMaps, folder: FolderMap, mapped_street) -> None:
    version = open_package(mapped_street.package).version
    cells = {part.sha256: part.size_bytes for part in mapped_street.manifest.parts if part.kind == "cell"}

    def all_of(source: MapSource) -> tuple[bytes, list[bytes]]:
        return source.manifest("street", version), list(source.parts("street", version, cells))

    assert cells
    assert all_of(server) == all_of(folder)
    assert server.is_served("street", version)
    assert folder.is_served("street", version)


def test_maps_are_found_where_they_are(server: ServerMaps, folder: FolderMap, mapped_street) -> None:
    lon, lat = mapped_street.manifest.trajectory_lonlat[0]
    for source in (server, folder):
        for around in (None, Circle(lat, lon, 100.0), Circle(lat + 0.01, lon, 1200.0)):
            (entry,) = source.maps(around, 10)
            assert (entry.map_id, entry.version) == ("street", open_package(mapped_street.package).version)
        assert source.maps(Circle(lat + 0.01, lon, 1000.0), 10) == []


def test_a_circle_encloses_another_that_touches_it_from_within() -> None:
    outer = Circle(48.0, 11.0, 2000.0)
    assert outer.encloses(Circle(48.0, 11.0, 2000.0))
    assert outer.encloses(Circle(48.01, 11.0, 880.0))  # 1112 m away
    assert not outer.encloses(Circle(48.01, 11.0, 900.0))
    assert outer.widened(20.0).encloses(Circle(48.01, 11.0, 900.0))


def test_the_only_map_that_is_wanted_is_found_wherever_it_is(endpoint: str) -> None:
    def opened(map_id: str) -> ServerMaps:
        return MapServer(endpoint, lambda **how: MapClient(endpoint, **how), map_id).open()

    wanted = opened("street")
    assert [entry.map_id for entry in wanted.maps(Circle(0.0, 0.0, 1.0), 10)] == ["street"]
    wanted.close()
    missing = opened("atlantis")
    with pytest.raises(ServerRefusedError, match="atlantis"):
        missing.maps(None, 10)
    missing.close()


def test_a_version_that_nobody_has_is_refused_and_not_served(server: ServerMaps) -> None:
    with pytest.raises(ServerRefusedError):
        server.manifest("street", "0" * 64)
    assert not server.is_served("street", "0" * 64)


def test_a_closed_server_is_one_that_is_away(endpoint: str) -> None:
    source = MapServer(endpoint, lambda **how: MapClient(endpoint, **how)).open()
    source.close()
    with pytest.raises(ServerError):
        source.maps(None, 10)


def test_a_tampered_part_on_disk_is_refused(mapped_street, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(mapped_street.package, tmp_path / "street"))
    cell = next(record for record in open_package(folder).manifest.parts if record.kind == "cell")
    path = folder / "parts" / f"{cell.sha256}.bin"
    path.write_bytes(path.read_bytes()[:-1] + b"!")
    with pytest.raises(MapPackageError, match=cell.sha256):
        read_map(folder)
    with pytest.raises(MapPackageError, match=cell.sha256):
        list(MapFolder(folder).open().parts("street", "", {cell.sha256: cell.size_bytes}))
