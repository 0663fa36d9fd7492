"""Drives through the simulated world, as rows of benchmarks use them."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.camera_file import write_camera
from fleetmap.drives import open_drive
from fleetmap.vision.trackability import Trackability, measure_trackability
from fleetmap_cli.benchmarks.workbench import Workbench

KITTI_CAMERA = Camera(1241, 376, 718.856, 718.856, 607.1928, 185.2157)  # KITTI odometry 00, rectified


def write_kitti_camera(bench: Workbench) -> str:
    """Put KITTI's camera into the row's folder; returns the file's name."""
    write_camera(bench.folder / "kitti.yaml", KITTI_CAMERA)
    return "kitti.yaml"


def trackability_of(path: Path, image_count: int) -> Trackability:
    """Measured on a recording's first images."""
    drive = open_drive(path)
    return measure_trackability((frame.image for frame in islice(drive.frames(), image_count)), drive.camera)


def image_of(path: Path, number: int) -> NDArray[np.uint8]:
    """An image of a recording."""
    return next(islice(open_drive(path).frames(), number, None)).image
