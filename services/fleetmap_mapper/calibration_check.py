"""Does the drive contradict the recorded calibration? A few Gauss-Newton steps from the finished map tell.

Poses and points are free in those steps, so what they can absorb is not held against the calibration. The
covariance is the sandwich estimate of J. White, "Maximum likelihood estimation of misspecified models", 1982,
clustered over stretches of the drive (Liang and Zeger, 1986): reprojection errors go together along a track and
between neighbouring tracks, and counting every one of them as a witness would make anything significant. A short
drive has few stretches, so before the calibration is changed, what they agree on is held against Student's
distribution, not Gauss's (C. Cameron, D. Miller, "A practitioner's guide to cluster-robust inference", J. Human
Resources 50, 2015, section VI).
"""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.stats import norm, t

from fleetmap.camera import Camera
from fleetmap.errors import CalibrationError
from fleetmap.manifest import CalibrationRecord, CameraRecord
from fleetmap_mapper.bordered_system import (
    BorderedStep,
    LinearisedImages,
    LinearisedRest,
    solve_bordered,
)
from fleetmap_mapper.calibrated_graph import CalibratedGraph
from fleetmap_mapper.calibration_parameters import (
    CENTRE,
    FOCAL,
    LENS,
    CalibrationPrior,
    border_points,
    calibration_prior,
)
from fleetmap_mapper.calibration_refinement import optimise
from fleetmap_mapper.global_adjustment import GlobalProblem
from fleetmap_mapper.settings import CalibrationGroup

_log = logging.getLogger(__name__)
Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

_STEPS = 4
_DAMPING = 1e-8  # the free directions of a map without fixes say nothing about the calibration
_MAX_OBSERVATIONS = 40_000  # more landmarks than that are thinned out: seconds, and as clear an answer
_CLUSTERS = 20  # stretches of the drive, at most, that count as independent witnesses


@dataclass(frozen=True)
class Disagreement:
    """One part of the calibration: how far the drive's own estimate lies from the recorded one."""

    sigmas: float  # how clear
    normal_sigmas: float  # as improbable by chance, were there no end of witnesses
    border_px: float  # how large, in pixels at the image border


@dataclass(frozen=True)
class CalibrationEstimate:
    """The calibration that fits the drive best, near the recorded one, and how well the drive knows it."""

    recorded: Camera
    fitted: Camera
    focal_sigma_px: float
    centre_sigma_px: tuple[float, float]
    distortion_sigma: tuple[float, ...]
    focal: Disagreement
    centre: Disagreement
    lens: Disagreement


def estimate_calibration(
    problem: GlobalProblem, settings: CalibrationGroup, recorded: Camera
) -> CalibrationEstimate | None:
    """The drive's own calibration from a finished map, against the recorded one; None where it says nothing."""
    prior = calibration_prior(recorded, settings)
    try:
        graph = CalibratedGraph(_thinned(problem), prior)
        state, _ = optimise(graph, _STEPS)
        images, rest = graph.linearised(state)
        step = solve_bordered(images, rest, state.change, _DAMPING)
        clusters = _clusters(images)
        freedom = int(clusters.max(initial=0))
        return _judged(prior, state.change, _covariance(images, rest, step, clusters), freedom)
    except (np.linalg.LinAlgError, RuntimeError, CalibrationError) as error:  # RuntimeError: SuperLU, singular
        _log.info("the calibration could not be checked: %s", error)
        return None


def _matters(part: Disagreement, settings: CalibrationGroup) -> bool:
    return part.sigmas > settings.warn_sigmas and part.border_px > settings.warn_border_px


def calibration_record(estimate: CalibrationEstimate | None, map_camera: Camera) -> CalibrationRecord | None:
    """The estimate as the manifest of a map made with ``map_camera`` keeps it."""
    if estimate is None:
        return None
    return CalibrationRecord(
        recorded=CameraRecord(**asdict(estimate.recorded)),
        fitted=CameraRecord(**asdict(map_camera if map_camera != estimate.recorded else estimate.fitted)),
        focal_sigma_px=estimate.focal_sigma_px,
        centre_sigma_px=estimate.centre_sigma_px,
        distortion_sigma=estimate.distortion_sigma,
        refined=map_camera != estimate.recorded,
    )


def is_contradicted(estimate: CalibrationEstimate | None, settings: CalibrationGroup) -> bool:
    """Whether the drive knows the calibration better than the recording, in a way that shapes the map."""
    if estimate is None:
        return False
    return any(
        part.normal_sigmas > settings.adopt_sigmas and part.border_px > settings.adopt_border_px
        for part in (estimate.focal, estimate.centre, estimate.lens)
    )


def calibration_remarks(
    estimate: CalibrationEstimate | None, map_camera: Camera, settings: CalibrationGroup
) -> list[str]:
    """One line for each part of the recorded calibration that the drive contradicts, unless asked to refine."""
    if estimate is None or settings.mode == "refined":
        return []
    recorded, fitted, found = estimate.recorded, estimate.fitted, []
    if _matters(estimate.focal, settings):
        found.append(
            f"the recorded focal length {_focal_px(recorded):.1f} px disagrees with the drive: "
            f"{_focal_px(fitted):.1f} +- {estimate.focal_sigma_px:.1f} px fits"
        )
    if _matters(estimate.centre, settings):
        found.append(
            f"the recorded image centre ({recorded.cx_px:.1f}, {recorded.cy_px:.1f}) px disagrees with the drive: "
            f"({fitted.cx_px:.1f}, {fitted.cy_px:.1f}) +- "
            f"({estimate.centre_sigma_px[0]:.1f}, {estimate.centre_sigma_px[1]:.1f}) px fits"
        )
    if _matters(estimate.lens, settings):
        coefficients = " ".join(f"{k:.4f}" for k in fitted.distortion)
        found.append(
            f"the recorded lens distortion disagrees with the drive by {estimate.lens.border_px:.1f} px at the "
            f"image border: {fitted.distortion_model} {coefficients} fits"
        )
    advice = "recalibrate, or map with --refine-calibration"
    if map_camera != recorded:
        advice = "the map is made with the drive's own calibration; recalibrate"
    return [f"{line}; {advice}" for line in found]


