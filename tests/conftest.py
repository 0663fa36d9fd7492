"""Fixtures that every room's tests share."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import rotation_angle_rad
from fleetmap.simulation.driving import drive_along
from fleetmap.simulation.recording import record_drive
from fleetmap.simulation.street import Street, build_street
from fleetmap.trajectory import Trajectory


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of real recordings; tests that need it are skipped where it is absent."""
    default = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"
    folder = Path(os.environ.get("FLEETMAP_DATA", default)).resolve()
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}; set FLEETMAP_DATA to their folder")
    return folder


@pytest.fixture(scope="session")
def drives_folder(data_folder: Path) -> Path:
    """The folder of real KITTI drives."""
    return data_folder / "drives"


@dataclass(frozen=True)
class Survey:
    """A survey drive through a simulated street, recorded, with the truth beside it."""

    street: Street
    recording: Path
    reference: Path
    truth: Trajectory

    def errors_m(self, estimate: Trajectory) -> NDArray[np.float64]:
        """Distance of each estimated position from the truth at its stamp."""
        return np.linalg.norm(estimate.positions_m - self.truth.positions_m[self._rows(estimate)], axis=1)

    def errors_deg(self, estimate: Trajectory) -> NDArray[np.float64]:
        """Angle of each estimated rotation to the truth at its stamp."""
        true = self.truth.rotations[self._rows(estimate)]
        return np.degrees(rotation_angle_rad(np.swapaxes(estimate.rotations, 1, 2) @ true))

    def _rows(self, estimate: Trajectory) -> NDArray[np.int64]:
        microseconds = self.truth.stamps_ns // 1000  # what a TUM file keeps
        rows = np.searchsorted(microseconds, estimate.stamps_ns // 1000)
        assert np.array_equal(microseconds[rows], estimate.stamps_ns // 1000)
        return rows


@pytest.fixture(scope="session")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Survey:
    """60 m around a corner in 7.5 s, with an RTK fix a second."""
    street = build_street(3, 60.0)
    camera = Camera(640, 320, 430.0, 430.0, 319.5, 159.5)
    truth = drive_along(street, seed=2)
    recording = tmp_path_factory.mktemp("survey") / "survey.mcap"
    reference = record_drive(street, recording, camera=camera, trajectory=truth, gnss_interval_s=1.0, seed=2)
    return Survey(street, recording, reference, truth)
