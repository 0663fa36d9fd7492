"""Images as other eyes would have seen them, and how two cameras stand to each other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from fleetmap.camera import Camera
from fleetmap.covariances import PoseCovariances
from fleetmap.drive import GnssFix
from fleetmap.drives import open_drive
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.evaluation import evaluate_trajectory
from fleetmap.geometry import Pose, rotations_from_quat_xyzw, so3_exp, so3_log
from fleetmap.trajectory import Trajectory, read_trajectory, write_trajectory
from fleetmap_cli.benchmarks.camera_pair import CameraPair, map_from_recorded
from fleetmap_cli.benchmarks.localizer_queries import wrong_poses
from fleetmap_cli.benchmarks.perturbing import Perturbation, cam_from_turned, halved, perturb, turned

CAMERA = Camera(321, 180, 260.0, 255.0, 158.0, 93.0, (-0.3, 0.1, 1e-3, -5e-4, 0.0))
T0_NS = 1_700_000_000_000_000_000


def seen_by(camera: Camera, world_from_cam: np.ndarray) -> np.ndarray:
    """A sky whose grey level tells azimuth and elevation, as a camera sees it."""
    grid = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), axis=2)
    rays = camera.unproject(grid.reshape(-1, 2).astype(np.float64)) @ world_from_cam.T
    azimuth, elevation = (
        np.arctan2(rays[:, 0], rays[:, 2]),
        np.arctan2(rays[:, 1], np.hypot(rays[:, 0], rays[:, 2])),
    )
    levels = 128.0 + 60.0 * np.sin(5.0 * azimuth) + 40.0 * np.sin(6.0 * elevation)
    return np.rint(levels).astype(np.uint8).reshape(camera.height_px, camera.width_px)


@pytest.mark.parametrize("yaw_deg", [8.0, -15.0])
def test_a_turned_image_is_what_the_turned_camera_sees(yaw_deg: float) -> None:
    image = turned(seen_by(CAMERA, np.eye(3)), CAMERA, yaw_deg)
    truth = seen_by(CAMERA, cam_from_turned(yaw_deg))
    known = image > 0
    assert 0.6 < known.mean() < 0.95  # black where the first camera did not look
    missing = known[:, -20:].mean() if yaw_deg > 0 else known[:, :20].mean()
    assert missing < 0.05
    off = np.abs(image.astype(int) - truth)[known]
    assert np.percentile(off, 98) <= 1.0


def test_half_the_resolution_is_the_same_camera_of_the_same_scene() -> None:
    image = Perturbation(half=True).apply(seen_by(CAMERA, np.eye(3)), CAMERA, np.random.default_rng(0))
    truth = seen_by(halved(CAMERA), np.eye(3))
    assert image.shape == truth.shape == (90, 160)
    off = np.abs(image.astype(int) - truth)
    assert off.max() <= 2
    shifted = replace(halved(CAMERA), cx_px=CAMERA.cx_px / 2.0)  # a quarter of a pixel, the classic mistake
    assert (
        np.abs(image.astype(float) - truth).mean()
        < 0.7 * np.abs(image.astype(float) - seen_by(shifted, np.eye(3))).mean()
    )


def test_gamma_darkens_and_noise_has_the_sigma_asked_for() -> None:
    rng = np.random.default_rng(1)
    grey = np.full((100, 200), 128, np.uint8)
    assert np.unique(Perturbation(gamma=2.0).apply(grey, CAMERA, rng)).tolist() == [64]
    noisy = Perturbation(noise_sigma=4.0).apply(grey, CAMERA, rng)
    assert noisy.mean() == pytest.approx(128.0, abs=0.2)
    assert noisy.std() == pytest.approx(4.0, rel=0.05)


def test_a_recording_keeps_its_fixes_and_its_reference_becomes_the_new_camera_s(tmp_path: Path) -> None:
    """Turned by 8 deg; the antenna stays where it was, which from the turned camera is elsewhere."""
    stamps_ns = T0_NS + np.arange(5) * 100_000_000
    rotations = so3_exp(np.array([[0.1, 0.2, 0.1 * i] for i in range(5)]))
    reference = Trajectory(32632, stamps_ns, np.arange(15.0).reshape(5, 3), rotations)
    write_trajectory(tmp_path / "in.reference.tum", reference)
    with DriveWriter(tmp_path / "in.mcap", CAMERA) as writer:
        writer.write_static_transform("camera", "antenna", Pose(np.eye(3), np.array([0.0, -1.0, 2.0])))
        for stamp_ns in stamps_ns.tolist():
            writer.write_image(stamp_ns, seen_by(CAMERA, np.eye(3)))
            writer.write_fix(GnssFix(stamp_ns, 48.0, 11.0, 400.0, np.eye(3)), "antenna")
    names = [str(tmp_path / "in.mcap"), str(tmp_path / "out.mcap")]
    done = CliRunner().invoke(perturb, [*names, "--yaw-deg", "8", "--images", "odd"])
    assert done.exit_code == 0, done.output
    drive = open_drive(tmp_path / "out.mcap")
    assert [frame.stamp_ns for frame in drive.frames()] == stamps_ns[1::2].tolist()
    assert len(drive.gnss_fixes()) == 5
    turn = cam_from_turned(8.0)
    assert turn @ drive.antenna().position_in_cam_m == pytest.approx([0.0, -1.0, 2.0])
    seen = read_trajectory(tmp_path / "out.reference.tum")
    assert seen.stamps_ns.tolist() == stamps_ns[1::2].tolist()
    assert seen.positions_m == pytest.approx(reference.positions_m[1::2])
    assert seen.rotations == pytest.approx(rotations[1::2] @ turn, abs=1e-8)


def test_a_moved_image_centre_turns_a_camera_s_axes() -> None:
    """Of a long lens, whose rays hardly spread; a wide one's are turned less at its borders."""
    recorded = Camera(1392, 512, 4000.0, 4000.0, 690.0, 233.0)
    turn_deg = np.degrees(so3_log(map_from_recorded(recorded, replace(recorded, cx_px=770.0))))
    assert turn_deg == pytest.approx([0.0, -np.degrees(80.0 / 4000.0), 0.0], abs=0.02)
    assert map_from_recorded(recorded, recorded) == pytest.approx(np.eye(3), abs=1e-12)


