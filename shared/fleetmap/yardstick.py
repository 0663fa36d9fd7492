"""What the fixes alone would give: splines through them, judged like a trajectory.

Dense, good fixes make any map look accurate. So the errors of splines are printed beside the error of the map:
only what the map does better than its own fixes is owed to the images.

* The cubic passes through every fix. The antenna is taken as the camera.
* The smoothing spline weighs the fixes by their covariance and takes the antenna's lever arm off, so it is the
  best that can be said without images; where fixes are dense it averages their noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from fleetmap.drive import GnssFix
from fleetmap.errors import TrajectoryError
from fleetmap.evaluation import Interval, SegmentBootstrap, TrajectoryErrors, way_driven_m
from fleetmap.geodesy import UtmGrid
from fleetmap.smoothing_spline import fit_smoothing_spline
from fleetmap.trajectory import Trajectory

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

MIN_STEP_NS = 1_000_000  # fixes closer than this are one: a spline would bend wildly between two
STANDING_MPS = 1.0  # below this a spline's tangent is no direction of travel


def evaluate_gnss_spline(fixes: Sequence[GnssFix], reference: Trajectory) -> TrajectoryErrors:
    """Position errors of the cubic through ``fixes``, at the reference's stamps within the fixes' span.

    Coverage counts the reference's poses. There is no rotation to compare.

    Raises:
        TrajectoryError: fewer than two fixes at different times, or no reference pose between first and last.
    """
    known = _Fixes.of(fixes, reference.epsg)
    compared = known.span(reference)
    # Metres since the first fix's position: the spline's solver keeps its digits.
    spline = CubicSpline(known.times_s, known.positions_m - known.positions_m[0])
    positions_m = spline(known.since_first_s(reference.stamps_ns[compared])) + known.positions_m[0]
    return _errors(reference, compared, positions_m)


def evaluate_smoothing_spline(
    fixes: Sequence[GnssFix], reference: Trajectory, antenna_in_cam_m: Array | None = None
) -> TrajectoryErrors:
    """Position errors of the smoothing spline through ``fixes``, less the antenna's lever arm; otherwise likewise.

    Horizontal axes share one smoothness, height has its own; both come from the fixes alone, see
    fleetmap.smoothing_spline. Correlations between the axes of a fix are disregarded.

    Fixes know no orientation: the camera is taken to look along the way it travels, level across it. Where the
    vehicle stands, the nearest direction of travel holds.

    Raises:
        TrajectoryError: fewer than two fixes at different times, or no reference pose between first and last.
    """
    known = _Fixes.of(fixes, reference.epsg)
    compared = known.span(reference)
    smoothed_m = known.positions_m - known.positions_m[0]
    for axes in (slice(0, 2), slice(2, 3)):
        fit = fit_smoothing_spline(known.times_s, smoothed_m[:, axes], known.variances_m2[:, axes])
        smoothed_m[:, axes] = fit.values
    spline = CubicSpline(known.times_s, smoothed_m, bc_type="natural")
    at_s = known.since_first_s(reference.stamps_ns[compared])
    positions_m = spline(at_s) + known.positions_m[0]
    if antenna_in_cam_m is not None and np.any(antenna_in_cam_m):
        positions_m -= _looking_along(spline(at_s, 1)) @ antenna_in_cam_m
    return _errors(reference, compared, positions_m)


@dataclass(frozen=True)
class YardstickComparison:
    """An estimate beside its yardstick, over the reference poses that both have."""

    common: int
    mean_m: float  # of the estimate's 3-D position error
    yardstick_mean_m: float
    interval: Interval | None  # 95 % of the difference of the means; None where the road is one segment

    @property
    def difference_m(self) -> float:
        """Negative where the estimate is better."""
        return self.mean_m - self.yardstick_mean_m

    @property
    def better(self) -> bool:
        """Whether the estimate is better beyond chance, or, where chance cannot be told, in the mean."""
        return self.difference_m < 0.0 if self.interval is None else self.interval[1] < 0.0

    def to_json(self) -> dict[str, Any]:
        """All figures as plain values."""
        return asdict(self) | {"difference_m": self.difference_m, "better": self.better}


def compare_with_yardstick(errors: TrajectoryErrors, yardstick: TrajectoryErrors) -> YardstickComparison | None:
    """Both against the same reference; None where they have no pose in common. Only unaligned errors compare."""
    common, ours, theirs = np.intersect1d(errors.compared, yardstick.compared, return_indices=True)
    if len(common) == 0:
        return None
    ours_m, theirs_m = errors.distances_m[ours], yardstick.distances_m[theirs]
    bootstrap = SegmentBootstrap.along(errors.road_m)
    return YardstickComparison(
        common=len(common),
        mean_m=float(ours_m.mean()),
        yardstick_mean_m=float(theirs_m.mean()),
        interval=bootstrap.mean(ours_m - theirs_m, bootstrap.segment_of[common]),
    )


@dataclass(frozen=True)
class _Fixes:
    """The fixes on the grid, N >= 2."""

    stamps_ns: Stamps  # (N,) strictly increasing; of fixes within a millisecond the first
    positions_m: Array  # (N, 3) easting, northing, height
    variances_m2: Array  # (N, 3) of them

    @staticmethod
    def of(fixes: Sequence[GnssFix], epsg: int) -> _Fixes:
        stamps_ns, first = np.unique(np.array([fix.stamp_ns for fix in fixes], dtype=np.int64), return_index=True)
        apart = np.diff(stamps_ns, prepend=stamps_ns[:1] - MIN_STEP_NS) >= MIN_STEP_NS
        stamps_ns, first = stamps_ns[apart], first[apart]
        if len(stamps_ns) < 2:
            raise TrajectoryError(f"a spline needs two GNSS fixes or more, the recording holds {len(stamps_ns)}")
        grid = UtmGrid(epsg)
        lat_deg, lon_deg, height_m = np.array([(fix.lat_deg, fix.lon_deg, fix.height_m) for fix in fixes])[first].T
        # A drive is short before the distance to the central meridian: one convergence does for its covariances.
        grid_from_enu = grid.grid_from_enu(float(np.median(lat_deg)), float(np.median(lon_deg)))
        covariances = grid_from_enu @ np.array([fix.covariance_enu_m2 for fix in fixes])[first] @ grid_from_enu.T
        return _Fixes(
            stamps_ns=stamps_ns,
            positions_m=grid.from_geodetic(lat_deg, lon_deg, height_m),
            variances_m2=_sensible(np.diagonal(covariances, axis1=1, axis2=2)),
        )

    @property
    def times_s(self) -> Array:
        """Seconds (N,) since the first fix."""
        return self.since_first_s(self.stamps_ns)

    def since_first_s(self, stamps_ns: Stamps) -> Array:
        return np.asarray((stamps_ns - self.stamps_ns[0]) / 1e9)

    def span(self, reference: Trajectory) -> NDArray[np.intp]:
        """Which reference poses lie between the first and the last fix."""
        first_ns, last_ns = self.stamps_ns[0], self.stamps_ns[-1]
        inside = (reference.stamps_ns >= first_ns) & (reference.stamps_ns <= last_ns)
        if not inside.any():
            raise TrajectoryError(
                f"no reference pose between the first and the last GNSS fix ({first_ns / 1e9:.3f} to "
                f"{last_ns / 1e9:.3f} s); do recording and reference belong together?"
            )
        return np.flatnonzero(inside)


def _sensible(variances_m2: Array) -> Array:
    """Variances (N, 3); those that say nothing (zero, not finite) count as the median of the others."""
    known = np.isfinite(variances_m2) & (variances_m2 > 0.0)
    medians = [
        float(np.median(axis[good])) if good.any() else 1.0
        for axis, good in zip(variances_m2.T, known.T, strict=True)
    ]
    return np.where(known, variances_m2, medians)


def _looking_along(velocities_mps: Array) -> Array:
    """Rotations (N, 3, 3) utm_from_cam of cameras looking along velocities (N, 3) in UTM."""
    moving = np.flatnonzero(np.linalg.norm(velocities_mps[:, :2], axis=1) >= STANDING_MPS)
    if len(moving) == 0:
        return np.zeros((len(velocities_mps), 3, 3))
    rows = np.arange(len(velocities_mps))
    after = np.minimum(np.searchsorted(moving, rows), len(moving) - 1)
    before = np.maximum(after - 1, 0)
    nearer_before = np.abs(rows - moving[before]) < np.abs(moving[after] - rows)
    forward = velocities_mps[np.where(nearer_before, moving[before], moving[after])]
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=-1)


def _errors(reference: Trajectory, compared: NDArray[np.intp], positions_m: Array) -> TrajectoryErrors:
    true_positions_m = reference.positions_m[compared]
    return TrajectoryErrors(
        stamps_ns=reference.stamps_ns[compared],
        true_positions_m=true_positions_m,
        offsets_m=positions_m - true_positions_m,
        road_m=way_driven_m(reference.positions_m),
        compared=compared,
    )
