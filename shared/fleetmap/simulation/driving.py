"""Driving along a road: where a car's camera is, and how fast it goes."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from fleetmap.drive import START_NS
from fleetmap.errors import InputError
from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import so3_exp
from fleetmap.simulation.motion import Motion, grid_scale_at, motion_through
from fleetmap.simulation.world import Path
from fleetmap.trajectory import Trajectory

Array = NDArray[np.float64]

FASTEST_MPS, HIGHEST_RATE_HZ = 70.0, 200.0

_STEP_M = 1.0  # between the points of the lane that the car's line goes through, smoothly
_HALF_WHEELBASE_M = 1.3
_KNOT_S = 0.05  # between the poses that the motion goes through; sways are much slower
_MARGIN_S = 0.5  # known before and after the drive, for shutters and lever arms

# What drivers are comfortable with in town: M. Treiber and A. Kesting, Traffic Flow Dynamics, 2013, ch. 11.
_LATERAL_M_S2, _SPEEDING_UP_M_S2, _BRAKING_M_S2 = 2.5, 1.5, 2.0

# Body motion of a car on its springs: amplitude and slowest, fastest frequency of three sines per axis.
_WOBBLE_RAD = np.radians([0.25, 0.12, 0.3])  # about the camera's x (pitch), y (yaw), z (roll)
_BOUNCE_M = 0.008
_WEAVE_M = 0.06
_FREQUENCIES_HZ = (0.25, 1.6)


class Road(Protocol):
    """What a car needs to know of a world or a street."""

    @property
    def anchor(self) -> UtmAnchor:
        """Origin of the map frame."""

    @property
    def path(self) -> Path:
        """The centre of the right-hand lane."""

    @property
    def length_m(self) -> float:
        """Drivable, along the path."""


def drive_along(
    road: Road,
    *,
    lane_offset_m: float = 0.0,
    speed_mps: float = 8.0,
    rate_hz: float = 10.0,
    camera_height_m: float = 1.65,
    start_m: float = 0.0,
    end_m: float | None = None,
    seed: int = 0,
    start_ns: int = START_NS,
) -> Trajectory:
    """Camera poses ``utm_from_cam`` of a car that keeps its speed through all bends; see ``plan_motion``.

    Raises:
        InputError: a speed or rate that makes no sense, or a stretch that ends before it starts.
    """
    motion = plan_motion(
        road,
        lane_offset_m=lane_offset_m,
        speed_mps=speed_mps,
        camera_height_m=camera_height_m,
        start_m=start_m,
        end_m=end_m,
        seed=seed,
        start_ns=start_ns,
        slow_in_bends=False,
    )
    return motion.trajectory(image_stamps_ns(motion, rate_hz))


def image_stamps_ns(motion: Motion, rate_hz: float) -> NDArray[np.int64]:
    """When images are taken: from the start on, evenly. Raises InputError for a rate that makes no sense."""
    require_rate(rate_hz)
    return motion.stamps_ns(rate_hz)


def require_rate(rate_hz: float) -> None:
    """Raise InputError for a rate at which no images can be taken."""
    if not 0.0 < rate_hz <= HIGHEST_RATE_HZ:
        raise InputError(f"{rate_hz:g} images/s make no sense; give more than 0, at most {HIGHEST_RATE_HZ:g}")


def require_speed(speed_mps: float) -> None:
    """Raise InputError for a speed at which no car drives."""
    if not 0.0 < speed_mps <= FASTEST_MPS:
        raise InputError(f"a speed of {speed_mps:g} m/s makes no sense; give more than 0, at most {FASTEST_MPS:g}")


def plan_motion(
    road: Road,
    *,
    lane_offset_m: float = 0.0,
    speed_mps: float = 8.0,
    camera_height_m: float = 1.65,
    start_m: float = 0.0,
    end_m: float | None = None,
    seed: int = 0,
    start_ns: int = START_NS,
    slow_in_bends: bool = True,
) -> Motion:
    """The motion of the camera of a car that drives along a road.

    ``lane_offset_m`` is to the left of the right-hand lane's centre (3.5: the other lane); ``start_m`` and
    ``end_m`` count along the road's path, to its end by default. The camera looks along the path, x right, y down,
    z forward, and sways a little as a car does. The car drives at an even ``speed_mps`` (of the camera, over
    ground), already when the drive starts; with ``slow_in_bends`` it slows down where a bend would press its
    passengers aside with more than 2.5 m/s2, and picks up again after it.

    Raises:
        InputError: a speed that makes no sense, or a stretch that ends before it starts.
    """
    stop_m = road.length_m if end_m is None else end_m
    require_speed(speed_mps)
    if not (-np.inf < start_m < stop_m < np.inf and np.isfinite(lane_offset_m)):
        raise InputError(f"cannot drive from {start_m:g} m to {stop_m:g} m, {lane_offset_m:g} m to the left")
    line = _Line(road.path, lane_offset_m, start_m, stop_m)
    grid_speed = speed_mps * grid_scale_at(road.anchor)
    seconds, s, lengths_m = _timetable(line, start_m, stop_m, grid_speed, slow_in_bends)
    knots_s = _KNOT_S * np.arange(-round(_MARGIN_S / _KNOT_S), np.ceil((seconds[-1] + _MARGIN_S) / _KNOT_S) + 1.0)
    rng = np.random.default_rng(seed)
    left = _WEAVE_M * _sway(rng, knots_s, _FREQUENCIES_HZ[0] / 2.0)
    height = camera_height_m + _BOUNCE_M * _sway(rng, knots_s, _FREQUENCIES_HZ[1])
    wobble = np.stack([a * _sway(rng, knots_s, _FREQUENCIES_HZ[1]) for a in _WOBBLE_RAD], axis=1)
    s_knots, lengths_knots_m = (_beyond_the_ends(knots_s, seconds, at_m) for at_m in (s, lengths_m))
    positions_m = line.beside(s_knots, left, height)
    rotations = line.looking_along(s_knots) @ so3_exp(wobble)
    pace_s = (_lane_length_m(road.path, lane_offset_m, start_m) + lengths_knots_m) / grid_speed
    return motion_through(road.anchor, start_ns, knots_s, rotations, positions_m, float(seconds[-1]), pace_s)


class _Line:
    """The smooth line that a car keeps to in its lane."""

    def __init__(self, path: Path, lane_offset_m: float, start_m: float, stop_m: float) -> None:
        margin_m = 5.0 + _MARGIN_S * FASTEST_MPS
        # Whole metres: paths are themselves drawn through points at such places.
        s = np.arange(np.floor(start_m - margin_m), np.ceil(stop_m + margin_m) + 1.0, _STEP_M)
        self._points = CubicSpline(s, path.at(s, lane_offset_m))

    def beside(self, s: Array, left_m: Array, above_m: Array) -> Array:
        """Map points (N, 3) to the left of and above the line."""
        ahead = self._points(s, 1)
        aside = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) / np.hypot(ahead[:, 0], ahead[:, 1])[:, None]
        return np.asarray(self._points(s) + np.column_stack([aside * left_m[:, None], above_m]))

    def looking_along(self, s: Array) -> Array:
        """Rotations (N, 3, 3) ``map_from_cam`` of a camera on a car that turns with its wheelbase."""
        forward = self._points(s + _HALF_WHEELBASE_M) - self._points(s - _HALF_WHEELBASE_M)
        forward /= np.linalg.norm(forward, axis=1, keepdims=True)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        return np.stack([right, np.cross(forward, right), forward], axis=2)

    def lengths_m(self, s: Array) -> Array:
        """How far (N,) the car has come along the line."""
        steps = np.linalg.norm(np.diff(self._points(s), axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def curvatures(self, s: Array) -> Array:
        """One over the radius (N,) of the bend at each place, seen from above."""
        first, second = self._points(s, 1), self._points(s, 2)
        across = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
        return np.asarray(np.abs(across) / np.hypot(first[:, 0], first[:, 1]) ** 3)


def _lane_length_m(path: Path, lane_offset_m: float, start_m: float) -> float:
    """How long a lane is from s = 0 to where a drive starts; negative for a start before it."""
    s = np.linspace(0.0, start_m, max(2, int(np.ceil(abs(start_m) / _STEP_M)) + 1))
    steps = np.linalg.norm(np.diff(path.at(s, lane_offset_m), axis=0), axis=1)
    return float(np.copysign(steps.sum(), start_m))


def _timetable(
    line: _Line, start_m: float, stop_m: float, speed_mps: float, slow_in_bends: bool
) -> tuple[Array, Array, Array]:
    """When (N,) the car is where (N,) along the path, and how far (N,) it has come along its lane."""
    step_m = 0.25
    s = np.linspace(start_m, stop_m, max(2, int(np.ceil((stop_m - start_m) / step_m)) + 1))
    lengths_m = line.lengths_m(s)
    speeds = np.full_like(s, speed_mps)
    if slow_in_bends:
        curvatures = gaussian_filter1d(line.curvatures(s), 1.0 / step_m, mode="nearest")
        speeds = np.minimum(speeds, np.sqrt(_LATERAL_M_S2 / np.maximum(curvatures, 1e-6)))
        speeds = _reachable(speeds, lengths_m, _SPEEDING_UP_M_S2)
        speeds = _reachable(speeds[::-1], lengths_m[-1] - lengths_m[::-1], _BRAKING_M_S2)[::-1]
        speeds = gaussian_filter1d(speeds, 2.0 / step_m, mode="nearest")  # no jerk
    pauses = np.diff(lengths_m) * 2.0 / (speeds[1:] + speeds[:-1])
    return np.concatenate([[0.0], np.cumsum(pauses)]), s, lengths_m


def _reachable(speeds_mps: Array, lengths_m: Array, limit_m_s2: float) -> Array:
    """Speeds (N,) no higher than given, nor than the ones before allow: v2^2 - v1^2 = 2 a d."""
    squares = (speeds_mps**2 - 2.0 * limit_m_s2 * lengths_m).tolist()
    lowest = np.minimum.accumulate(squares)
    return np.asarray(np.sqrt(lowest + 2.0 * limit_m_s2 * lengths_m))


def _beyond_the_ends(knots_s: Array, seconds: Array, s: Array) -> Array:
    """Places (N,) at some moments, of those (K,) that are known; before and after, on at the same speed."""
    first, last = (s[1] - s[0]) / (seconds[1] - seconds[0]), (s[-1] - s[-2]) / (seconds[-1] - seconds[-2])
    inside = CubicSpline(seconds, s)(np.clip(knots_s, seconds[0], seconds[-1]))
    return np.asarray(inside + first * np.minimum(knots_s, 0.0) + last * np.maximum(knots_s - seconds[-1], 0.0))


def _sway(rng: np.random.Generator, seconds: Array, fastest_hz: float) -> Array:
    """A smooth random motion (N,) of unit deviation: three sines of random frequency and phase."""
    frequencies = rng.uniform(_FREQUENCIES_HZ[0] / 4.0, fastest_hz, 3)
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    return np.asarray(np.sin(2.0 * np.pi * np.outer(seconds, frequencies) + phases).sum(axis=1) / np.sqrt(1.5))
