"""The HTTP face before other people's tools: a STAC validator, a STAC client, a tester of its own description."""

from __future__ import annotations

import contextlib
import hashlib
import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import pystac
import pystac_client
import pytest
import shapely

from fleetmap.jobs import DriveSummary
from fleetmap.transport import MapClient
from fleetmap.transport.localizers import LocalizerPool
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate
from fleetmap_localizer.pose_service import PoseService
from fleetmap_localizer.supplies import Supplies
from fleetmap_server.http.app import create_app
from fleetmap_server.library import open_library
from fleetmap_server.settings import ServerSettings
from fleetmap_server.zenoh_service import ZenohFace

MAPS = 120  # more than one page
START = datetime(2023, 11, 14, 22, 13, 20, tzinfo=UTC)  # of the surveys of all handmade maps
OFFLINE = Path(__file__).with_name("offline.py")


@pytest.fixture(scope="module")
def locator_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


class NoMaps:
    """What a localizer has where no road was mapped."""

    def views(self) -> tuple[MapView, ...]:
        return ()

    def moved(self, pose: PoseEstimate | NoPose) -> None:
        pass

    def close(self) -> None:
        pass


@pytest.fixture(scope="module")
def address(tmp_path_factory, make_map, publish, serving, module_endpoint, locator_endpoint) -> Iterator[str]:
    """A server with maps around the Earth, the first of them in three versions, with a drive and a localizer."""
    with contextlib.ExitStack() as stack:
        library = stack.enter_context(open_library(ServerSettings(store=tmp_path_factory.mktemp("store"))))
        with library.storage.database.writing() as connection:
            sha256 = hashlib.sha256(b"recording").hexdigest()
            library.drives.add(connection, sha256, "survey.mcap", 9)
            summary = DriveSummary(verdict="yes", trajectory_lonlat=((8.4, 49.0), (8.5, 49.0)))
            library.drives.summarise(connection, sha256, summary, checked=True)
            for number in range(1, MAPS):
                west = -178.0 + 2.98 * number
                one = make_map(f"map{number:03}", (10,), number, ((west, 40.0), (west + 0.1, 40.1)))
                library.catalogue.add(connection, one.manifest, one.version, len(one.manifest_bytes), None)
        for seed in range(3):  # last, so that it is what comes first in every list
            publish(library, make_map(map_id="map000", seed=seed, path_lonlat=((20.2, 20.2), (20.8, 20.8))))
        stack.enter_context(ZenohFace(library, module_endpoint))  # where the localizer asks who may ask it
        supplies = Supplies(lambda camera, near: NoMaps())
        connect = partial(MapClient, module_endpoint)
        service = PoseService(locator_endpoint, lambda token: connect(token=token), supplies)
        stack.enter_context(contextlib.closing(service))
        pool = stack.enter_context(contextlib.closing(LocalizerPool([locator_endpoint])))
        yield stack.enter_context(serving(create_app(library, localizers=pool)))


def run(folder: Path, *arguments: str) -> str:
    """Run a module in a folder, with all but this machine out of reach; what it printed."""
    command = [sys.executable, OFFLINE, *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, f"{arguments[0]} found:\n{done.stdout[-8000:]}\n{done.stderr[-2000:]}"
    return done.stdout


def test_the_stac_validator_has_nothing_to_object_to(address, tmp_path):
    around = json.dumps(shapely.geometry.mapping(shapely.box(0.0, 10.0, 30.0, 60.0)))
    classes = ("core", "collections", "features", "item-search", "item-search#sort")
    told = run(
        tmp_path,
        "stac_api_validator", "--root-url", f"{address}/", "--collection", "maps", "--geometry", around,
        "--validate-pagination", *(word for name in classes for word in ("--conformance", name)),
    )  # fmt: skip
    assert "Errors: none" in told


def test_random_requests_meet_no_server_error_and_no_status_that_is_not_documented(address, tmp_path):
    checks = (
        "not_a_server_error", "status_code_conformance", "content_type_conformance",
        "response_schema_conformance", "allow_header_conformance",
    )  # fmt: skip
    told = run(
        tmp_path,
        "schemathesis.cli", "run", f"{address}/api", "--checks", ",".join(checks), "--seed", "1",
        "--max-examples", "6", "--no-color", "--warnings", "off",
    )  # fmt: skip
    assert "Seed: 1" in told


@pytest.fixture(scope="module")
def client(address) -> pystac_client.Client:
    return pystac_client.Client.open(f"{address}/")


def found(client: pystac_client.Client, **search) -> list[str]:
    """Ids of what both ways of asking find."""
    by_get, by_post = ([item.id for item in client.search(method=m, **search).items()] for m in ("GET", "POST"))
    assert by_get == by_post
    return by_get


def test_a_stac_client_pages_through_everything(client):
    everything = found(client)
    assert len(everything) == len(set(everything)) == MAPS + 1
    assert found(client, limit=7) == everything
    assert found(client, collections=["maps"], sortby="-id") == [f"map{n:03}" for n in reversed(range(MAPS))]
    drives = [item.id for item in client.get_collection("drives").get_items()]
    assert drives == found(client, collections=["drives"]) == everything[-1:]


def test_a_stac_client_searches_by_place_time_and_id(client):
    assert found(client, bbox=[20, 20, 21, 21]) == ["map000"]
    assert found(client, bbox=[20.0, 20.6, 20.3, 21.0]) == []  # in its bounding box, but not on its way
    assert found(client, intersects=shapely.box(8.0, 48.0, 9.0, 50.0)) == found(client, collections=["drives"])
    across_180 = found(client, bbox=[170, 39, -170, 41], collections=["maps"])
    assert across_180 == ["map119", "map118", "map117", "map002", "map001"]
    assert len(found(client, datetime=START, collections=["maps"])) == MAPS
    assert found(client, datetime="2024-01-01T00:00:00Z/..", collections=["maps"]) == []
    assert found(client, ids=["map000", "map007"], sortby="+id") == ["map000", "map007"]


def test_a_stac_client_follows_a_map_through_its_versions(client, address):
    latest = next(iter(client.search(ids=["map000"]).items()))
    assert latest.properties["proj:code"] == "EPSG:32632"
    before = pystac.Item.from_file(latest.get_single_link("predecessor-version").absolute_href)
    assert (before.id, before.properties["deprecated"]) == ("map000.v2", True)
    assert before.get_single_link("latest-version").absolute_href == latest.self_href
    (drive,) = client.search(collections=["drives"]).items()
    for item in (latest, before, drive):
        assert item.stac_extensions == [f"{address}/stac/fleetmap/v1.0.0/schema.json"]
        assert item.validate()  # against STAC's core, and the schema that this server has