def test_a_pair_is_told_to_evaluate_in_the_axes_of_the_map() -> None:
    recorded = Camera(1392, 512, 984.0, 984.0, 690.0, 233.0)
    mounting = Pose(so3_exp(np.array([0.01, -0.02, 0.03])), np.array([0.54, 0.0, 0.0]))
    pair = CameraPair.of(mounting, recorded, replace(recorded, cx_px=710.0))
    assert 0.9 < pair.axes_turned_deg < 1.16
    _, offset, _, rotation = pair.options.split()
    turn = map_from_recorded(recorded, replace(recorded, cx_px=710.0))
    assert [float(word) for word in offset.split(",")] == pytest.approx(turn @ [0.54, 0.0, 0.0], abs=1e-4)
    told = rotations_from_quat_xyzw(np.array([float(word) for word in rotation.split(",")]))
    assert told == pytest.approx(turn @ mounting.rotation, abs=1e-5)


def test_a_wrong_pose_may_say_so_itself() -> None:
    """Of four poses one is right, one 3 m off and sure, one 3 m off and unsure, one turned by 6 deg and sure."""
    rotations = np.tile(np.eye(3), (4, 1, 1))
    truth = Trajectory(32632, T0_NS + np.arange(4) * 10**8, np.arange(12.0).reshape(4, 3), rotations)
    turned_rotations = rotations.copy()
    turned_rotations[3] = so3_exp(np.array([0.0, np.radians(6.0), 0.0]))
    off_m = np.array([0.1, 3.0, 3.0, 0.0])[:, None] * [0.0, 1.0, 0.0]
    estimate = replace(truth, positions_m=truth.positions_m + off_m, rotations=turned_rotations)
    sigmas = np.array([0.1, 0.1, 2.0, 0.1])
    matrices = sigmas[:, None, None] ** 2 * np.diag([0.01, 0.01, 0.01, 1.0, 1.0, 1.0])
    wrong, unsaid = wrong_poses(evaluate_trajectory(estimate, truth), PoseCovariances(truth.stamps_ns, matrices))
    assert wrong.tolist() == [False, True, True, True]
    assert unsaid.tolist() == [False, True, False, True]
