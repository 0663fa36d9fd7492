"""Reference poses in a data set's own room or hall, and where that place is taken to be."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from fleetmap.drive import GnssFix
from fleetmap.drives.conversion import SimulatedGnss, StampedImage, simulated_fixes
from fleetmap.errors import DriveError
from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import Array, Pose
from fleetmap.trajectory import Trajectory

LONGEST_INTERPOLATION_NS = 100_000_000  # motion capture loses sight: across longer gaps there is no reference
TRUTH_WITHOUT_SITE = "the truth is in the room's own frame; --origin LAT,LON,HEIGHT makes it a reference"


@dataclass(frozen=True)
class Site:
    """Where the origin of the data set's frame stands; its z axis points up, its x axis to grid east."""

    lat_deg: float
    lon_deg: float
    height_m: float  # above the ellipsoid


@dataclass(frozen=True)
class LocalPoses:
    """Poses ``local_from_sensor`` in a frame whose z axis points up."""

    table: Path  # the file they come from
    stamps_ns: np.ndarray  # (N,) int64, strictly increasing
    positions_m: Array  # (N, 3) float64
    quat_xyzw: Array  # (N, 4) float64


def read_local_poses(table: Path, rows: Iterable[tuple[int, int, Array]]) -> LocalPoses:
    """Poses from a table's rows: line number, stamp in ns, and x, y, z, qx, qy, qz, qw.

    Raises:
        DriveError: no rows, a row that is not later than the one before, or no unit quaternion.
    """
    stamps_ns: list[int] = []
    poses: list[Array] = []
    for number, stamp_ns, values in rows:
        if stamps_ns and stamp_ns <= stamps_ns[-1]:
            raise DriveError(f"{table} line {number} is not later than the pose before it")
        if abs(float(np.linalg.norm(values[3:])) - 1.0) > 1e-2:
            raise DriveError(f"{table} line {number} holds no unit quaternion")
        stamps_ns.append(stamp_ns)
        poses.append(values)
    if not poses:
        raise DriveError(f"{table} holds no poses")
    stacked = np.array(poses)
    return LocalPoses(table, np.array(stamps_ns, dtype=np.int64), stacked[:, :3], stacked[:, 3:])


def reference_at_site(
    poses: LocalPoses, sensor_from_cam: Pose, images: Sequence[StampedImage], site: Site
) -> Trajectory:
    """The camera's poses in UTM at the images' stamps, where the poses have no gap.

    Local metres are taken as grid metres (they differ by at most 0.4 mm/m at UTM's point scale).

    Raises:
        DriveError: no image lies within the poses' time.
        InputError: the site lies outside UTM.
    """
    grid = UtmGrid.at(site.lat_deg, site.lon_deg)
    origin_m = grid.from_geodetic(np.array(site.lat_deg), np.array(site.lon_deg), np.array(site.height_m))
    stamps_ns = np.array([image.stamp_ns for image in images], dtype=np.int64)
    stamps_ns = stamps_ns[_between_neighbours(poses.stamps_ns, stamps_ns)]
    if len(stamps_ns) == 0:
        raise DriveError(f"{poses.table} has no pose at the time of any of the {len(images)} images")
    knots_s, times_s = ((stamps - poses.stamps_ns[0]) * 1e-9 for stamps in (poses.stamps_ns, stamps_ns))
    local_from_sensor = Slerp(knots_s, Rotation.from_quat(poses.quat_xyzw))(times_s).as_matrix()
    sensors_m = np.stack([np.interp(times_s, knots_s, axis_m) for axis_m in poses.positions_m.T], axis=1)
    cameras_m = sensors_m + local_from_sensor @ sensor_from_cam.translation_m
    return Trajectory(grid.epsg, stamps_ns, origin_m + cameras_m, local_from_sensor @ sensor_from_cam.rotation)


def fixes_at_site(folder: Path, reference: Trajectory | None, gnss: SimulatedGnss | None) -> list[GnssFix]:
    """Fixes made from a reference; none where none are wanted. Raises DriveError if there is no reference."""
    if gnss is None:
        return []
    if reference is None:
        raise DriveError(f"{folder} has no place on Earth to make GNSS fixes at; give --origin LAT,LON,HEIGHT")
    return simulated_fixes(reference, gnss)


def _between_neighbours(knots_ns: np.ndarray, stamps_ns: np.ndarray) -> np.ndarray:
    """Which stamps (N,) lie on a knot or between two that are close."""
    if len(knots_ns) < 2:
        return np.zeros(len(stamps_ns), dtype=bool)
    after = np.clip(np.searchsorted(knots_ns, stamps_ns), 1, len(knots_ns) - 1)
    before_ns, after_ns = knots_ns[after - 1], knots_ns[after]
    is_inside = (before_ns <= stamps_ns) & (stamps_ns <= after_ns)
    is_on_knot = (before_ns == stamps_ns) | (after_ns == stamps_ns)
    return np.asarray(is_inside & (is_on_knot | (after_ns - before_ns <= LONGEST_INTERPOLATION_NS)))
