"""Fits the path a camera saw to GNSS positions, with the clocks' offset as one of the unknowns.

The camera gives the course, but neither speed nor place. With the offset d, a fix stamped g was taken at g + d
on the camera's clock, and should lie at

    x(g + d) = integral of v(t) (cos, sin)(course(t) + b(t)) dt + R(heading + b) lever + e(t)

with a speed v of white jerk, a correction b of the visual course that wanders as a random walk, and an error e of
the receiver that wanders likewise. All unknowns (d, v, b, lever, e) are found together by Gauss-Newton with
Cauchy's weights, so the offset's sigma holds all that it could be confused with: on a straight at constant speed
a later clock looks like a shifted start, and the sigma says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.inspection.visual_course import VisualCourse

Array = NDArray[np.float64]

_SPEED_KNOT_S, _COURSE_KNOT_S, _ERROR_KNOT_S = 0.5, 1.0, 2.0
_JERK_MPS3 = 1.0  # per square root of a second
_COURSE_WALK_RAD = np.radians(0.2)  # per square root of a second: drift of frame-to-frame rotations
_ERROR_TIME_CONSTANT_S = 100.0  # over which a receiver's error changes by its own sigma
_ITERATIONS = 12
_CAUCHY = 2.0
_PRIOR_FREEDOM = 4.0  # how many measurements the reported sigma counts for


@dataclass(frozen=True)
class Fixes:
    """Positions of one stretch, M of them."""

    times_s: Array  # (M,) on the clock of the receiver, zero at the course's start
    positions_m: Array  # (M, 2) grid east and north, near zero
    sigma_m: float  # what the receiver reports, per axis


@dataclass(frozen=True)
class Lever:
    """The antenna in the vehicle's level frame, and how well that is known."""

    forward_left_m: Array  # (2,)
    sigma_m: float  # small against a metre: a long unknown lever can hardly be told from an offset


@dataclass(frozen=True)
class PathFit:
    """The clocks' offset (camera minus GNSS), and how far the fixes scatter about the fitted path."""

    offset_s: float
    sigma_s: float
    scatter_m: float  # per axis
    speed_mps: float
    cost: float


def fit_path(course: VisualCourse, fixes: Fixes, lever: Lever, start_offset_s: float) -> PathFit | None:
    """The fit next to ``start_offset_s``; None where the numbers do not determine one."""
    problem = _Problem.of(course, fixes, lever)
    unknowns = problem.start(start_offset_s)
    scatter_m = fixes.sigma_m
    noise_m = scatter_m  # of one fix, if all were independent
    for _ in range(_ITERATIONS):
        residuals, jacobian = problem.linearise(unknowns)
        noise_m = max(noise_m, _spread(residuals))  # while far off, nothing is an outlier
        weights = _cauchy(residuals, noise_m)
        prior_residuals, prior_jacobian = problem.priors(unknowns)
        weighted = jacobian * weights[:, None]
        measured = weighted.T @ jacobian
        information = measured + prior_jacobian.T @ prior_jacobian
        gradient = weighted.T @ residuals + prior_jacobian.T @ prior_residuals
        try:
            covariance = np.linalg.inv(information)
        except np.linalg.LinAlgError:
            return None
        step = -covariance @ gradient
        step *= min(1.0, 0.3 / max(abs(float(step[0])), 1e-12))
        unknowns = unknowns + step
        used = float(np.trace(covariance @ measured))
        scatter_m = _scatter_m(residuals, used, fixes.sigma_m)
        noise_m = scatter_m * np.sqrt(_correlated_count(residuals))
    cost = float((weights * residuals**2).sum() + (prior_residuals**2).sum())
    cost += 2.0 * len(residuals) * float(np.log(noise_m))
    if not np.all(np.isfinite(unknowns)) or covariance[0, 0] <= 0.0:
        return None
    sigma_s = float(np.sqrt(covariance[0, 0]))
    return PathFit(float(unknowns[0]), sigma_s, scatter_m, problem.speed_mps(unknowns), cost)


def _cauchy(residuals: Array, scatter_m: float) -> Array:
    """Weights (2 M,) for residuals that hold all eastings, then all northings; in 1/m^2."""
    distance = np.hypot(*residuals.reshape(2, -1)) / scatter_m
    return np.tile(1.0 / (1.0 + (distance / _CAUCHY) ** 2) / scatter_m**2, 2)


def _spread(residuals: Array) -> float:
    """Standard deviation, by the median."""
    return 1.4826 * float(np.median(np.abs(residuals)))


