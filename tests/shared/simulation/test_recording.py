"""A simulated drive, recorded and opened again, is the drive that was simulated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.drive import Drive
from fleetmap.drives import open_drive
from fleetmap.errors import InputError, OutputExistsError
from fleetmap.geodesy import UtmGrid
from fleetmap.simulation.driving import drive_along
from fleetmap.simulation.look import Look
from fleetmap.simulation.recording import record_drive, simulate_drive
from fleetmap.simulation.street import Street
from fleetmap.trajectory import read_trajectory

_ANTENNA = (0.3, -0.8, -1.2)


def test_a_recording_holds_camera_images_fixes_and_antenna(street: Street, camera: Camera, tmp_path: Path) -> None:
    trajectory = drive_along(street, end_m=8.0, seed=3)
    settings = {
        "camera": camera,
        "trajectory": trajectory,
        "look": Look(seed=9),
        "gnss": "rtk",
        "gnss_interval_s": 0.25,
        "antenna_in_cam_m": _ANTENNA,
        "seed": 7,
    }
    simulated: Drive = simulate_drive(street, **settings)
    reference = record_drive(street, tmp_path / "survey.mcap", **settings)
    recorded = open_drive(tmp_path / "survey.mcap")

    assert recorded.camera == simulated.camera == camera
    assert recorded.frame_count == simulated.frame_count == len(trajectory)
    for ours, theirs in zip(simulated.frames(), recorded.frames(), strict=True):
        assert ours.stamp_ns == theirs.stamp_ns
        assert np.abs(ours.image.astype(float) - theirs.image).mean() < 2.0  # JPEG
    assert [fix.stamp_ns for fix in recorded.gnss_fixes()] == [fix.stamp_ns for fix in simulated.gnss_fixes()]
    np.testing.assert_allclose(
        [(fix.lat_deg, fix.lon_deg, fix.height_m) for fix in recorded.gnss_fixes()],
        [(fix.lat_deg, fix.lon_deg, fix.height_m) for fix in simulated.gnss_fixes()],
        rtol=1e-12,
    )
    np.testing.assert_allclose(recorded.antenna().position_in_cam_m, _ANTENNA, atol=1e-9)
    assert recorded.antenna().source == simulated.antenna().source == "static transform"

    assert reference == tmp_path / "survey.reference.tum"
    written = read_trajectory(reference)
    np.testing.assert_array_equal(written.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_allclose(written.positions_m, trajectory.positions_m, atol=1e-6)
    np.testing.assert_allclose(written.rotations, trajectory.rotations, atol=1e-8)


def test_fixes_stand_where_the_antenna_is(street: Street) -> None:
    camera = Camera(64, 48, 40.0, 40.0, 31.5, 23.5)
    trajectory = drive_along(street, seed=3)
    drive = simulate_drive(street, camera=camera, trajectory=trajectory, antenna_in_cam_m=_ANTENNA, seed=1)
    truth = trajectory.positions_m + trajectory.rotations @ np.array(_ANTENNA)
    times = [(fix.stamp_ns - int(trajectory.stamps_ns[0])) * 1e-9 for fix in drive.fixes]
    known = (trajectory.stamps_ns - trajectory.stamps_ns[0]) * 1e-9
    expected = np.stack([np.interp(times, known, truth[:, i]) for i in range(3)], axis=1)
    grid = UtmGrid(trajectory.epsg)
    lat, lon, height = (
        np.array([getattr(fix, n) for fix in drive.fixes]) for n in ("lat_deg", "lon_deg", "height_m")
    )
    error_m = grid.from_geodetic(lat, lon, height) - expected
    assert 0.04 < error_m.std() < 0.06
    assert np.abs(error_m.mean(axis=0)).max() < 0.03


def test_a_drive_without_gnss_has_no_fixes_and_a_gap_has_none_inside(street: Street) -> None:
    camera, trajectory = Camera(64, 48, 40.0, 40.0, 31.5, 23.5), drive_along(street)
    assert simulate_drive(street, camera=camera, trajectory=trajectory, gnss=None).gnss_fixes() == []
    fixes = simulate_drive(street, camera=camera, trajectory=trajectory, gnss_gap_s=(1.0, 2.0)).gnss_fixes()
    seconds = np.array([fix.stamp_ns - int(trajectory.stamps_ns[0]) for fix in fixes]) * 1e-9
    assert len(fixes) > 20
    assert not ((seconds >= 1.0) & (seconds < 3.0)).any()


def test_the_same_seeds_give_the_same_recording(street: Street, tmp_path: Path) -> None:
    camera, trajectory = Camera(96, 64, 60.0, 60.0, 47.5, 31.5), drive_along(street, end_m=4.0)
    for name in ("a", "b"):
        record_drive(street, tmp_path / f"{name}.mcap", camera=camera, trajectory=trajectory)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_what_makes_no_sense_is_refused(street: Street, tmp_path: Path) -> None:
    camera, trajectory = Camera(96, 64, 60.0, 60.0, 47.5, 31.5), drive_along(street, end_m=4.0)
    with pytest.raises(InputError, match="no GNSS error model 'perfect'"):
        simulate_drive(street, camera=camera, trajectory=trajectory, gnss="perfect")
    (tmp_path / "there.mcap").write_bytes(b"precious")
    with pytest.raises(OutputExistsError, match=r"there\.mcap"):
        record_drive(street, tmp_path / "there.mcap", camera=camera, trajectory=trajectory)
    assert (tmp_path / "there.mcap").read_bytes() == b"precious"
