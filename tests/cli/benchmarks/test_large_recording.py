"""A recording of any size, and the memory of reading it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.drives import open_drive
from fleetmap_cli.benchmarks.large_recording import free_bytes, write_large_recording
from fleetmap_cli.benchmarks.reading import memory_bytes
from fleetmap_cli.benchmarks.workbench import Workbench

CAMERA = Camera(320, 240, 250.0, 250.0, 159.5, 119.5)


@pytest.fixture(scope="module")
def jpegs():
    noise = np.random.default_rng(0).integers(0, 256, (3, 240, 320), dtype=np.uint8)
    return [cv2.imencode(".jpg", image)[1].tobytes() for image in noise]


def test_it_is_as_large_as_asked_and_a_drive(tmp_path, jpegs):
    count = write_large_recording(tmp_path / "large.mcap", jpegs, CAMERA, 5_000_000)
    assert 5_000_000 < (tmp_path / "large.mcap").stat().st_size < 5_400_000
    drive = open_drive(tmp_path / "large.mcap")
    stamps_ns = [frame.stamp_ns for frame in drive.frames()]
    assert len(stamps_ns) == len(drive.gnss_fixes()) == count
    assert set(np.diff(stamps_ns)) == {100_000_000}


def test_reading_it_in_a_process_of_its_own_takes_memory_that_does_not_grow_with_it(tmp_path, jpegs):
    bench = Workbench(tmp_path, tmp_path, tmp_path)
    memory = []
    for size_bytes in (2_000_000, 80_000_000):
        count = write_large_recording(tmp_path / "large.mcap", jpegs, CAMERA, size_bytes)
        read = bench.python_module("fleetmap_cli.benchmarks.reading", "large.mcap").json()
        assert read["images"] == read["fixes"] == count
        assert read["size_bytes"] > size_bytes
        memory.append(read["memory_bytes"])
        (tmp_path / "large.mcap").unlink()
    assert 0 < memory[0] < 200_000_000
    assert memory[1] < memory[0] + 20_000_000


def test_the_memory_that_is_measured_is_this_process_own():
    before = memory_bytes("VmHWM")
    block = np.ones(12_000_000)
    assert memory_bytes("VmRSS") > 90_000_000
    assert memory_bytes("VmHWM") >= before
    assert len(block) == 12_000_000


def test_free_disk_is_asked_of_the_folder_itself(tmp_path):
    assert 0 < free_bytes(tmp_path) < 1e16
