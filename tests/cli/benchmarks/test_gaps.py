"""Recordings whose camera is blind at times, and what is counted in the dark."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from fleetmap.camera import Camera
from fleetmap.covariances import PoseCovariances
from fleetmap.drive import GnssFix, ImuSample, WheelSpeed
from fleetmap.drives.mcap_drive import McapDrive
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.evaluation import evaluate_trajectory
from fleetmap.geometry import CAM_FROM_BODY, Pose
from fleetmap.trajectory import Trajectory
from fleetmap_cli.benchmarks.blackening import blacken
from fleetmap_cli.benchmarks.localizer_gaps import Gaps

T0_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
COUNT = 101


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gaps") / "seen.mcap"
    picture = np.tile(np.arange(64, dtype=np.uint8) + 60, (48, 1))
    with DriveWriter(path, Camera(64, 48, 50.0, 50.0, 31.5, 23.5)) as writer:
        writer.write_static_transform("camera", "imu", Pose(CAM_FROM_BODY, np.array([0.1, 0.2, 0.3])))
        writer.write_static_transform("camera", "base_link", Pose(CAM_FROM_BODY, np.array([0.0, 1.5, -1.0])))
        writer.write_static_transform("camera", "gnss", Pose(np.eye(3), np.array([0.0, -1.0, 0.0])))
        for index in range(COUNT):
            stamp_ns = T0_NS + index * STEP_NS
            writer.write_image(stamp_ns, picture)
            writer.write_imu(ImuSample(stamp_ns, np.zeros(3), np.array([0.0, 0.0, 9.8])), "imu")
            writer.write_wheel_speed(WheelSpeed(stamp_ns, 3.0))
            writer.write_fix(GnssFix(stamp_ns, 49.0, 8.0, 100.0, np.eye(3)), "gnss")
    return path


def blackened(recording: Path, keep: str) -> McapDrive:
    target = recording.with_name(f"dark-{keep or 'nothing'}.mcap")
    words = [str(recording), str(target), "--every-s", "4", "--black-s", "2", "--keep", keep]
    assert CliRunner().invoke(blacken, words, catch_exceptions=False).exit_code == 0
    return McapDrive(target)


def test_two_of_every_four_seconds_are_black_and_the_rest_is_what_it_was(recording: Path) -> None:
    seen, dark = list(McapDrive(recording).frames()), list(blackened(recording, "").frames())
    assert [frame.stamp_ns for frame in dark] == [frame.stamp_ns for frame in seen]
    black = np.array([not frame.image.any() for frame in dark])
    assert np.flatnonzero(black).tolist() == [*range(40, 60)]  # that from 8 s would last to the drive's end
    assert all(np.array_equal(a.image, b.image) for a, b in zip(seen[:40], dark[:40], strict=True))


@pytest.mark.parametrize("keep", ["imu,wheel", "gnss"])
def test_only_what_is_kept_is_there_and_mounted_as_before(recording: Path, keep: str) -> None:
    seen, dark = McapDrive(recording), blackened(recording, keep)
    assert len(list(dark.imu_samples())) == len(list(dark.wheel_speeds())) == (COUNT if "imu" in keep else 0)
    assert len(dark.gnss_fixes()) == (COUNT if keep == "gnss" else 0)
    if keep == "gnss":
        np.testing.assert_allclose(dark.antenna().position_in_cam_m, seen.antenna().position_in_cam_m, atol=1e-9)
        return
    for before, after in (
        (seen.imu_mounting(), dark.imu_mounting()),
        (seen.wheel_mounting(), dark.wheel_mounting()),
    ):
        assert before is not None
        assert after is not None
        np.testing.assert_allclose(after.cam_from_sensor.translation_m, before.cam_from_sensor.translation_m)


def test_errors_in_the_dark_are_judged_apart() -> None:
    """A metre off in the light, where nobody asks; two sigmas along one axis at the end of a gap."""
    stamps_ns = T0_NS + STEP_NS * np.arange(COUNT)
    truth = Trajectory(
        32632,
        stamps_ns,
        np.stack([np.arange(COUNT), *np.zeros((2, COUNT))], axis=1),
        np.tile(np.eye(3), (COUNT, 1, 1)),
    )
    gaps = Gaps(T0_NS, [(4.0, 2.0), (7.0, 1.0)])
    dark = gaps.numbers(stamps_ns) >= 0
    assert np.flatnonzero(dark).tolist() == [*range(40, 60), *range(70, 80)]
    positions_m = truth.positions_m + np.where(dark, 0.2, 1.0)[:, None] * np.array([0.0, 1.0, 0.0])
    estimate = Trajectory(32632, stamps_ns, positions_m, truth.rotations)
    covariances = PoseCovariances(stamps_ns, np.tile(0.01 * np.eye(6), (COUNT, 1, 1)))
    figures = gaps.errors(evaluate_trajectory(estimate, truth), covariances)
    assert figures["median end error m"] == figures["max end error m"] == pytest.approx(0.2)
    assert figures["end sigma m"] == pytest.approx(0.1)
    assert figures["NEES"] == pytest.approx(4.0)


def test_kinds_of_poses_are_counted_in_the_dark_only(tmp_path: Path) -> None:
    kinds = ["measured"] * 10 + ["predicted"] * 6 + ["none"] * 3 + ["measured"] * 2
    rows = [f"{T0_NS + index * STEP_NS},{kind}" for index, kind in enumerate(kinds)]
    (tmp_path / "poses.csv").write_text("\n".join(["stamp_ns,kind", *rows]) + "\n")
    figures = Gaps(T0_NS, [(1.0, 1.0)]).kinds(tmp_path / "poses.csv")
    assert figures == {"gaps": 1, "predicted": "6 of 10", "measured in the dark": 1}
