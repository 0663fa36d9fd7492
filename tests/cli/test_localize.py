"""``fleetmap localize``: what it refuses, in one line. How well it localises is tested with the localizer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.drives.ros2_writer import DriveWriter

CAMERA = Camera(320, 200, 250.0, 250.0, 159.5, 99.5)
T0_NS = 1_700_000_000_000_000_000


def record(path: Path, images: list[np.ndarray], camera: Camera | None = CAMERA) -> Path:
    with DriveWriter(path, camera) as writer:
        for i, image in enumerate(images):
            writer.write_image(T0_NS + i * 100_000_000, image.astype(np.uint8))
    return path


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    return record(tmp_path / "second.mcap", [rng.uniform(0, 255, (200, 320)) for _ in range(3)])


def test_help_teaches(fleetmap) -> None:
    code, out, _ = fleetmap("localize", "--help")
    assert code == 0
    for word in ("--server", "--map", "--near", "--use-gnss", "--cache", "Examples:", "GNSS is not read"):
        assert word in out
    for word in ("--paced", "--independent", "--with-predicted", ".geojson", "foxglove.LocationFix", "EPSG:326xx"):
        assert word in out


def test_without_server_and_map_it_is_a_usage_error(fleetmap, recording, tmp_path) -> None:
    code, out, err = fleetmap("localize", recording, "--trajectory", tmp_path / "x.tum")
    assert (code, out) == (2, "")
    assert "--server ENDPOINT, or --map FOLDER" in err


def test_without_anything_to_write_it_is_a_usage_error(fleetmap, recording, map_package) -> None:
    code, _, err = fleetmap("localize", recording, "--map", map_package)
    assert code == 2
    assert "--trajectory OUT.tum, or --output" in err


def test_an_ending_that_is_none_is_refused_before_any_work(fleetmap, recording, absent_server, tmp_path) -> None:
    code, out, err = fleetmap("localize", recording, "--server", absent_server, "--output", tmp_path / "out.kml")
    assert (code, out) == (2, "")
    assert "must end in .tum, .csv, .geojson, .mcap" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("near", ["here", "48.1", "48.1,x", "48.1,11.5,3"])
def test_a_place_that_is_none_is_a_usage_error(fleetmap, recording, absent_server, tmp_path, near) -> None:
    code, _, err = fleetmap(
        "localize", recording, "--server", absent_server, "--near", near, "--trajectory", tmp_path / "x.tum"
    )
    assert code == 2
    assert "LAT,LON" in err


def test_a_recording_that_is_not_there_is_one_line(fleetmap, map_package, tmp_path) -> None:
    code, out, err = fleetmap(
        "localize", tmp_path / "none.mcap", "--map", map_package, "--trajectory", tmp_path / "x.tum"
    )
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert "none.mcap" in err
    assert err.count("\n") == 1


def test_a_folder_that_is_no_map_is_one_line(fleetmap, recording, tmp_path) -> None:
    (tmp_path / "empty").mkdir()
    for folder in ("absent", "empty"):
        code, out, err = fleetmap(
            "localize", recording, "--map", tmp_path / folder, "--trajectory", tmp_path / "x.tum"
        )
        assert (code, out) == (2, "")
        assert err.startswith("error: ")
        assert str(tmp_path / folder) in err
        assert err.count("\n") == 1


def test_a_server_that_is_not_there_is_one_line(fleetmap, recording, absent_server, tmp_path) -> None:
    code, out, err = fleetmap("localize", recording, "--server", absent_server, "--trajectory", tmp_path / "x.tum")
    assert (code, out) == (1, "")
    assert absent_server in err
    assert err.count("\n") == 1
    assert not (tmp_path / "x.tum").exists()


def test_a_server_without_maps_is_one_line(fleetmap, recording, map_server, tmp_path) -> None:
    code, out, err = fleetmap("localize", recording, "--server", map_server, "--trajectory", tmp_path / "x.tum")
    assert (code, out) == (1, "")
    assert f"map server {map_server} has no map" in err
    assert err.count("\n") == 1


def test_a_recording_without_calibration_is_one_line(fleetmap, map_package, tmp_path) -> None:
    path = record(tmp_path / "bare.mcap", [np.zeros((200, 320))], camera=None)
    code, _, err = fleetmap("localize", path, "--map", map_package, "--trajectory", tmp_path / "x.tum")
    assert code == 2
    assert err.startswith("error: ")
    assert err.count("\n") == 1


@pytest.mark.parametrize("kind", ["noise", "black"])
def test_images_that_show_nothing_of_the_map_give_no_pose_and_no_file(
    fleetmap, map_package, tmp_path, kind
) -> None:
    rng = np.random.default_rng(0)
    images = [rng.uniform(0, 255, (200, 320)) if kind == "noise" else np.zeros((200, 320)) for _ in range(3)]
    path = record(tmp_path / "second.mcap", images)
    outputs = [word for name in ("x.geojson", "x.mcap", "x.csv") for word in ("--output", tmp_path / name)]
    code, out, err = fleetmap("localize", path, "--map", map_package, "--trajectory", tmp_path / "x.tum", *outputs)
    assert (code, out) == (1, "")
    assert err.startswith("error: not one of 3 images could be localised")
    assert err.count("\n") == 1
    assert [path.name for path in tmp_path.glob("x.*")] == ["x.csv"]
    assert (tmp_path / "x.csv").read_text().count(",none,") == 3  # with the reasons


def test_a_map_whose_tiles_are_all_tampered_with_gives_no_pose(fleetmap, recording, map_package, tmp_path) -> None:
    for part in (map_package / "parts").iterdir():
        data = bytearray(part.read_bytes())
        data[-1] ^= 1
        part.write_bytes(data)
    code, out, err = fleetmap("localize", recording, "--map", map_package, "--trajectory", tmp_path / "x.tum")
    assert (code, out) == (1, "")
    assert not (tmp_path / "x.tum").exists()
    *warnings, error = err.splitlines()
    assert error.startswith("error: not one of 3 images could be localised")
    assert all("damaged or was tampered with" in warning for warning in warnings)
