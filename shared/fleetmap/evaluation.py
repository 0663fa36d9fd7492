"""How far a trajectory is from a reference, or from the trajectory of the map it was localised in.

The figures are those of the printed tables: maximum, mean, median, minimum, RMSE, SSE and standard deviation
of the absolute position error. Nothing is aligned unless it is asked for: in UTM the pose itself is judged.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fleetmap.errors import InputError, TrajectoryError
from fleetmap.geometry import rotation_angle_rad, so3_exp, so3_log, umeyama_alignment
from fleetmap.trajectory import Trajectory

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
Indices = NDArray[np.intp]
Alignment = Literal["none", "se3", "sim3"]

MAX_STAMP_OFFSET_NS = 5_000_000
MAX_INTERPOLATION_GAP_NS = 500_000_000
FAR_OFF_M = 2.0  # a vehicle misled by this much stands in another lane


@dataclass(frozen=True)
class ErrorStatistics:
    """The rows of the printed tables, and the 95th percentile."""

    max: float
    mean: float
    median: float
    min: float
    rmse: float
    sse: float  # sum of squared errors, in the square of the unit
    std: float  # population standard deviation
    p95: float

    @staticmethod
    def of(errors: Array) -> ErrorStatistics:
        """Statistics of non-negative errors (N,), N >= 1."""
        squares = errors**2
        return ErrorStatistics(
            max=float(errors.max()),
            mean=float(errors.mean()),
            median=float(np.median(errors)),
            min=float(errors.min()),
            rmse=float(np.sqrt(squares.mean())),
            sse=float(squares.sum()),
            std=float(errors.std()),
            p95=float(np.percentile(errors, 95.0)),
        )


@dataclass(frozen=True)
class RotationErrors:
    """Rotations ``truth_from_estimate`` of N compared poses, and what is left without their common part."""

    angles_deg: Array  # (N,) the whole angle
    offset_deg: float  # angle of the mean rotation: a mounting, or a constant error such as roll
    spread_deg: Array  # (N,) angle left when the mean rotation is taken off

    @staticmethod
    def of(truth_from_estimate: Array) -> RotationErrors:
        """Errors of relative rotations (N, 3, 3), N >= 1; their mean is the chordal one."""
        mean = np.asarray(Rotation.from_matrix(truth_from_estimate).mean().as_matrix())
        return RotationErrors(
            angles_deg=np.degrees(rotation_angle_rad(truth_from_estimate)),
            offset_deg=float(np.degrees(rotation_angle_rad(mean))),
            spread_deg=np.degrees(rotation_angle_rad(mean.T @ truth_from_estimate)),
        )


@dataclass(frozen=True)
class TrajectoryErrors:
    """Errors of N compared poses, N >= 1."""

    stamps_ns: Stamps  # (N,) of the estimate
    true_positions_m: Array  # (N, 3) easting, northing, height where the estimate should have been
    offsets_m: Array  # (N, 3) estimate, aligned if that was asked for, minus truth
    rotation: RotationErrors | None  # None where only positions were compared
    comparable: int  # the poses that should have been compared; coverage is the part that was
    scale: float | None = None  # of the alignment, where one was asked for

    @property
    def matched(self) -> int:
        """How many poses were compared."""
        return len(self.stamps_ns)

    @property
    def coverage(self) -> float:
        """Compared poses as a fraction of those that should have been."""
        return self.matched / self.comparable

    @property
    def positions_m(self) -> Array:
        """The compared positions (N, 3), aligned if that was asked for."""
        return self.true_positions_m + self.offsets_m

    @cached_property
    def distances_m(self) -> Array:
        """Absolute position error (N,) in three dimensions."""
        return np.asarray(np.linalg.norm(self.offsets_m, axis=1))

    @cached_property
    def position_m(self) -> ErrorStatistics:
        """Statistics of the position error in three dimensions."""
        return ErrorStatistics.of(self.distances_m)

    @cached_property
    def horizontal_m(self) -> ErrorStatistics:
        """Statistics of the position error in easting and northing."""
        return ErrorStatistics.of(np.asarray(np.linalg.norm(self.offsets_m[:, :2], axis=1)))

    @property
    def over_2m(self) -> int:
        """Poses that are more than 2 m off."""
        return int((self.distances_m > FAR_OFF_M).sum())

    def to_json(self) -> dict[str, Any]:
        """All figures as plain values; rotation keys are absent where only positions were compared."""
        figures: dict[str, Any] = {
            "position_m": asdict(self.position_m),
            "horizontal_m": asdict(self.horizontal_m),
            "matched": self.matched,
            "comparable": self.comparable,
            "coverage": self.coverage,
            "over_2m": self.over_2m,
            "scale": self.scale,
        }
        if self.rotation is not None:
            figures["rotation_deg"] = asdict(ErrorStatistics.of(self.rotation.angles_deg))
            figures["rotation_offset_deg"] = self.rotation.offset_deg
            figures["rotation_spread_deg"] = asdict(ErrorStatistics.of(self.rotation.spread_deg))
        return figures


def evaluate_trajectory(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    align: Alignment = "none",
    max_offset_ns: int = MAX_STAMP_OFFSET_NS,
) -> TrajectoryErrors:
    """Absolute errors of ``estimate`` against ``reference``, pose by pose of nearest stamps.

    ``align`` first moves the estimate onto the reference by one least-squares transform over the matched
    positions: "se3" without, "sim3" with a scale. Coverage counts the reference's poses.

    Raises:
        TrajectoryError: different UTM zones, no pose in common, or too few to align.
    """
    _require_one_zone(estimate, reference)
    of_estimate, of_reference = associate(estimate.stamps_ns, reference.stamps_ns, max_offset_ns)
    if len(of_estimate) == 0:
        raise TrajectoryError(
            f"no pose of the estimate lies within {max_offset_ns / 1e6:g} ms of a reference pose "
            f"({_span(estimate)} against {_span(reference)}); do both belong to the same drive?"
        )
    positions_m, rotations = estimate.positions_m[of_estimate], estimate.rotations[of_estimate]
    true_positions_m, true_rotations = reference.positions_m[of_reference], reference.rotations[of_reference]
    offsets_m, scale = positions_m - true_positions_m, None
    if align != "none":
        offsets_m, turn, scale = _align(positions_m, true_positions_m, with_scale=align == "sim3")
        rotations = turn @ rotations
    return TrajectoryErrors(
        stamps_ns=estimate.stamps_ns[of_estimate],
        true_positions_m=true_positions_m,
        offsets_m=offsets_m,
        rotation=RotationErrors.of(true_rotations.transpose(0, 2, 1) @ rotations),
        comparable=len(reference),
        scale=scale,
    )


def evaluate_against_map(query: Trajectory, survey: Trajectory, camera_offset_m: Array) -> TrajectoryErrors:
    """Errors of a localised camera relative to the trajectory of the map it was localised in.

    For two cameras of one vehicle: ``camera_offset_m`` (3,) is the query camera's centre in the survey camera's
    frame. The survey's pose is interpolated to the query's stamps; what the map itself errs in UTM drops out.
    The rotations still hold the mounting between the two cameras: it is their mean, so look at the spread.
    Coverage counts the query's poses.

    Raises:
        TrajectoryError: different UTM zones, or no query pose between two neighbouring survey poses.
    """
    _require_one_zone(query, survey)
    compared, survey_at_query = interpolate_trajectory(survey, query.stamps_ns)
    if not compared.any():
        raise TrajectoryError(
            f"no pose of the query lies between survey poses at most {MAX_INTERPOLATION_GAP_NS / 1e9:g} s apart "
            f"({_span(query)} against {_span(survey)}); do both belong to the same drive?"
        )
    arms_m = survey_at_query.rotations @ np.asarray(camera_offset_m, dtype=np.float64)
    true_positions_m = survey_at_query.positions_m + arms_m
    return TrajectoryErrors(
        stamps_ns=query.stamps_ns[compared],
        true_positions_m=true_positions_m,
        offsets_m=query.positions_m[compared] - true_positions_m,
        rotation=RotationErrors.of(survey_at_query.rotations.transpose(0, 2, 1) @ query.rotations[compared]),
        comparable=len(query),
    )


def associate(first_ns: Stamps, second_ns: Stamps, max_offset_ns: int) -> tuple[Indices, Indices]:
    """Indices (M,), (M,) of the stamps that are each other's nearest and at most ``max_offset_ns`` apart."""
    if len(first_ns) == 0 or len(second_ns) == 0:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    nearest_second, nearest_first = _nearest(first_ns, second_ns), _nearest(second_ns, first_ns)
    own = np.arange(len(first_ns))
    mutual = nearest_first[nearest_second] == own
    near = np.abs(first_ns - second_ns[nearest_second]) <= max_offset_ns
    return own[mutual & near], nearest_second[mutual & near]


