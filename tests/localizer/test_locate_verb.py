"""``fleetmap locate`` and ``fleetmap locator`` as a user runs them, in the simulated street."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest

from fleetmap.camera_file import write_camera
from fleetmap.geopose import GeoPose
from fleetmap.map_package import open_package
from fleetmap.transport import MapClient
from fleetmap_server.server import running_server
from fleetmap_server.settings import ServerSettings

NUMBERS = (3, 8)  # of the images in the second drive


@pytest.fixture(scope="module")
def folder(second_drive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two images of the second drive, a black one, and the calibration."""
    folder = tmp_path_factory.mktemp("images")
    write_camera(folder / "camera.yaml", second_drive.camera)
    for number in NUMBERS:
        cv2.imwrite(str(folder / f"{number}.jpg"), second_drive.frames[number].image)
    cv2.imwrite(str(folder / "black.png"), np.zeros_like(second_drive.frames[0].image))
    return folder


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def distance_m(told: dict, second_drive, number: int) -> float:
    pose = GeoPose.model_validate(told["pose"])
    true = second_drive.truth.positions_m[number]
    return float(np.linalg.norm(pose.utm_from_cam().translation_m - true))


def test_images_are_located_in_a_folders_map(fleetmap, folder, mapped_street, second_drive):
    images = [folder / f"{number}.jpg" for number in NUMBERS]
    common = ("--camera", folder / "camera.yaml", "--map", mapped_street.package)
    code, out, err = fleetmap("locate", *images, *common, "--json")
    assert (code, err) == (0, "")
    told = [json.loads(line) for line in out.splitlines()]
    assert [each["image"] for each in told] == [str(image) for image in images]
    for each, number in zip(told, NUMBERS, strict=True):
        assert 0.0 < distance_m(each, second_drive, number) < 0.3
    assert all(each["pose"]["stamp_ns"] is None and each["reason"] is None for each in told)


def test_one_line_for_people_and_another_exit_code_where_there_is_no_pose(fleetmap, folder, mapped_street):
    images = (folder / "black.png", folder / "3.jpg")
    common = ("--camera", folder / "camera.yaml", "--map", mapped_street.package)
    code, out, err = fleetmap("locate", *images, *common)
    assert (code, err) == (4, "")
    black, street = out.splitlines()
    assert black.startswith(f"{images[0]}: no pose: ")
    assert street.startswith(f"{images[1]}: ")
    for word in (" deg; sigma 0.", "UTM EPSG:32632 ", "map street, version "):
        assert word in street


def test_a_locator_serves_a_servers_users_until_it_is_killed(
    fleetmap, folder, mapped_street, second_drive, tmp_path
):
    endpoint, localizer = free_endpoint(), free_endpoint()
    command = [sys.executable, "-c", "from fleetmap_cli.main import main; main()", "locator"]
    command += ["--server", endpoint, "--zenoh", localizer, "--cache", str(tmp_path / "cache")]
    settings = ServerSettings(tmp_path / "store", endpoint, http_port=0, localizers=(localizer,))
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as locator,
        running_server(settings) as server,
    ):
        package = open_package(mapped_street.package)
        with MapClient(endpoint) as client:
            client.publish(package.manifest_bytes, package.part_bytes)
        assert locator.stdout is not None
        assert locator.stdout.readline() == f"locating in the maps of {endpoint}: Zenoh {localizer}\n"
        common = ("--camera", folder / "camera.yaml", "--server", endpoint, "--json")
        code, out, err = fleetmap("locate", folder / "3.jpg", *common, "--remote")
        assert (code, err) == (0, "")
        remote = json.loads(out)
        assert 0.0 < distance_m(remote, second_drive, 3) < 0.3
        code, out, _ = fleetmap("locate", folder / "3.jpg", *common, "--cache", tmp_path / "own")
        assert (code, json.loads(out)) == (0, remote)  # what the locator finds is what one finds oneself
        form = {"image": (folder / "3.jpg").read_bytes(), "camera": (folder / "camera.yaml").read_bytes()}
        post = partial(httpx.post, f"{server.http_url}/localize", files=form, timeout=60.0)
        os.kill(locator.pid, signal.SIGSTOP)  # it takes an image, and does not come to answer it
        with ThreadPoolExecutor(1) as pool:
            asked = pool.submit(post)
            assert httpx.get(f"{server.http_url}/healthz").status_code == 200
            assert not asked.done()
            locator.kill()
            answers = [asked.result(60.0), post()]
        locator.communicate(timeout=20)
        for answer in answers:
            assert (answer.status_code, answer.json()["title"]) == (503, "No localizer")
            assert localizer in answer.json()["detail"]


def test_a_locator_that_is_asked_to_end_ends_in_good_order():
    command = [sys.executable, "-c", "from fleetmap_cli.main import main; main()", "locator"]
    command += ["--server", free_endpoint(), "--zenoh", free_endpoint()]  # its map server need not be there
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as locator:
        assert locator.stdout is not None
        assert locator.stdout.readline().startswith("locating ")
        os.kill(locator.pid, signal.SIGTERM)
        _, err = locator.communicate(timeout=20)
    assert (locator.returncode, err.count("\n")) == (0, 1)
    assert "stopping" in err
