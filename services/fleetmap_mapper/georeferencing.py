"""The fixes of a drive in the map frame, and where the camera was at their times.

A fix is held against the antenna at the fix's own time, between the poses of the two neighbouring images;
positions are never interpolated between fixes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.drive import GnssFix
from fleetmap.errors import DriveError
from fleetmap.geodesy import UtmAnchor, UtmGrid
from fleetmap.geometry import Pose, Sim3, interpolate_pose, so3_exp

Array = NDArray[np.float64]

MAX_IMAGE_GAP_NS = 500_000_000  # a fix between two posed images further apart than this is not used
MIN_FIXES = 3
MIN_SPAN_SIGMAS = 10.0  # a drive must be this many fix sigmas long before it can be placed
HUBER_SIGMAS = 2.7955  # sqrt of the 95 % point of chi-square with 3 degrees of freedom


@dataclass(frozen=True)
class GnssTrack:
    """All fixes of a drive in the map frame."""

    anchor: UtmAnchor
    stamps_ns: NDArray[np.int64]  # (F,)
    positions_m: Array  # (F, 3) float64 antenna in map
    covariances_m2: Array  # (F, 3, 3) float64 in grid axes
    antenna_in_cam_m: Array  # (3,) float64

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True)
class PathPoint:
    """The camera at the time of one fix."""

    fix: int  # index into the GnssTrack
    pose: Pose  # between the two neighbouring images


def gnss_track(fixes: Sequence[GnssFix], antenna_in_cam_m: Array) -> GnssTrack:
    """Fixes in the UTM zone of the first one, about an anchor there.

    Raises:
        DriveError: no fixes at all.
    """
    if not fixes:
        raise DriveError(
            "the recording has no usable GNSS fix (NavSatFix, status >= 0); a map needs them for place and scale"
        )
    grid = UtmGrid.at(fixes[0].lat_deg, fixes[0].lon_deg)
    positions = grid.from_geodetic(
        np.array([f.lat_deg for f in fixes]),
        np.array([f.lon_deg for f in fixes]),
        np.array([f.height_m for f in fixes]),
    )
    easting, northing, height = (int(v) for v in np.floor(positions[0]))
    anchor = UtmAnchor(grid.epsg, easting, northing, height)
    turn = grid.grid_from_enu(fixes[0].lat_deg, fixes[0].lon_deg)
    return GnssTrack(
        anchor,
        np.array([f.stamp_ns for f in fixes], dtype=np.int64),
        anchor.map_from_utm(positions),
        np.array([turn @ f.covariance_enu_m2 @ turn.T for f in fixes]),
        antenna_in_cam_m,
    )


def path_at_fixes(stamps_ns: NDArray[np.int64], poses: Sequence[Pose], track: GnssTrack) -> list[PathPoint]:
    """The camera at each fix that lies between two posed images at most 0.5 s apart."""
    after = np.searchsorted(stamps_ns, track.stamps_ns, side="left")
    points = []
    for fix, (later, stamp_ns) in enumerate(zip(after.tolist(), track.stamps_ns.tolist(), strict=True)):
        if later < len(stamps_ns) and stamps_ns[later] == stamp_ns:
            points.append(PathPoint(fix, poses[later]))
        elif 0 < later < len(stamps_ns):
            gap_ns = int(stamps_ns[later] - stamps_ns[later - 1])
            if gap_ns <= MAX_IMAGE_GAP_NS:
                fraction = (stamp_ns - int(stamps_ns[later - 1])) / gap_ns
                points.append(PathPoint(fix, interpolate_pose(poses[later - 1], poses[later], fraction)))
    return points


def check_observable(fixes: NDArray[np.integer], track: GnssTrack) -> None:
    """Whether some of the fixes, by index, can place a path.

    Raises:
        DriveError: they are too few, or the drive is too short for their accuracy.
    """
    if len(fixes) < MIN_FIXES:
        raise DriveError(
            f"only {len(fixes)} of {len(track)} GNSS fixes lie between posed images; {MIN_FIXES} are needed"
        )
    positions = track.positions_m[fixes]
    span_m = float(np.linalg.norm(positions.max(axis=0) - positions.min(axis=0)))
    sigma_m = float(np.sqrt(np.median(track.covariances_m2[fixes][:, [0, 1], [0, 1]])))
    if span_m < MIN_SPAN_SIGMAS * sigma_m:
        raise DriveError(
            f"the fixes span only {span_m:.1f} m at {sigma_m:.2f} m accuracy; the drive is too short to fix scale "
            f"and direction (at least {MIN_SPAN_SIGMAS * sigma_m:.0f} m)"
        )


def levelled(S: Sim3, positions: Array, rotations: Array) -> Sim3:
    """``map_from_vis`` turned about the main direction of the track until the cameras' mean "down" points down.

    Positions (N, 3) and rotations (N, 3, 3) of the cameras are those in vis.
    """
    placed = S.transform(positions)
    centre = placed.mean(axis=0)
    axis = np.linalg.svd(placed - centre, full_matrices=False)[2][0]
    down = (S.rotation @ rotations)[:, :, 1].mean(axis=0)
    across = np.cross(axis, down)
    wanted = np.array([0.0, 0.0, -1.0]) - axis * -axis[2]  # straight down, perpendicular to the axis
    angle = np.arctan2(across @ wanted, (down - axis * (axis @ down)) @ wanted)
    turn = so3_exp(axis * angle)
    return Sim3(S.scale, turn @ S.rotation, turn @ (S.translation_m - centre) + centre)