def interpolate_trajectory(
    trajectory: Trajectory, stamps_ns: Stamps, max_gap_ns: int = MAX_INTERPOLATION_GAP_NS
) -> tuple[NDArray[np.bool_], Trajectory]:
    """The trajectory at other stamps (N,): positions linear, rotations along the geodesic.

    Returns a mask (N,) and the trajectory at the stamps it holds: those on a pose, or between two neighbouring
    poses at most ``max_gap_ns`` apart. Nothing is extrapolated.
    """
    compared, before, after = _neighbours(trajectory.stamps_ns, stamps_ns, max_gap_ns)
    gap_ns = trajectory.stamps_ns[after] - trajectory.stamps_ns[before]
    elapsed_ns = stamps_ns[compared] - trajectory.stamps_ns[before]
    fraction = (elapsed_ns / np.maximum(gap_ns, 1))[:, None]
    first_m, second_m = trajectory.positions_m[before], trajectory.positions_m[after]
    rotations = trajectory.rotations[before]
    if len(rotations):
        turns = so3_log(rotations.transpose(0, 2, 1) @ trajectory.rotations[after])
        rotations = np.asarray(rotations @ so3_exp(fraction * turns))
    positions_m = first_m + fraction * (second_m - first_m)
    return compared, Trajectory(trajectory.epsg, stamps_ns[compared], positions_m, rotations)


