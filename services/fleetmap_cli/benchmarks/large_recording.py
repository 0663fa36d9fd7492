"""A recording as large as one likes, from a few images over and over."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from itertools import count, cycle
from pathlib import Path

import numpy as np

from fleetmap.camera import Camera
from fleetmap.drive import START_NS, GnssFix
from fleetmap.drives.ros2_writer import DriveWriter

_FRAME_NS = 100_000_000
_METRES_PER_DEGREE = 111_320.0


def write_large_recording(path: Path, jpegs: Sequence[bytes], camera: Camera, size_bytes: int) -> int:
    """Write images at 10 Hz, with a fix for each, until their bytes exceed a size; returns how many.

    Raises:
        StorageError: the disk is full or refuses.
    """
    written_bytes = 0
    with DriveWriter(path, camera) as writer:
        for number, jpeg in zip(count(), cycle(jpegs)):
            if written_bytes >= size_bytes:
                break
            stamp_ns = START_NS + number * _FRAME_NS
            writer.write_jpeg(stamp_ns, jpeg)
            lat_deg = 49.0 + number / _METRES_PER_DEGREE  # a metre an image
            writer.write_fix(GnssFix(stamp_ns, lat_deg, 8.4, 120.0, np.eye(3) * 0.0025), "camera")
            written_bytes += len(jpeg)
    return number


def free_bytes(folder: Path) -> int:
    """Room on the disk of a folder."""
    return shutil.disk_usage(folder).free