def _judged(prior: CalibrationPrior, change: Array, covariance: Array, freedom: int) -> CalibrationEstimate:
    recorded, fitted = prior.recorded, prior.camera(change)
    sigmas = np.sqrt(np.diag(covariance)) * prior.sigmas
    border = recorded.normalise(border_points(recorded))
    by_change = prior.pixel_jacobian(recorded, border)  # (B, 2, C)
    return CalibrationEstimate(
        recorded,
        fitted,
        float(sigmas[0] * _focal_px(fitted)),
        (float(sigmas[2]), float(sigmas[3])),
        tuple(sigmas[LENS].tolist()),
        _disagreement(by_change[:, :, FOCAL], change[FOCAL], covariance[FOCAL, FOCAL], freedom),
        _disagreement(by_change[:, :, CENTRE], change[CENTRE], covariance[CENTRE, CENTRE], freedom),
        _disagreement(by_change[:, :, LENS], change[LENS], covariance[LENS, LENS], freedom),
    )


def _disagreement(by_change: Array, change: Array, covariance: Array, freedom: int) -> Disagreement:
    """At the border point where one part of the calibration shifts pixels most, and how sure that shift is."""
    shifts = by_change @ change
    lengths = np.linalg.norm(shifts, axis=1)
    worst = int(np.argmax(lengths))
    along = (shifts[worst] / max(lengths[worst], 1e-12)) @ by_change[worst]
    sigma = float(np.sqrt(along @ covariance @ along))
    sigmas = float(lengths[worst]) / max(sigma, 1e-12)
    return Disagreement(sigmas, _normal_sigmas(sigmas, freedom), float(lengths[worst]))


def _normal_sigmas(sigmas: float, freedom: int) -> float:
    """How many sigmas of a normal distribution are as improbable as these of Student's; 0 without any freedom."""
    if freedom < 1:
        return 0.0
    return float(norm.isf(max(float(t.sf(sigmas, freedom)), 1e-300)))


def _clusters(images: LinearisedImages) -> IntArray:
    """The stretch of the drive (P,) that each landmark belongs to: that of the first keyframe to see it."""
    stretch = max(1, -(-images.keyframes // _CLUSTERS))
    return np.asarray(images.keyframe_index[images.starts[:-1]] // stretch, dtype=np.int64)


def _covariance(images: LinearisedImages, rest: LinearisedRest, step: BorderedStep, clusters: IntArray) -> Array:
    """Of the calibration (C, C): the larger of the graph's own and the clustered sandwich."""
    k, counts = images.keyframe_index, np.diff(images.starts)
    point_index = np.repeat(np.arange(len(counts)), counts)
    follow = step.poses_by_calibration[: 6 * images.keyframes].reshape(images.keyframes, 6, -1)
    rows = images.by_calibration + images.by_pose @ follow[k]
    rows += images.by_point @ step.points_by_calibration[point_index]
    # A track's own point fits three of its 2 n errors away, whatever their sigma; what is left is too small.
    left = 2.0 * counts / np.maximum(2.0 * counts - 3.0, 1.0)
    scores = (images.residuals[:, None, :] @ rows)[:, 0] * left[point_index][:, None]
    by_cluster = _sum_rows(scores, clusters[point_index], int(clusters.max(initial=0)) + 1)
    by_rest = rest.jacobian @ step.poses_by_calibration
    own = np.asarray(np.linalg.inv(step.information), dtype=np.float64)
    meat = by_cluster.T @ by_cluster + by_rest.T @ by_rest + np.eye(len(own))
    sandwich = own @ meat @ own
    sandwich *= len(by_cluster) / max(len(by_cluster) - 1, 1)
    return _larger(own, sandwich)


def _sum_rows(values: Array, index: IntArray, count: int) -> Array:
    """Sums (count, ...) of the rows of ``values`` (M, ...) by their index."""
    flat = values.reshape(len(values), -1)
    picker = sp.csr_matrix((np.ones(len(index)), (index, np.arange(len(index)))), shape=(count, len(index)))
    return np.asarray(picker @ flat).reshape(count, *values.shape[1:])


def _larger(a: Array, b: Array) -> Array:
    """A covariance at least as large as both: a + (b - a) where that is positive."""
    whiten = np.linalg.cholesky(a)
    inner = np.linalg.solve(whiten, np.linalg.solve(whiten, b).T)
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    stretched = whiten @ vectors
    return np.asarray((stretched * np.maximum(values, 1.0)) @ stretched.T)


def _thinned(problem: GlobalProblem) -> GlobalProblem:
    """Every so manieth landmark of a large map."""
    every = -(-len(problem.pixels) // _MAX_OBSERVATIONS)
    if every <= 1:
        return problem
    kept = problem.point_index % every == 0
    return replace(
        problem,
        points_m=problem.points_m[::every],
        point_index=problem.point_index[kept] // every,
        keyframe_index=problem.keyframe_index[kept],
        pixels=problem.pixels[kept],
        sigmas_px=problem.sigmas_px[kept],
    )


def _focal_px(camera: Camera) -> float:
    return float(np.sqrt(camera.fx_px * camera.fy_px))
