"""The path that a visual course, a speed and a receiver's error give to the fixes, and its derivatives.

Positions and directions of the plane are complex numbers: east + i north, exp(i heading).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.inspection.gnss_quality import spaced
from fleetmap.inspection.visual_course import VisualCourse

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_SPEED_KNOT_S, _COURSE_KNOT_S, _ERROR_KNOT_S = 0.5, 1.0, 2.0
_JERK_MPS3 = 1.0  # per square root of a second
_COURSE_WALK_RAD = np.radians(0.2)  # per square root of a second: drift of frame-to-frame rotations
_ERROR_TIME_CONSTANT_S = 100.0  # over which a receiver's error changes by its own sigma


@dataclass(frozen=True)
class Fixes:
    """Positions of one stretch, M of them."""

    times_s: Array  # (M,) on the clock of the receiver, zero at the course's start
    positions_m: Array  # (M, 2) grid east and north, near zero
    sigma_m: float  # what the receiver reports, per axis

    @property
    def complex_m(self) -> Complex:
        """The positions (M,) as complex numbers."""
        return np.asarray(self.positions_m[:, 0] + 1j * self.positions_m[:, 1])


@dataclass(frozen=True)
class Lever:
    """The antenna in the vehicle's level frame, and how well that is known."""

    forward_left_m: Array  # (2,)
    sigma_m: float  # small against a metre: a long unknown lever can hardly be told from an offset


@dataclass(frozen=True)
class PathModel:
    """The unknowns stand in a row: offset, lever (2), speeds, course corrections, errors east, errors north."""

    course: VisualCourse
    fixes: Fixes
    lever: Lever
    speed_knots_s: Array
    course_knots_s: Array
    error_knots_s: Array

    @staticmethod
    def of(course: VisualCourse, fixes: Fixes, lever: Lever) -> PathModel:
        """Knots evenly over the course."""
        steps_s = (_SPEED_KNOT_S, _COURSE_KNOT_S, _ERROR_KNOT_S)
        return PathModel(course, fixes, lever, *(_knots(course.duration_s, step_s) for step_s in steps_s))

    def start(self, offset_s: float) -> Array:
        """Speeds from the fixes, and the heading and place that lay the visual path over them."""
        lever, speed, correction, east, north = self._columns()
        times_s, points = self.fixes.times_s + offset_s, self.fixes.complex_m
        unknowns = np.zeros(north.stop)
        unknowns[0] = offset_s
        unknowns[lever] = self.lever.forward_left_m
        unknowns[speed] = _speeds_mps(times_s, self.fixes.positions_m, self.speed_knots_s)
        speeds = _hats(self.speed_knots_s, self._middles_s()) @ unknowns[speed]
        steps = speeds * np.exp(1j * self.course.course_rad)
        path = _integral(self.course.times_s, steps, times_s)
        turn = np.angle(np.vdot(path - path.mean(), points - points.mean()))
        unknowns[correction] = turn
        shift = (points - path * np.exp(1j * turn)).mean()
        unknowns[east], unknowns[north] = shift.real, shift.imag
        return unknowns

    def linearise(self, unknowns: Array) -> tuple[Array, Array]:
        """Residuals (2 M,), eastings first, and their derivatives (2 M, unknowns)."""
        lever, speed, correction, east, north = self._columns()
        course, times_s = self.course, self.fixes.times_s + unknowns[0]
        speed_hats, course_hats = (_hats(k, self._middles_s()) for k in (self.speed_knots_s, self.course_knots_s))
        heading_hats, error_hats = (_hats(k, times_s) for k in (self.course_knots_s, self.error_knots_s))
        speeds = speed_hats @ unknowns[speed]
        directions = np.exp(1j * (course.course_rad + course_hats @ unknowns[correction]))
        heading = np.interp(times_s, course.times_s, course.heading_rad) + heading_hats @ unknowns[correction]
        forward = np.exp(1j * heading)
        arm = forward * complex(*unknowns[lever])
        error = error_hats @ (unknowns[east] + 1j * unknowns[north])
        velocities = speeds * directions
        residuals = _integral(course.times_s, velocities, times_s) + arm + error - self.fixes.complex_m
        now = _interval(course.times_s, times_s)
        turn_rate = np.diff(course.heading_rad) / np.diff(course.times_s)
        by_offset = velocities[now] + 1j * turn_rate[now] * arm
        by_speed = _integral(course.times_s, directions[:, None] * speed_hats, times_s)
        by_correction = _integral(course.times_s, velocities[:, None] * course_hats, times_s)
        by_correction += arm[:, None] * heading_hats
        columns = [by_offset, forward, 1j * forward, by_speed, 1j * by_correction, error_hats, 1j * error_hats]
        jacobian = np.column_stack(columns)
        return np.concatenate([residuals.real, residuals.imag]), np.vstack([jacobian.real, jacobian.imag])

    def priors(self, unknowns: Array) -> tuple[Array, Array]:
        """Residuals in sigmas, and their derivatives."""
        lever, speed, correction, east, north = self._columns()
        error_walk = self.fixes.sigma_m * np.sqrt(2.0 / _ERROR_TIME_CONSTANT_S)
        blocks = [
            (lever, np.eye(2) / self.lever.sigma_m),
            (speed, _bend(self.speed_knots_s, _JERK_MPS3)),
            (correction, _slope(self.course_knots_s, _COURSE_WALK_RAD)),
            (east, _slope(self.error_knots_s, error_walk)),
            (north, _slope(self.error_knots_s, error_walk)),
        ]
        jacobian = np.zeros((sum(len(block) for _, block in blocks), north.stop))
        row = 0
        for columns, block in blocks:
            jacobian[row : row + len(block), columns] = block
            row += len(block)
        residuals = jacobian @ unknowns
        residuals[:2] -= self.lever.forward_left_m / self.lever.sigma_m
        return residuals, jacobian

    def speed_mps(self, unknowns: Array) -> float:
        """The mean speed."""
        return float(np.mean(np.abs(unknowns[self._columns()[1]])))

    def _middles_s(self) -> Array:
        return np.asarray(0.5 * (self.course.times_s[:-1] + self.course.times_s[1:]))

    def _columns(self) -> tuple[slice, slice, slice, slice, slice]:
        """Where lever, speeds, course corrections, errors east and errors north stand; the offset is the first."""
        errors = len(self.error_knots_s)
        lever, speed, correction, east, north = np.cumsum(
            [3, len(self.speed_knots_s), len(self.course_knots_s), errors, errors]
        ).tolist()
        return (
            slice(1, lever),
            slice(lever, speed),
            slice(speed, correction),
            slice(correction, east),
            slice(east, north),
        )