def _scatter_m(residuals: Array, used: float, reported_m: float) -> float:
    """White noise of the fixes from what the fit leaves, with the reported sigma as a weak prior.

    ``used`` is the number of measurements that the unknowns have taken up.
    """
    squares = len(residuals) * _spread(residuals) ** 2 + _PRIOR_FREEDOM * reported_m**2
    freedom = max(len(residuals) - used, 0.0) + _PRIOR_FREEDOM
    return max(float(np.sqrt(squares / freedom)), 0.003)


def _correlated_count(residuals: Array) -> float:
    """How many successive fixes say the same: 1 + 2 sum of their autocorrelation, up to its first zero."""
    left = residuals.reshape(2, -1)
    left = np.clip(left, -3.0 * _spread(residuals), 3.0 * _spread(residuals))
    power = float((left * left).sum())
    count = 1.0
    for lag in range(1, left.shape[1] // 4):
        correlation = float((left[:, lag:] * left[:, :-lag]).sum()) / max(power, 1e-12)
        if correlation <= 0.0:
            break
        count += 2.0 * correlation
    return count


@dataclass(frozen=True)
class _Problem:
    """Unknowns in a row: offset, lever (2), speeds (V), course corrections (C), errors east (E), north (E)."""

    course: VisualCourse
    fixes: Fixes
    lever: Lever
    speed_hats: Array  # (N - 1, V) linear interpolation from knots to the middles of the image intervals
    course_hats: Array  # (N - 1, C)
    speed_knots_s: Array
    course_knots_s: Array
    error_knots_s: Array

    @staticmethod
    def of(course: VisualCourse, fixes: Fixes, lever: Lever) -> _Problem:
        middles = 0.5 * (course.times_s[:-1] + course.times_s[1:])
        knots = [_knots(course.duration_s, step) for step in (_SPEED_KNOT_S, _COURSE_KNOT_S, _ERROR_KNOT_S)]
        return _Problem(course, fixes, lever, _hats(knots[0], middles), _hats(knots[1], middles), *knots)

    def start(self, offset_s: float) -> Array:
        """Speeds from the fixes, and the heading and place that lay the visual path over them."""
        times_s, points = self.fixes.times_s + offset_s, self.fixes.positions_m
        speeds = _speeds_mps(times_s, points, self.speed_knots_s)
        unknowns = np.zeros(self._offsets()[-1])
        unknowns[0] = offset_s
        at = self._offsets()
        unknowns[at[1] : at[2]] = self.lever.forward_left_m
        unknowns[at[2] : at[3]] = speeds
        path = self._path(times_s, self.speed_hats @ speeds, self.course.course_rad)
        model, seen = path - path.mean(axis=0), points - points.mean(axis=0)
        turn = np.arctan2((model[:, 0] * seen[:, 1] - model[:, 1] * seen[:, 0]).sum(), (model * seen).sum())
        cos, sin = np.cos(turn), np.sin(turn)
        unknowns[at[3] : at[4]] = turn
        shift = (points - path @ np.array([[cos, sin], [-sin, cos]])).mean(axis=0)
        unknowns[at[4] : at[5]], unknowns[at[5] : at[6]] = shift
        return unknowns

    def linearise(self, unknowns: Array) -> tuple[Array, Array]:
        """Residuals (2 M,), eastings first, and their derivatives (2 M, unknowns)."""
        at = self._offsets()
        times_s = self.fixes.times_s + unknowns[0]
        speeds = self.speed_hats @ unknowns[at[2] : at[3]]
        corrections = unknowns[at[3] : at[4]]
        angles = self.course.course_rad + self.course_hats @ corrections
        along = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        overlap = _overlap_s(self.course.times_s, times_s)
        interval = np.clip(np.searchsorted(self.course.times_s, times_s) - 1, 0, len(speeds) - 1)
        heading_hats, error_hats = _hats(self.course_knots_s, times_s), _hats(self.error_knots_s, times_s)
        heading = np.interp(times_s, self.course.times_s, self.course.heading_rad) + heading_hats @ corrections
        lever = unknowns[at[1] : at[2]]
        turned = np.stack([np.cos(heading), np.sin(heading)], axis=1)  # the vehicle's forward axis
        arm = turned * lever[0] + np.stack([-turned[:, 1], turned[:, 0]], axis=1) * lever[1]
        arm_across = np.stack([-arm[:, 1], arm[:, 0]], axis=1)
        turn_rate = np.diff(self.course.heading_rad) / np.diff(self.course.times_s)
        by_offset = speeds[interval, None] * along[interval] + turn_rate[interval, None] * arm_across
        residuals, rows = [], []
        for axis in (0, 1):
            error = unknowns[at[4 + axis] : at[5 + axis]]
            model = overlap @ (speeds * along[:, axis]) + arm[:, axis] + error_hats @ error
            residuals.append(model - self.fixes.positions_m[:, axis])
            by_lever = np.stack([turned[:, axis], (-turned[:, 1], turned[:, 0])[axis]], axis=1)
            by_speed = overlap @ (along[:, axis, None] * self.speed_hats)
            by_course = overlap @ ((speeds * across[:, axis])[:, None] * self.course_hats)
            by_course += arm_across[:, axis, None] * heading_hats
            by_error = [error_hats, np.zeros_like(error_hats)]
            rows.append(
                np.hstack([by_offset[:, axis, None], by_lever, by_speed, by_course, *by_error[:: 1 - 2 * axis]])
            )
        return np.concatenate(residuals), np.vstack(rows)

    def speed_mps(self, unknowns: Array) -> float:
        """The mean speed."""
        at = self._offsets()
        return float(np.mean(np.abs(unknowns[at[2] : at[3]])))

    def priors(self, unknowns: Array) -> tuple[Array, Array]:
        """Residuals in sigmas, and their derivatives."""
        at = self._offsets()
        rows = np.zeros((0, len(unknowns)))
        walk = self.fixes.sigma_m * np.sqrt(2.0 / _ERROR_TIME_CONSTANT_S)
        blocks = [
            (at[1], np.eye(2) / self.lever.sigma_m),
            (at[2], _curvature(self.speed_knots_s, _JERK_MPS3)),
            (at[3], _slope(self.course_knots_s, _COURSE_WALK_RAD)),
            (at[4], _slope(self.error_knots_s, walk)),
            (at[5], _slope(self.error_knots_s, walk)),
        ]
        rows = np.zeros((sum(len(block) for _, block in blocks), len(unknowns)))
        row = 0
        for column, block in blocks:
            rows[row : row + len(block), column : column + block.shape[1]] = block
            row += len(block)
        residuals = rows @ unknowns
        residuals[:2] -= self.lever.forward_left_m / self.lever.sigma_m
        return residuals, rows

    def _path(self, times_s: Array, speeds: Array, angles: Array) -> Array:
        steps = speeds[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        return np.asarray(_overlap_s(self.course.times_s, times_s) @ steps)

    def _offsets(self) -> list[int]:
        errors = len(self.error_knots_s)
        sizes = [1, 2, len(self.speed_knots_s), len(self.course_knots_s), errors, errors]
        return [0, *np.cumsum(sizes).tolist()]


def _knots(duration_s: float, step_s: float) -> Array:
    return np.linspace(0.0, duration_s, max(2, round(duration_s / step_s) + 1))


def _hats(knots_s: Array, times_s: Array) -> Array:
    """Weights (M, K) of linear interpolation between knots (K,); the outermost values hold beyond the ends."""
    position = np.clip((times_s - knots_s[0]) / (knots_s[1] - knots_s[0]), 0.0, len(knots_s) - 1.0)
    return np.asarray(np.clip(1.0 - np.abs(position[:, None] - np.arange(len(knots_s))), 0.0, None))


def _overlap_s(edges_s: Array, times_s: Array) -> Array:
    """Seconds (M, N - 1) that each interval between edges (N,) has lasted at each time; the outer ones go on."""
    since = times_s[:, None] - edges_s[None, :-1]
    overlap = np.clip(since, 0.0, np.diff(edges_s))
    overlap[:, 0] = np.minimum(since[:, 0], edges_s[1] - edges_s[0])
    overlap[:, -1] = np.where(since[:, -1] > 0.0, since[:, -1], overlap[:, -1])
    return np.asarray(overlap)


def _slope(knots_s: Array, walk: float) -> Array:
    """Rows in sigmas of a random walk of ``walk`` per square root of a second."""
    step_s = knots_s[1] - knots_s[0]
    return np.asarray(np.diff(np.eye(len(knots_s)), axis=0) / (walk * np.sqrt(step_s)))


def _curvature(knots_s: Array, jerk: float) -> Array:
    """Rows in sigmas of a speed whose acceleration is a random walk."""
    step_s = knots_s[1] - knots_s[0]
    return np.asarray(np.diff(np.eye(len(knots_s)), n=2, axis=0) / (jerk * step_s**1.5))


def _speeds_mps(times_s: Array, points: Array, knots_s: Array) -> Array:
    """Speeds at the knots, from distances between positions about a second apart."""
    chosen = [0]
    for index in range(1, len(times_s)):
        if times_s[index] - times_s[chosen[-1]] >= 0.9:
            chosen.append(index)
    if len(chosen) < 2:
        chosen = [0, len(times_s) - 1]
    steps_s = np.diff(times_s[chosen])
    speeds = np.linalg.norm(np.diff(points[chosen], axis=0), axis=1) / steps_s
    return np.asarray(np.interp(knots_s, times_s[chosen][:-1] + 0.5 * steps_s, speeds))
