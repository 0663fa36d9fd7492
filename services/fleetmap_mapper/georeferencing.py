"""Where the free-scale frame ``vis`` lies in UTM: S in Sim(3) from camera positions and GNSS fixes.

A fix is held against the antenna at the fix's own time, between the poses of the two neighbouring images;
positions are never interpolated between fixes. Umeyama's alignment starts, and a robust least-squares fit
with the fixes' covariances and the antenna's lever arm finishes. On a nearly straight road positions leave
the roll about the track free; there the camera is taken to be level on average.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fleetmap.drive import GnssFix
from fleetmap.errors import DriveError
from fleetmap.geodesy import UtmAnchor, UtmGrid
from fleetmap.geometry import Pose, Sim3, interpolate_pose, so3_exp, umeyama_alignment

Array = NDArray[np.float64]

MAX_IMAGE_GAP_NS = 500_000_000  # a fix between two posed images further apart than this is not used
MIN_FIXES = 3
MIN_SPAN_SIGMAS = 10.0  # a drive must be this many fix sigmas long before it can be placed
CLEAR_EVIDENCE = 10.0, 4.0  # in half chi-squares (over four sigmas) and, as drift inflates these, as a ratio
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


def georeference(path: Sequence[PathPoint], track: GnssTrack, level_sigma_deg: float) -> Sim3:
    """``map_from_vis``: places the camera path, given in ``vis``, on the fixes.

    Raises:
        DriveError: too few fixes between the images, or a drive too short for their accuracy.
    """
    fixes = np.array([p.fix for p in path], dtype=np.int64)
    _check_observable(fixes, track)
    positions = np.array([p.pose.translation_m for p in path])
    rotations = np.array([p.pose.rotation for p in path])
    targets = track.positions_m[fixes]
    whiten = np.linalg.inv(np.linalg.cholesky(track.covariances_m2[fixes]))
    centre = positions.mean(axis=0)

    def at(start: Sim3, delta: Array) -> Sim3:
        rotation = so3_exp(delta[:3]) @ start.rotation
        scale = start.scale * float(np.exp(delta[6]))
        moved_centre = start.transform(centre) + delta[3:6]
        return Sim3(scale, rotation, moved_centre - scale * rotation @ centre)

    def residuals(start: Sim3, delta: Array) -> Array:
        S = at(start, delta)
        antenna = S.transform(positions) + (S.rotation @ rotations) @ track.antenna_in_cam_m
        errors = np.einsum("fij,fj->fi", whiten, antenna - targets)
        norms = np.linalg.norm(errors, axis=1)
        huber = np.where(
            norms > HUBER_SIGMAS, np.sqrt(HUBER_SIGMAS * np.maximum(2 * norms - HUBER_SIGMAS, 0.0)), norms
        )
        errors *= (huber / np.maximum(norms, 1e-12))[:, None]
        level = (S.rotation @ rotations)[:, 2, 0].mean() / np.radians(level_sigma_deg)
        return np.append(errors.ravel(), level)

    def fitted(start: Sim3) -> tuple[float, Sim3]:
        fit = least_squares(partial(residuals, start), np.zeros(7), x_scale="jac")
        return float(fit.cost), at(start, fit.x)

    first = _umeyama_with_lever_arm(positions, rotations, targets, track.antenna_in_cam_m)
    cost, S = fitted(first)
    upright_cost, upright = fitted(levelled(first, positions, rotations))
    # On a straight road a world turned upside down fits as well: only clear evidence may speak for it.
    least, ratio = CLEAR_EVIDENCE
    return S if least + ratio * cost < upright_cost else upright


def _check_observable(fixes: NDArray[np.int64], track: GnssTrack) -> None:
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


def _umeyama_with_lever_arm(positions: Array, rotations: Array, targets: Array, antenna_in_cam_m: Array) -> Sim3:
    """Umeyama on camera centres; the arm's direction in the map needs the rotation, so it is iterated."""
    S = umeyama_alignment(positions, targets)
    for _ in range(3):
        S = umeyama_alignment(positions, targets - (S.rotation @ rotations) @ antenna_in_cam_m)
    return S


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
