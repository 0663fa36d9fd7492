"""A lidar measures the distances that a room has, and the drive through it bends its scan."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Pose
from fleetmap.simulation.atlas import build_atlas
from fleetmap.simulation.lidar import LidarModel
from fleetmap.simulation.motion import Motion, motion_through
from fleetmap.simulation.mounting import Mounting
from fleetmap.simulation.surfaces import SurfaceBuilder
from fleetmap.simulation.world import Scene

_LOOKING_NORTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # map_from_cam
_CAM_FROM_LIDAR = Pose(Mounting().cam_from_lidar.rotation, np.zeros(3))


@pytest.fixture(scope="module")
def room() -> Scene:
    """Walls 8 m west, 4 m east and 20 m north of the origin, seen from inside; open to the south."""
    builder = SurfaceBuilder(np.array([0.0, 0.0, 1.0]))
    paint = builder.add_texture(np.full((64, 64), 128, dtype=np.uint8))

    def wall(start: tuple[float, float], end: tuple[float, float]) -> None:
        (x0, y0), (x1, y1) = start, end
        builder.add_quad(
            np.array([[x0, y0, 3.0], [x1, y1, 3.0], [x1, y1, -3.0], [x0, y0, -3.0]]), paint, two_sided=True
        )

    wall((-8.0, -5.0), (-8.0, 20.0))
    wall((-8.0, 20.0), (4.0, 20.0))
    wall((4.0, 20.0), (4.0, -5.0))
    return Scene(builder.surfaces(), build_atlas(builder.textures))


def _northwards(speed_mps: float) -> Motion:
    knots = np.array([-1.0, 1.0])
    positions = np.array([[0.0, -speed_mps, 0.0], [0.0, speed_mps, 0.0]])
    anchor = UtmAnchor(32632, 500_000, 5_401_888, 420)
    return motion_through(anchor, 0, knots, np.stack([_LOOKING_NORTH] * 2), positions, 1.0)


def test_beams_run_from_right_to_left_and_meet_the_walls(room: Scene) -> None:
    lidar, motion = LidarModel(), _northwards(0.0)
    ranges = lidar.true_ranges_m(room, motion, _CAM_FROM_LIDAR, 0.0) * motion.grid_scale
    angles = lidar.first_rad + lidar.step_rad * np.arange(lidar.beams)

    def at(angle_deg: float) -> float:
        return float(ranges[np.argmin(np.abs(angles - np.radians(angle_deg)))])

    assert at(0.0) == pytest.approx(20.0, abs=1e-6)
    assert at(90.0) == pytest.approx(8.0, abs=1e-6)
    assert at(-90.0) == pytest.approx(4.0, abs=1e-6)
    assert at(45.0) == pytest.approx(8.0 * np.sqrt(2.0), abs=1e-6)
    assert at(135.0) == np.inf
    true_m = lidar.true_ranges_m(room, motion, _CAM_FROM_LIDAR, 0.0)
    assert true_m[lidar.beams // 2] == pytest.approx(20.0 / 0.9996, abs=1e-4)  # metres on the ground


def test_a_drive_shifts_what_later_beams_see(room: Scene) -> None:
    lidar, speed_mps = LidarModel(), 20.0
    still = lidar.true_ranges_m(room, _northwards(0.0), _CAM_FROM_LIDAR, 0.0)
    moving = lidar.true_ranges_m(room, _northwards(speed_mps), _CAM_FROM_LIDAR, 0.0)
    middle = lidar.beams // 2
    assert 0.0 < lidar.scan_s < 1.0 / lidar.turns_per_s
    assert still[middle] - moving[middle] == pytest.approx(speed_mps * lidar.scan_s / 2.0, abs=0.02)


def test_noise_and_range_are_those_of_the_data_sheet() -> None:
    lidar = LidarModel()
    for distance_m, sigma_m in ((5.0, 0.01), (20.0, 0.03)):
        errors = lidar.measured(np.full(lidar.beams, distance_m), 17, seed=3) - distance_m
        assert 0.9 * sigma_m < errors.std() < 1.1 * sigma_m
    hidden = lidar.measured(np.where(np.arange(lidar.beams) % 2, 31.0, 0.05), 17, seed=3)
    assert np.all(np.isposinf(hidden))
