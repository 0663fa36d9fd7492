"""Fixtures that every room's tests share."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.drive import Frame, GnssFix
from fleetmap.drives import open_drive
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.geometry import rotation_angle_rad
from fleetmap.simulation.driving import drive_along
from fleetmap.simulation.recording import record_drive
from fleetmap.simulation.simulated_drive import simulate_drive
from fleetmap.simulation.street import Street, build_street
from fleetmap.trajectory import Trajectory
from fleetmap_cli.main import main

FLEETMAP = [sys.executable, "-c", "from fleetmap_cli.main import main; main()"]

# A shell lets its background jobs ignore Ctrl-C, and nohup the end of its terminal; children inherit that, and the
# tests of both would test nothing.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


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
    drive = simulate_drive(street, camera=camera, trajectory=truth, gnss_interval_s=1.0, seed=2)
    return Survey(street, recording, record_drive(drive, recording).reference, truth)


@dataclass(frozen=True)
class MappedSurvey:
    """What ``fleetmap map`` made of the survey drive in a process of its own."""

    package: Path
    trajectory: Path
    run: subprocess.CompletedProcess[str]


@pytest.fixture(scope="session")
def mapped_survey(survey: Survey, tmp_path_factory: pytest.TempPathFactory) -> MappedSurvey:
    """The survey drive mapped as a user does it."""
    folder = tmp_path_factory.mktemp("maps")
    package, trajectory = folder / "my_map", folder / "survey.tum"
    arguments = ["map", str(survey.recording), "--output", str(package), "--trajectory", str(trajectory)]
    run = subprocess.run([*FLEETMAP, *arguments], capture_output=True, text=True, timeout=300, check=False)
    return MappedSurvey(package, trajectory, run)


@pytest.fixture(scope="session")
def survey_frames(survey: Survey) -> tuple[Frame, ...]:
    """The decoded images of the survey drive."""
    return tuple(open_drive(survey.recording).frames())


@pytest.fixture(scope="session")
def write_drive(survey: Survey) -> Callable[..., Path]:
    """Writes a recording of some images of the survey drive, or of others in their place."""

    def write(
        path: Path,
        frames: Iterable[Frame],
        *,
        fixes: Iterable[GnssFix] | None = None,
        calibrated: bool = True,
        gnss_frame_id: str = "camera",
    ) -> Path:
        drive = open_drive(survey.recording)
        with DriveWriter(path, drive.camera if calibrated else None) as writer:
            for frame in frames:
                writer.write_image(frame.stamp_ns, frame.image)
            for fix in drive.gnss_fixes() if fixes is None else fixes:
                writer.write_fix(fix, gnss_frame_id)
        return path

    return write


@pytest.fixture
def fleetmap(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs ``fleetmap`` with arguments: exit code, stdout, stderr."""

    def call(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as done:
            main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return int(done.value.code or 0), out, err

    return call
