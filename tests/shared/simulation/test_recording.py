"""A simulated drive, recorded and opened again, is the drive that was simulated."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from fleetmap.camera import Camera
from fleetmap.drive import Drive
from fleetmap.drives import open_drive
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.errors import InputError, OutputExistsError
from fleetmap.geodesy import UtmGrid
from fleetmap.simulation.depth_camera import DepthErrorModel
from fleetmap.simulation.driving import drive_along, image_stamps_ns, plan_motion
from fleetmap.simulation.imu import IMU_ERROR_MODELS
from fleetmap.simulation.lidar import LidarModel
from fleetmap.simulation.look import Look
from fleetmap.simulation.recording import record_drive
from fleetmap.simulation.simulated_drive import Sensors, simulate_drive
from fleetmap.simulation.street import Street
from fleetmap.simulation.wheel import WheelErrorModel
from fleetmap.simulation.world import build_world
from fleetmap.trajectory import read_trajectory

_ANTENNA = (0.3, -0.8, -1.2)
SMALL = Camera(96, 64, 60.0, 60.0, 47.5, 31.5)


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
    reference = record_drive(simulated, tmp_path / "survey.mcap").reference
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
    for name, workers in (("a", 1), ("b", 2)):
        drive = simulate_drive(street, camera=camera, trajectory=trajectory)
        record_drive(drive, tmp_path / f"{name}.mcap", workers=workers)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_what_makes_no_sense_is_refused(street: Street, tmp_path: Path) -> None:
    camera, trajectory = Camera(96, 64, 60.0, 60.0, 47.5, 31.5), drive_along(street, end_m=4.0)
    with pytest.raises(InputError, match="no GNSS error model 'perfect'"):
        simulate_drive(street, camera=camera, trajectory=trajectory, gnss="perfect")
    (tmp_path / "there.mcap").write_bytes(b"precious")
    with pytest.raises(OutputExistsError, match=r"there\.mcap"):
        record_drive(simulate_drive(street, camera=camera, trajectory=trajectory), tmp_path / "there.mcap")
    assert (tmp_path / "there.mcap").read_bytes() == b"precious"


def test_every_sensor_is_in_the_recording_in_time_order(tmp_path: Path) -> None:
    """Read by rosbags itself, not by what wrote it."""
    world = build_world(3, length_m=200.0, moving_cars_per_km=40.0)
    motion = plan_motion(world, end_m=7.6, seed=1)
    sensors = Sensors(IMU_ERROR_MODELS["consumer"], WheelErrorModel(), DepthErrorModel(), LidarModel())
    drive = simulate_drive(
        world,
        camera=Camera(160, 96, 90.0, 90.0, 79.5, 47.5),
        motion=motion,
        trajectory=motion.trajectory(image_stamps_ns(motion, 10.0)),
        sensors=sensors,
        readout_s=0.02,
        antenna_in_cam_m=_ANTENNA,
    )
    recorded = record_drive(drive, tmp_path / "all.mcap")
    with AnyReader([recorded.recording]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        messages = {
            c.topic: [(t, reader.deserialize(raw, c.msgtype)) for _, t, raw in reader.messages([c])]
            for c in reader.connections
        }
    assert len(drive.trajectory) == 10
    assert counts["/camera/image/compressed"] == counts["/camera/depth/image"] == counts["/scan"] == 10
    assert 188 <= counts["/imu/data"] <= 193  # 0.95 s
    assert 47 <= counts["/vehicle/speed"] <= 49
    assert {t.child_frame_id for t in messages["/tf_static"][0][1].transforms} == {
        "gnss",
        "imu",
        "base_link",
        "laser",
    }

    scan = messages["/scan"][3][1]
    ranges_m = np.array(scan.ranges)
    assert len(ranges_m) == 541
    assert 0.1 < np.isfinite(ranges_m).mean() <= 1.0
    np.testing.assert_allclose(ranges_m, drive.scan(messages["/scan"][3][0]).astype(np.float32))
    depth = messages["/camera/depth/image"][3][1]
    depth_m = depth.data.view("<u2").reshape(96, 160) * 1e-3
    below = (slice(70, 96), slice(20, 140))  # the road, 2 to 6 m ahead
    np.testing.assert_allclose(depth_m[below], drive.depth(3)[below], atol=6e-4)
    assert 2.0 < np.median(depth_m[below]) < 7.0

    theirs = [sample.linear_acceleration_m_s2 for sample in drive.imu_samples()]
    ours = [[(a := m.linear_acceleration).x, a.y, a.z] for _, m in messages["/imu/data"]]
    np.testing.assert_allclose(ours, theirs)
    assert 9.0 < np.mean([z for *_, z in ours]) < 10.6
    speeds = [m.twist.linear.x for _, m in messages["/vehicle/speed"]]
    assert 7.5 < np.mean(speeds) < 8.5


def test_a_rolling_shutter_skews_what_passes_by(street: Street) -> None:
    camera, motion = Camera(320, 240, 200.0, 200.0, 159.5, 119.5), plan_motion(street, speed_mps=15.0, seed=3)
    trajectory = motion.trajectory(image_stamps_ns(motion, 5.0))
    settings = {"camera": camera, "motion": motion, "trajectory": trajectory, "look": Look(noise_sigma=0.0)}
    still, rolling = (simulate_drive(street, **settings, readout_s=s).frame(4).image for s in (0.0, 0.04))
    difference = np.abs(still.astype(float) - rolling).mean(axis=1)
    assert difference[116:124].mean() < 2.0  # the middle row is exposed at the stamp
    assert difference[:40].mean() + difference[-40:].mean() > 3.0 * difference[116:124].mean()


def test_markers_are_written_apart_where_the_images_show_them(tmp_path: Path) -> None:
    world = build_world(3, length_m=200.0, moving_cars_per_km=0.0)
    motion, camera = plan_motion(world), Camera(960, 480, 700.0, 700.0, 479.5, 239.5)
    drive = simulate_drive(
        world, camera=camera, motion=motion, trajectory=motion.trajectory(image_stamps_ns(motion, 2.0)), gnss=None
    )
    tiny = replace(drive, camera=Camera(8, 8, 6.0, 6.0, 3.5, 3.5))
    recorded = record_drive(tiny, tmp_path / "survey.mcap")
    assert recorded.markers == tmp_path / "survey.markers.json"
    content = json.loads(recorded.markers.read_text())
    assert content["epsg"] == world.anchor.epsg
    seen = 0
    for marker in content["markers"]:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, marker["dictionary"]))
        corners_in_map = world.anchor.map_from_utm(np.array(marker["corners_utm_m"]))
        for index in range(drive.frame_count):
            corners_in_cam = drive.map_from_cam(index).inverse().transform(corners_in_map)
            expected = camera.project(corners_in_cam)
            if corners_in_cam[:, 2].max() > 16.0 or not camera.is_inside(expected, 20.0).all():
                continue
            found, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(drive.frame(index).image)
            for pixels in (
                p for p, n in zip(found, [] if ids is None else ids.ravel(), strict=True) if n == marker["id"]
            ):
                np.testing.assert_allclose(pixels.reshape(4, 2), expected, atol=2.5)
                seen += 1
    assert seen >= 2


def test_recording_without_markers_removes_those_of_the_drive_it_replaces(street: Street, tmp_path: Path) -> None:
    (tmp_path / "a.markers.json").write_text("{}")
    trajectory = drive_along(street, end_m=4.0)
    drive = simulate_drive(street, camera=Camera(96, 64, 60.0, 60.0, 47.5, 31.5), trajectory=trajectory)
    assert record_drive(drive, tmp_path / "a.mcap", force=True).markers is None
    assert not (tmp_path / "a.markers.json").exists()


def test_an_interrupted_recording_leaves_nothing(
    street: Street, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera, trajectory = Camera(96, 64, 60.0, 60.0, 47.5, 31.5), drive_along(street, end_m=4.0)
    drive = simulate_drive(street, camera=camera, trajectory=trajectory)

    def interrupted(self: DriveWriter, stamp_ns: int, jpeg: bytes) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(DriveWriter, "write_jpeg", interrupted)
    with pytest.raises(KeyboardInterrupt):
        record_drive(drive, tmp_path / "a.mcap")
    assert list(tmp_path.iterdir()) == []


def test_images_are_taken_over_from_a_recording_of_the_same_drive_only(street: Street, tmp_path: Path) -> None:
    settings = {"camera": SMALL, "look": Look(seed=9), "seed": 7}
    trajectory = drive_along(street, end_m=20.0, seed=3)
    drive = simulate_drive(street, trajectory=trajectory, **settings)
    record_drive(drive, tmp_path / "first.mcap")
    without_fixes = replace(drive, fixes=())
    record_drive(without_fixes, tmp_path / "rendered.mcap")
    record_drive(without_fixes, tmp_path / "taken.mcap", images_from=tmp_path / "first.mcap")
    assert (tmp_path / "taken.mcap").read_bytes() == (tmp_path / "rendered.mcap").read_bytes()

    ends_elsewhere = trajectory.positions_m.copy()
    ends_elsewhere[-1, 0] += 0.3
    shifted = replace(trajectory, stamps_ns=trajectory.stamps_ns + 1)
    others = {
        "its image 0 looks different": replace(drive, look=Look(seed=10)),
        f"its image {len(trajectory) - 1} looks different": replace(
            drive, trajectory=replace(trajectory, positions_m=ends_elsewhere)
        ),
        "its images have other stamps": replace(drive, trajectory=shifted),
        "it has not": simulate_drive(street, trajectory=drive_along(street, end_m=10.0, seed=3), **settings),
    }
    for reason, other in others.items():
        with pytest.raises(InputError, match=f"does not show the drive that these options make: {reason}"):
            record_drive(other, tmp_path / "other.mcap", images_from=tmp_path / "first.mcap")
    assert list(tmp_path.glob("other.*")) == []
