"""How GNSS receivers err: the project's one definition, and fixes made from a reference with it.

======== ============================================================ ==============
model    error per axis (true east, north, up)                        reported sigma
======== ============================================================ ==============
rtk      0.05 m white                                                 0.05 m
consumer Gauss-Markov bias (1 m, 1 m, 1.5 m; 100 s) + 0.1 m white      1.5 m
======== ============================================================ ==============

With either, a share of the fixes may be outliers: 5 to 50 m off in any direction, while they report that sigma.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from fleetmap.drive import GnssFix
from fleetmap.errors import InputError
from fleetmap.geodesy import UtmGrid
from fleetmap.trajectory import Trajectory

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

FIRST_FIX_AFTER_FIRST_IMAGE_NS = 37_000_000
LAST_FIX_BEFORE_LAST_IMAGE_NS = 1_000_000
OUTLIER_DISTANCES_M = 5.0, 50.0

_OUTLIER_STREAM = 1  # beside the seed: outliers are drawn apart, so that all other fixes stay the same


@dataclass(frozen=True)
class GnssErrorModel:
    """A white error plus a slowly wandering bias, per axis, in true east, north, up."""

    white_sigma_m: float
    bias_sigma_m: tuple[float, float, float]
    bias_time_constant_s: float
    reported_sigma_m: float

    def sample_errors_enu_m(self, stamps_ns: Stamps, generator: np.random.Generator) -> Array:
        """One error per stamp, (N, 3) true east, north, up; the bias starts in its stationary distribution.

        Source: A. Gelb (ed.), "Applied Optimal Estimation", 1974, section 2.2, first-order Gauss-Markov process.
        """
        white = generator.normal(0.0, self.white_sigma_m, (len(stamps_ns), 3))
        unit_steps = generator.normal(0.0, 1.0, (len(stamps_ns), 3))
        decay = np.exp(-np.diff(stamps_ns) * 1e-9 / self.bias_time_constant_s)
        bias = unit_steps.copy()
        for index, kept in enumerate(decay, start=1):
            bias[index] = kept * bias[index - 1] + np.sqrt(1.0 - kept**2) * unit_steps[index]
        return np.asarray(white + bias * np.array(self.bias_sigma_m))


RTK = GnssErrorModel(0.05, (0.0, 0.0, 0.0), 100.0, reported_sigma_m=0.05)
CONSUMER = GnssErrorModel(0.1, (1.0, 1.0, 1.5), 100.0, reported_sigma_m=1.5)
GNSS_ERROR_MODELS = {"rtk": RTK, "consumer": CONSUMER}


def sample_fixes(
    reference: Trajectory,
    model: GnssErrorModel,
    *,
    interval_s: float = 0.1,
    gap_s: tuple[float, float] | None = None,
    antenna_in_cam_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    outlier_ratio: float = 0.0,
    seed: int = 0,
) -> list[GnssFix]:
    """The fixes a receiver would have reported along a reference that has one pose per image.

    Args:
        reference: camera poses at the images' stamps.
        model: how the receiver errs.
        interval_s: seconds between fixes.
        gap_s: start (seconds since the first image) and length of a stretch without fixes; the fixes
            outside it are the same with and without a gap.
        antenna_in_cam_m: the antenna in the camera's frame.
        outlier_ratio: the share of the fixes that are far off and do not know it.
        seed: the same seed gives the same fixes.

    Raises:
        InputError: a reference of fewer than two poses, or a spacing, gap or share that makes no sense.
    """
    stamps_ns = fix_stamps_ns(reference.stamps_ns, interval_s)
    positions_m = antenna_positions_m(reference, stamps_ns, antenna_in_cam_m)
    return [
        fix
        for fix in fixes_at(UtmGrid(reference.epsg), stamps_ns, positions_m, model, seed, outlier_ratio)
        if gap_s is None or not in_gap(fix.stamp_ns - int(reference.stamps_ns[0]), gap_s)
    ]


def fixes_at(
    grid: UtmGrid,
    stamps_ns: Stamps,
    antennas_in_utm_m: Array,
    model: GnssErrorModel,
    seed: int,
    outlier_ratio: float = 0.0,
) -> list[GnssFix]:
    """The fixes that a receiver reports of its antenna's true positions (N, 3) at stamps (N,).

    Raises:
        InputError: a share of outliers that makes no sense.
    """
    errors_enu_m = model.sample_errors_enu_m(stamps_ns, np.random.default_rng(seed))
    errors_enu_m += sample_outliers_enu_m(len(stamps_ns), outlier_ratio, seed)
    lat_deg, lon_deg, height_m = grid.to_geodetic(_displace(grid, antennas_in_utm_m, errors_enu_m))
    covariance_enu_m2 = np.eye(3) * model.reported_sigma_m**2
    return [
        GnssFix(stamp_ns, lat, lon, height, covariance_enu_m2)
        for stamp_ns, lat, lon, height in zip(
            stamps_ns.tolist(), lat_deg.tolist(), lon_deg.tolist(), height_m.tolist(), strict=True
        )
    ]


def sample_outliers_enu_m(count: int, ratio: float, seed: int) -> Array:
    """What outliers add to the errors of ``count`` fixes, (N, 3) true east, north, up; zero for all the others.

    The share is met exactly but for rounding. Distances are even between 5 and 50 m, directions over the sphere.

    Raises:
        InputError: no share.
    """
    require_outlier_ratio(ratio)
    generator = np.random.default_rng([seed, _OUTLIER_STREAM])
    chosen = generator.permutation(count)[: round(ratio * count)]
    directions = generator.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    added = np.zeros((count, 3))
    added[chosen] = (directions * generator.uniform(*OUTLIER_DISTANCES_M, (count, 1)))[chosen]
    return added


def require_outlier_ratio(ratio: float) -> None:
    """Raise InputError unless it is a share."""
    if not 0.0 <= ratio <= 1.0:
        raise InputError(f"outliers cannot be {ratio:g} of the GNSS fixes; give a share of 0 to 1")


def fix_stamps_ns(image_stamps_ns: Stamps, interval_s: float) -> Stamps:
    """When fixes come: 37 ms after the first image, one every interval, one 1 ms before the last image.

    Raises:
        InputError: fewer than two images, or an interval that is not positive.
    """
    if len(image_stamps_ns) < 2:
        raise InputError(f"GNSS fixes need a reference of at least 2 poses, got {len(image_stamps_ns)}")
    interval_ns = round(interval_s * 1e9) if np.isfinite(interval_s) else 0
    if interval_ns < 1_000_000:
        raise InputError(f"GNSS interval of {interval_s} s makes no sense; give at least 0.001 s")
    first_ns, last_ns = int(image_stamps_ns[0]), int(image_stamps_ns[-1]) - LAST_FIX_BEFORE_LAST_IMAGE_NS
    return np.append(np.arange(first_ns + FIRST_FIX_AFTER_FIRST_IMAGE_NS, last_ns, interval_ns), last_ns)


def antenna_positions_m(
    reference: Trajectory, stamps_ns: Stamps, antenna_in_cam_m: tuple[float, float, float]
) -> Array:
    """UTM positions (N, 3) of the antenna at any stamps: the camera on a cubic through the reference.

    The cubic is the twice continuously differentiable spline; rotations go along the geodesic between neighbours.
    """
    knots_s = (reference.stamps_ns - reference.stamps_ns[0]) * 1e-9
    times_s = np.clip((stamps_ns - reference.stamps_ns[0]) * 1e-9, knots_s[0], knots_s[-1])
    cameras_m = CubicSpline(knots_s, reference.positions_m, axis=0)(times_s)
    rotations = Slerp(knots_s, Rotation.from_matrix(reference.rotations))(times_s)
    return np.asarray(cameras_m + rotations.apply(np.array(antenna_in_cam_m)), dtype=np.float64)


def _displace(grid: UtmGrid, positions_m: Array, errors_enu_m: Array) -> Array:
    """Move UTM positions (N, 3) by ground metres along true east, north, up."""
    moved = np.empty_like(positions_m)
    lat_deg, lon_deg, _ = grid.to_geodetic(positions_m)
    for index, (lat, lon) in enumerate(zip(lat_deg.tolist(), lon_deg.tolist(), strict=True)):
        grid_metres = grid.point_scale_factor(lat, lon)
        error = errors_enu_m[index] * np.array([grid_metres, grid_metres, 1.0])
        moved[index] = positions_m[index] + grid.grid_from_enu(lat, lon) @ error
    return moved


def in_gap(since_start_ns: int, gap_s: tuple[float, float]) -> bool:
    """Whether a moment lies in a gap: its start and its length."""
    start_s, length_s = gap_s
    return start_s <= since_start_ns * 1e-9 < start_s + length_s