def _neighbours(own_ns: Stamps, stamps_ns: Stamps, max_gap_ns: int) -> tuple[NDArray[np.bool_], Indices, Indices]:
    """Which stamps (N,) have close neighbours among ``own_ns``, and the neighbours' indices (M,), (M,).

    A stamp on a pose has that pose for both neighbours.
    """
    after = np.searchsorted(own_ns, stamps_ns, side="left")
    before = np.searchsorted(own_ns, stamps_ns, side="right") - 1
    has_both = (before >= 0) & (after < len(own_ns))
    close = own_ns[after[has_both]] - own_ns[before[has_both]] <= max_gap_ns
    has_both[has_both] = close
    return has_both, before[has_both], after[has_both]


def _align(source_m: Array, target_m: Array, with_scale: bool) -> tuple[Array, Array, float]:
    """Residuals (N, 3) of the aligned source, the alignment's rotation (3, 3) and its scale.

    Both sides are centred first: at a UTM northing a product of float64 keeps only nanometres.
    """
    source_m, target_m = source_m - source_m.mean(axis=0), target_m - target_m.mean(axis=0)
    try:
        target_from_source = umeyama_alignment(source_m, target_m, with_scale)
    except InputError as error:
        raise TrajectoryError(f"cannot align {len(source_m)} matched poses: {error}") from error
    residuals_m = target_from_source.transform(source_m) - target_m
    return residuals_m, target_from_source.rotation, target_from_source.scale


def _nearest(stamps_ns: Stamps, others_ns: Stamps) -> Indices:
    """Index (N,) of the nearest of the sorted ``others_ns``; the earlier one of two equally near."""
    after = np.clip(np.searchsorted(others_ns, stamps_ns), 0, len(others_ns) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(stamps_ns - others_ns[before]) <= np.abs(others_ns[after] - stamps_ns), before, after)


def _require_one_zone(one: Trajectory, other: Trajectory) -> None:
    if one.epsg != other.epsg:
        raise TrajectoryError(
            f"one trajectory is in EPSG:{one.epsg}, the other in EPSG:{other.epsg}; "
            "only poses of one UTM zone can be compared"
        )


def _span(trajectory: Trajectory) -> str:
    if len(trajectory) == 0:
        return "no pose at all"
    return f"{trajectory.stamps_ns[0] / 1e9:.3f} to {trajectory.stamps_ns[-1] / 1e9:.3f} s"
