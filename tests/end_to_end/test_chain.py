"""The whole chain with every stage in a process of its own, and nothing faked between them.

Survey recording -> map -> published over Zenoh -> map server -> listed over HTTP -> a second vehicle downloads it
and reads its UTM pose from its camera -> judged against the truth.
"""

from __future__ import annotations

import hashlib
import json
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from fleetmap.camera import Camera
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.geodesy import UtmGrid
from fleetmap.simulation.driving import drive_along
from fleetmap.simulation.look import Look
from fleetmap.simulation.simulated_drive import simulate_drive
from fleetmap.trajectory import read_trajectory, write_trajectory

FLEETMAP = [sys.executable, "-c", "from fleetmap_cli.main import main; main()"]
SECOND_CAMERA = Camera(560, 340, 420.0, 421.0, 275.0, 172.0, (-0.22, 0.06, 1e-3, -5e-4, 0.0))
A_DAY_NS = 86_400_000_000_000


def fleetmap(*arguments: object) -> str:
    """What a verb prints that ends well and has nothing to warn of."""
    run = subprocess.run(
        [*FLEETMAP, *map(str, arguments)], capture_output=True, text=True, timeout=120, check=False
    )
    assert (run.returncode, run.stderr) == (0, "")
    return run.stdout


def http_bytes(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=10) as answer:
        data: bytes = answer.read()
        return data


def http_json(url: str) -> Any:
    return json.loads(http_bytes(url))


@dataclass(frozen=True)
class Server:
    zenoh: str
    http: str


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    store = tmp_path_factory.mktemp("server") / "store"
    arguments = ["serve", "--store", str(store), "--zenoh", endpoint, "--http", "127.0.0.1:0"]
    process = subprocess.Popen([*FLEETMAP, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    yield Server(endpoint, process.stdout.readline().split("HTTP ")[1].strip())
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (0, "")


@pytest.fixture(scope="module")
def published(server: Server, mapped_survey: Any) -> Server:
    """The server, once the survey's map has been published to it."""
    assert mapped_survey.run.returncode == 0
    assert fleetmap("publish", mapped_survey.package, "--server", server.zenoh).startswith("published my_map ")
    return server


@pytest.fixture(scope="module")
def second_vehicle(survey: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A day later, half a lane to the left, another camera in worse light; its GNSS receiver is a degree off."""
    truth = drive_along(survey.street, lane_offset_m=1.5, speed_mps=9.0, rate_hz=5.0, start_m=3.0, seed=6)
    look = Look(exposure=0.65, gamma=1.3, noise_sigma=3.0, seed=8)
    drive = simulate_drive(
        survey.street, camera=SECOND_CAMERA, trajectory=truth, look=look, gnss_interval_s=1.0, seed=9
    )
    path: Path = tmp_path_factory.mktemp("second") / "second.mcap"
    with DriveWriter(path, SECOND_CAMERA) as writer:
        for frame in drive.frames():
            writer.write_image(frame.stamp_ns + A_DAY_NS, frame.image)
        for fix in drive.gnss_fixes():
            moved = type(fix)(
                fix.stamp_ns + A_DAY_NS, fix.lat_deg + 1.0, fix.lon_deg, fix.height_m, fix.covariance_enu_m2
            )
            writer.write_fix(moved, "camera")
    later = type(truth)(truth.epsg, truth.stamps_ns + A_DAY_NS, truth.positions_m, truth.rotations)
    write_trajectory(path.with_name("second.reference.tum"), later)
    return path


def test_the_server_lists_the_map_over_zenoh_and_over_http(survey, mapped_survey, published):
    (entry,) = json.loads(fleetmap("maps", "list", "--server", published.zenoh, "--json"))
    assert (entry["map_id"], entry["epsg"], entry["publishable"]) == ("my_map", survey.truth.epsg, True)

    landing = http_json(f"{published.http}/")
    (items_url,) = {link["href"] for link in landing["links"] if link["href"].endswith("/collections/maps/items")}
    items = http_json(items_url)
    (feature,) = items["features"]
    assert (items["type"], feature["type"], feature["id"]) == ("FeatureCollection", "Feature", "my_map")
    lat_deg, lon_deg, _ = UtmGrid(survey.truth.epsg).to_geodetic(survey.truth.positions_m)
    path = feature["geometry"]["coordinates"]
    assert path[0] == pytest.approx([lon_deg[0], lat_deg[0]], abs=1e-5)
    assert path[-1] == pytest.approx([lon_deg[-1], lat_deg[-1]], abs=3e-5)


def test_manifest_and_parts_fetched_over_http_are_those_that_were_made(mapped_survey, published):
    item = http_json(f"{published.http}/collections/maps/items/my_map")
    manifest = http_bytes(item["assets"]["manifest"]["href"])
    assert manifest == (mapped_survey.package / "manifest.json").read_bytes()
    for record in json.loads(manifest)["parts"]:
        data = http_bytes(f"{published.http}/maps/my_map/parts/{record['sha256']}")
        assert data == (mapped_survey.package / "parts" / f"{record['sha256']}.bin").read_bytes()
        assert hashlib.sha256(data).hexdigest() == record["sha256"]


def test_a_second_vehicle_reads_its_utm_pose_from_its_camera(published, second_vehicle, tmp_path):
    trajectory, cache = tmp_path / "second.tum", tmp_path / "cache"
    out = fleetmap(
        "localize", second_vehicle, "--server", published.zenoh, "--cache", cache, "--trajectory", trajectory
    )
    assert "map:            my_map (version " in out
    reference = second_vehicle.with_name("second.reference.tum")
    errors = json.loads(fleetmap("evaluate", trajectory, reference, "--json"))["reference"]
    assert errors["coverage"] >= 0.95
    assert errors["over_2m"] == 0
    assert 0.005 < errors["position_m"]["median"] < 0.15  # of which the map's own error is 0.05
    assert 0.01 < errors["rotation_deg"]["median"] < 1.0


def test_the_same_map_from_the_folder_gives_the_same_poses(mapped_survey, published, second_vehicle, tmp_path):
    near = UtmGrid(32632).to_geodetic(read_trajectory(mapped_survey.trajectory).positions_m[0])[:2]
    from_server = ["--server", published.zenoh, "--near", f"{near[0]},{near[1]}", "--cache", tmp_path / "cache"]
    from_folder = ["--map", mapped_survey.package]
    for name, options in (("server", from_server), ("folder", from_folder)):
        fleetmap("localize", second_vehicle, *options, "--trajectory", tmp_path / f"{name}.tum")
    assert (tmp_path / "server.tum").read_text() == (tmp_path / "folder.tum").read_text()
