"""The localizer as a service behind a map server: an image goes in over HTTP or Zenoh, a GeoPose comes out."""

from __future__ import annotations

import hashlib
import socket
import struct
import zlib
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.camera_file import write_camera
from fleetmap.errors import ServerRefusedError, ServerUnreachableError
from fleetmap.geopose import GeoPose
from fleetmap.localization import LocalizeRequest
from fleetmap.map_package import open_package
from fleetmap.transport import MapClient
from fleetmap.transport.localizers import LocalizerPool, NoLocalizerError
from fleetmap.transport.session import ProblemError
from fleetmap_localizer.map_source import MapServer
from fleetmap_localizer.pose_service import PoseService
from fleetmap_localizer.supplies import Supplies
from fleetmap_localizer.tile_supply import map_supply_of
from fleetmap_server.server import running_server
from fleetmap_server.settings import ServerSettings

WRITING, READING = "a-writers-token", "a-readers-token"


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def camera_text(camera: Camera, folder: Path) -> str:
    write_camera(folder / "camera.yaml", camera, force=True)
    return (folder / "camera.yaml").read_text()


@dataclass(frozen=True)
class Chain:
    """A map server that wants tokens, a localizer that it knows, and a question about the second camera."""

    server: str
    localizer: str
    http: httpx.Client
    question: LocalizeRequest

    def post(self, image: bytes, **fields: str) -> httpx.Response:
        camera = fields.pop("camera", self.question.camera)
        return self.http.post("/localize", files={"image": image, "camera": camera.encode()}, data=fields)


@pytest.fixture(scope="module")
def chain(mapped_street, second_drive, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    folder = tmp_path_factory.mktemp("chain")
    lines = [f"write mapper {sha256(WRITING)}", f"read vehicle {sha256(READING)}"]
    (folder / "access").write_text("\n".join(lines))
    endpoint, localizer = free_endpoint(), free_endpoint()
    settings = ServerSettings(
        folder / "store", endpoint, http_port=0, access_file=folder / "access", localizers=(localizer,)
    )
    connect = partial(MapClient, endpoint, token=READING)
    supplies = Supplies(
        lambda camera, near: map_supply_of(
            MapServer(endpoint, connect), camera, near_lat_lon_deg=near, cache=folder / "cache"
        )
    )
    question = LocalizeRequest(camera=camera_text(second_drive.camera, folder))
    with running_server(settings) as server:
        package = open_package(mapped_street.package)
        with MapClient(endpoint, token=WRITING) as client:
            client.publish(package.manifest_bytes, package.part_bytes)
        headers = {"Authorization": f"Bearer {READING}"}
        with (
            closing(PoseService(localizer, lambda token: MapClient(endpoint, token=token), supplies)),
            httpx.Client(base_url=server.http_url, headers=headers, timeout=60.0) as http,
        ):
            yield Chain(endpoint, localizer, http, question)
        supplies.close()


def sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def encoded(image: np.ndarray, suffix: str = ".jpg") -> bytes:
    done, data = cv2.imencode(suffix, image)
    assert done
    return bytes(data)


@pytest.fixture(scope="module")
def place(mapped_street) -> tuple[float, float]:
    """Where the street begins."""
    lon_deg, lat_deg = open_package(mapped_street.package).manifest.trajectory_lonlat[0]
    return lat_deg, lon_deg


def assert_true(pose: GeoPose, second_drive, number: int) -> None:
    true = second_drive.truth.pose(number)
    told = pose.utm_from_cam()
    assert 0.0 < np.linalg.norm(told.translation_m - true.translation_m) < 0.3
    turn = told.rotation.T @ true.rotation
    assert np.degrees(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0))) < 0.5
    assert 0.0 < pose.accuracy.horizontal_sigma_m < 0.3


def test_an_image_sent_by_http_comes_back_as_a_geopose(chain, second_drive, mapped_street, place):
    number = 5
    image = encoded(second_drive.frames[number].image)
    told = chain.post(image, near=f"{place[0]},{place[1]}", stamp_ns="1234567890123456789")
    assert told.status_code == 200, told.text
    assert told.json()["reason"] is None
    pose = GeoPose.model_validate(told.json()["pose"])
    assert_true(pose, second_drive, number)
    package = open_package(mapped_street.package)
    assert (pose.map_id, pose.version, pose.stamp_ns) == ("street", package.version, 1_234_567_890_123_456_789)


