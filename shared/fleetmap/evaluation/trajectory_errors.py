"""Errors pose by pose, against a reference or relative to the trajectory of a map."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import InputError, TrajectoryError
from fleetmap.evaluation.association import MAX_INTERPOLATION_GAP_NS, associate, interpolate_trajectory
from fleetmap.evaluation.statistics import ErrorStatistics, RotationErrors, mean_rotation
from fleetmap.geometry import so3_log, umeyama_alignment
from fleetmap.trajectory import Trajectory

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
Indices = NDArray[np.intp]
Alignment = Literal["none", "se3", "sim3"]

MAX_STAMP_OFFSET_NS = 5_000_000
FAR_OFF_M = 2.0  # a vehicle misled by this much stands in another lane


@dataclass(frozen=True)
class TrajectoryErrors:
    """Errors of N compared poses, N >= 1, out of M that should have been compared."""

    stamps_ns: Stamps  # (N,) of the estimate
    true_positions_m: Array  # (N, 3) easting, northing, height where the estimate should have been
    offsets_m: Array  # (N, 3) estimate, aligned if that was asked for, minus truth
    road_m: Array  # (M,) way driven up to each pose that should have been compared
    compared: Indices  # (N,) which of those M poses were
    rotation: RotationErrors | None = None  # None where only positions were compared
    # (N, 6) the tangent xi = [rotation (rad), translation (m)] in the estimated camera's frame that leads from the
    # estimate to the truth, utm_from_cam_true = utm_from_cam @ exp(xi) to first order; None like rotation
    tangents: Array | None = None
    scale: float | None = None  # of the alignment, where one was asked for

    @property
    def matched(self) -> int:
        """How many poses were compared."""
        return len(self.stamps_ns)

    @property
    def comparable(self) -> int:
        """How many poses should have been compared."""
        return len(self.road_m)

    @property
    def coverage(self) -> float:
        """Compared poses as a fraction of those that should have been."""
        return self.matched / self.comparable

    @property
    def driven_m(self) -> Array:
        """Way driven (N,) up to each compared pose."""
        return self.road_m[self.compared]

    @property
    def positions_m(self) -> Array:
        """The compared positions (N, 3), aligned if that was asked for."""
        return self.true_positions_m + self.offsets_m

    @cached_property
    def distances_m(self) -> Array:
        """Absolute position error (N,) in three dimensions."""
        return np.asarray(np.linalg.norm(self.offsets_m, axis=1))

    @cached_property
    def horizontal_distances_m(self) -> Array:
        """Absolute position error (N,) in easting and northing."""
        return np.asarray(np.linalg.norm(self.offsets_m[:, :2], axis=1))

    @cached_property
    def position_m(self) -> ErrorStatistics:
        """Statistics of the position error in three dimensions."""
        return ErrorStatistics.of(self.distances_m)

    @cached_property
    def horizontal_m(self) -> ErrorStatistics:
        """Statistics of the position error in easting and northing."""
        return ErrorStatistics.of(self.horizontal_distances_m)

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
        road_m=way_driven_m(reference.positions_m),
        compared=of_reference,
        rotation=RotationErrors.of(true_rotations.transpose(0, 2, 1) @ rotations),
        tangents=_tangents(offsets_m, rotations, true_rotations),
        scale=scale,
    )


def evaluate_against_map(
    query: Trajectory, survey: Trajectory, camera_offset_m: Array, survey_from_query: Array | None = None
) -> TrajectoryErrors:
    """Errors of a localised camera relative to the trajectory of the map it was localised in.

    For two cameras of one vehicle: ``camera_offset_m`` (3,) is the query camera's centre in the survey camera's
    frame, ``survey_from_query`` (3, 3) its rotation. The survey's pose is interpolated to the query's stamps; what
    the map itself errs in UTM drops out. Where the rotation is not known, the errors still hold the mounting
    between the two cameras: it is their mean, so look at the spread. The tangents are always taken without the
    mean. Coverage counts the query's poses.

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
    rotations = query.rotations[compared]
    turned = survey_at_query.rotations.transpose(0, 2, 1) @ rotations
    along_m = query.positions_m.copy()
    along_m[compared] = true_positions_m
    offsets_m = query.positions_m[compared] - true_positions_m
    return TrajectoryErrors(
        stamps_ns=query.stamps_ns[compared],
        true_positions_m=true_positions_m,
        offsets_m=offsets_m,
        road_m=way_driven_m(along_m),
        compared=np.flatnonzero(compared),
        rotation=RotationErrors.of(turned if survey_from_query is None else survey_from_query.T @ turned),
        tangents=_tangents(offsets_m, rotations, survey_at_query.rotations @ mean_rotation(turned)),
    )


def way_driven_m(positions_m: Array) -> Array:
    """Length (N,) of the polyline through positions (N, 3), up to each of them."""
    steps_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps_m)])


def _tangents(offsets_m: Array, rotations: Array, true_rotations: Array) -> Array:
    """From the estimate (rotations (N, 3, 3), truth plus offsets (N, 3)) to the truth; see TrajectoryErrors."""
    estimate_from_utm = rotations.transpose(0, 2, 1)
    return np.hstack(
        [so3_log(estimate_from_utm @ true_rotations), -(estimate_from_utm @ offsets_m[..., None])[..., 0]]
    )


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