def _knots(duration_s: float, step_s: float) -> Array:
    return np.linspace(0.0, duration_s, max(2, round(duration_s / step_s) + 1))


def _hats(knots_s: Array, times_s: Array) -> Array:
    """Weights (M, K) of linear interpolation between knots (K,); the outermost values hold beyond the ends."""
    position = np.clip((times_s - knots_s[0]) / (knots_s[1] - knots_s[0]), 0.0, len(knots_s) - 1.0)
    return np.asarray(np.clip(1.0 - np.abs(position[:, None] - np.arange(len(knots_s))), 0.0, None))


def _interval(edges_s: Array, times_s: Array) -> NDArray[np.intp]:
    """Which of the intervals between edges (N,) each time is in; the outer ones go on."""
    return np.clip(np.searchsorted(edges_s, times_s) - 1, 0, len(edges_s) - 2)


def _integral(edges_s: Array, rates: Complex, times_s: Array) -> Complex:
    """The integral (M, ...) from the first edge to each time (M,) of rates (N - 1, ...), even in each interval."""
    now = _interval(edges_s, times_s)
    steps_s, since_s = np.diff(edges_s), times_s - edges_s[now]
    if rates.ndim == 2:
        steps_s, since_s = steps_s[:, None], since_s[:, None]
    before = np.cumsum(steps_s * rates, axis=0) - steps_s * rates
    return np.asarray(before[now] + since_s * rates[now])


def _slope(knots_s: Array, walk: float) -> Array:
    """Rows in sigmas of a random walk of ``walk`` per square root of a second."""
    step_s = knots_s[1] - knots_s[0]
    return np.asarray(np.diff(np.eye(len(knots_s)), axis=0) / (walk * np.sqrt(step_s)))


def _bend(knots_s: Array, jerk: float) -> Array:
    """Rows in sigmas of a speed whose acceleration is a random walk."""
    step_s = knots_s[1] - knots_s[0]
    return np.asarray(np.diff(np.eye(len(knots_s)), n=2, axis=0) / (jerk * step_s**1.5))


def _speeds_mps(times_s: Array, points: Array, knots_s: Array) -> Array:
    """Speeds at the knots, from distances between positions about a second apart."""
    chosen = spaced(times_s, 0.9)
    steps_s = np.diff(times_s[chosen])
    speeds = np.linalg.norm(np.diff(points[chosen], axis=0), axis=1) / steps_s
    return np.asarray(np.interp(knots_s, times_s[chosen][:-1] + 0.5 * steps_s, speeds))