def test_the_same_by_zenoh_from_the_server_and_from_the_localizer_itself(chain, second_drive):
    image = encoded(cv2.cvtColor(second_drive.frames[9].image, cv2.COLOR_GRAY2BGR), ".png")
    with MapClient(chain.server, token=READING) as client:
        answer = client.localize_image(image, chain.question)
    assert answer.pose is not None
    assert_true(answer.pose, second_drive, 9)
    pool = LocalizerPool([chain.localizer])
    assert pool.localize(chain.question, image, READING) == answer
    for token in (None, "guessed"):
        with pytest.raises(ProblemError) as refused:
            pool.localize(chain.question, image, token)
        assert refused.value.problem.status == 401
    pool.close()


def test_a_black_image_and_a_foreign_place_have_no_pose_but_a_reason(chain, second_drive, foreign_drive):
    height_px, width_px = second_drive.frames[0].image.shape
    black = encoded(np.zeros((height_px, width_px), dtype=np.uint8))
    for image in (black, encoded(foreign_drive.frames[3].image)):
        told = chain.post(image)
        assert (told.status_code, told.json()["pose"]) == (200, None)
        assert told.json()["reason"]
    told = chain.post(black, near="-33.9,18.4")
    assert told.status_code == 200
    assert "has no map near -33.9" in told.json()["reason"]


def png_that_claims(width_px: int, height_px: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width_px, height_px, 8, 0, 0, 0, 0))
    body = zlib.compress(b"\0" * 10_000_000)
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def test_images_that_are_none_are_refused_and_the_next_one_is_served(chain, second_drive):
    good = encoded(second_drive.frames[5].image)
    refused = {
        good[: len(good) // 2]: "end in the middle",
        png_that_claims(60_000, 60_000): "claims 60000x60000 pixels",
        png_that_claims(300, 200): "300x200 pixels, the camera file is for 720x420",
        encoded(second_drive.frames[5].image.T): "EXIF orientation not applied",
        b"GIF89a" + bytes(100): "neither JPEG nor PNG",
        good[:300] + bytes(2000) + good[-300:]: "",
        b"": "neither JPEG nor PNG",
    }
    for image, reason in refused.items():
        told = chain.post(image)
        assert told.status_code == 422 or (reason == "" and told.json()["pose"] is None), told.text
        assert reason in told.text
        assert told.json().get("type") in ("urn:fleetmap:problem:unacceptable", None)
    assert chain.post(good).json()["pose"] is not None


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda text: "no calibration", "it needs image_width"),
        (lambda text: text.replace("image_width: 720", "image_width: 72000000"), "are not looked at"),
        (lambda text: text.replace("560.0", "-560.0"), "not usable"),
        (lambda text: text.replace("560.0", ".nan"), "not usable"),
        (lambda text: text.replace("560.0", "1.0e-300"), "no camera is like that"),
        (lambda text: text.replace("-0.25", "1.0e+308"), "no camera is like that"),
        (lambda text: text + "more: &a {x: 1}\nstill: {<<: [*a, *a]}\n", "aliases"),
        (lambda text: "[" * 300, "is not YAML"),
    ],
)
def test_a_camera_that_is_none_is_refused(chain, second_drive, change, reason):
    told = chain.post(encoded(second_drive.frames[5].image), camera=change(chain.question.camera))
    assert told.status_code == 422
    assert reason in told.json()["detail"]


def test_while_the_map_server_is_away_nobody_is_let_in(chain, second_drive):
    def connect(token: str | None) -> MapClient:
        raise ServerUnreachableError("no map server answers")

    endpoint = free_endpoint()
    supplies = Supplies(lambda camera, near: pytest.fail("it let somebody in"))
    with (
        closing(PoseService(endpoint, connect, supplies)),
        closing(LocalizerPool([endpoint])) as pool,
        pytest.raises(NoLocalizerError, match="no map server answers"),
    ):
        pool.localize(chain.question, encoded(second_drive.frames[5].image), READING)


def test_a_vehicle_that_asks_for_maps_there_is_told_where_it_is(chain):
    with pytest.raises(ServerRefusedError, match="give the endpoint of a fleetmap-server"):
        MapClient(chain.localizer)
