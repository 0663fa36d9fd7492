"""``fleetmap locate`` and ``locator``: what they refuse, in one line. Poses are tested with the localizer."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.camera_file import write_camera

CAMERA = Camera(320, 200, 250.0, 250.0, 159.5, 99.5)


@pytest.fixture
def camera_file(tmp_path: Path) -> Path:
    write_camera(tmp_path / "camera.yaml", CAMERA)
    return tmp_path / "camera.yaml"


@pytest.fixture
def image(tmp_path: Path) -> Path:
    path = tmp_path / "image.png"
    cv2.imwrite(str(path), np.zeros((200, 320), dtype=np.uint8))
    return path


def test_help_says_what_the_axes_are(fleetmap):
    code, out, _ = fleetmap("locate", "--help")
    words = " ".join(out.split())
    assert code == 0
    for word in (
        "--camera",
        "--near",
        "GeoPose",
        "x where it looks, y to its left, z up",
        "true north",
        "Exit codes",
    ):
        assert word in words


@pytest.mark.parametrize(
    "arguments", [[], ["--map", "m", "--server", "tcp/127.0.0.1:1"], ["--map", "m", "--remote"], ["--remote"]]
)
def test_it_has_to_be_said_where_the_maps_are(fleetmap, image, camera_file, arguments):
    code, out, err = fleetmap("locate", image, "--camera", camera_file, *arguments)
    assert (code, out) == (2, "")
    assert "--server ENDPOINT, or --map FOLDER" in err


def test_a_camera_file_and_an_image_have_to_be_there(fleetmap, image, camera_file, map_package, tmp_path):
    for arguments, name in (
        ((image, "--camera", tmp_path / "none.yaml"), "none.yaml"),
        ((tmp_path / "none.jpg", "--camera", camera_file), "none.jpg"),
        ((tmp_path, "--camera", camera_file), str(tmp_path)),
    ):
        code, out, err = fleetmap("locate", *arguments, "--map", map_package)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert name in err


def test_an_image_of_another_size_or_kind_is_refused_by_name(fleetmap, camera_file, map_package, tmp_path):
    cv2.imwrite(str(tmp_path / "small.jpg"), np.zeros((100, 160, 3), dtype=np.uint8))
    cv2.imwrite(str(tmp_path / "map.bmp"), np.zeros((200, 320), dtype=np.uint8))
    for name, reason in (
        ("small.jpg", "has 160x100 pixels, the camera file is for 320x200"),
        ("map.bmp", "is neither JPEG nor PNG"),
    ):
        code, out, err = fleetmap("locate", tmp_path / name, "--camera", camera_file, "--map", map_package)
        assert (code, out) == (2, "")
        assert err == f"error: {tmp_path / name} {reason}\n"


def test_a_server_that_is_not_there_is_one_line(fleetmap, image, camera_file, absent_server, tmp_path):
    for option in ([], ["--remote"]):
        code, out, err = fleetmap(
            "locate", image, "--camera", camera_file, "--server", absent_server, "--cache", tmp_path / "c", *option
        )
        assert (code, out, err.count("\n")) == (1, "", 1)
        assert absent_server in err


def test_a_server_without_a_localizer_says_so_at_once(fleetmap, image, camera_file, shared_server):
    code, out, err = fleetmap("locate", image, "--camera", camera_file, "--server", shared_server, "--remote")
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "no localizer answers" in err


def test_an_endpoint_that_is_none_ends_the_locator(fleetmap, absent_server):
    code, out, err = fleetmap("locator", "--server", absent_server, "--zenoh", "http://127.0.0.1:80")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "no Zenoh endpoint" in err
