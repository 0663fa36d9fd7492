"""Which way a vehicle went, as its camera alone tells: heading and direction of travel, without scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fleetmap.vision.frame_motion import FrameMotion

Array = NDArray[np.float64]

_MAX_STEP_NS = 700_000_000  # images further apart than this say nothing about the way between them
TURN_RAD = np.radians(15.0)  # a turn changes the heading by this at least
_TURN_S = 2.5  # before and after a moment, to see whether it lies in a turn
_LEAD_S = 8.0  # kept before and after a turn
_MAX_STRETCH_S = 40.0
_SURE_DIRECTION_RAD = np.radians(4.0)
_TURN_WINDOW_S = 1.0
_LEVEL_PRIOR_RAD = 0.02  # per turn window: how strongly a drive without turns is believed to have a level camera


@dataclass(frozen=True)
class TimedMotion:
    """The motion between two images; None where it could not be measured."""

    first_ns: int
    second_ns: int
    motion: FrameMotion | None


@dataclass(frozen=True)
class VisualCourse:
    """An unbroken stretch of images, N >= 2. Angles are counter-clockwise from above, 0 at the start."""

    start_ns: int
    times_s: Array  # (N,) since start_ns
    heading_rad: Array  # (N,) of the camera
    course_rad: Array  # (N - 1,) direction from each image's position to the next one's, on the same zero
    forward_left_from_cam: Array  # (2, 3) the level axes that are angle 0 and 90 degrees at the start

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last image."""
        return float(self.times_s[-1])

    @property
    def turned_rad(self) -> float:
        """How far apart the headings are, at most."""
        return float(np.ptp(self.heading_rad))


def turning_courses(motions: Sequence[TimedMotion]) -> list[VisualCourse]:
    """The courses of all unbroken stretches that turn, with some seconds before and after.

    Straights are left out: their slight weaving would tell something as well, but no more than a receiver's
    slow errors pretend.
    """
    runs = _unbroken(motions)
    if not runs:
        return []
    up = _up_in_cam(runs)
    forward = _forward_in_cam(runs, up)
    stretches = [part for run in runs for turn in _around_turns(run, up) for part in _parts(turn, _MAX_STRETCH_S)]
    return [_course(stretch, up, forward) for stretch in stretches]


_Run = list[tuple[int, int, FrameMotion]]


def _unbroken(motions: Sequence[TimedMotion]) -> list[_Run]:
    runs: list[_Run] = []
    end_ns: int | None = None
    for timed in motions:
        if timed.motion is None or not 0 < timed.second_ns - timed.first_ns <= _MAX_STEP_NS:
            end_ns = None
            continue
        if end_ns != timed.first_ns:
            runs.append([])
        runs[-1].append((timed.first_ns, timed.second_ns, timed.motion))
        end_ns = timed.second_ns
    return runs


def _around_turns(run: _Run, up: Array) -> list[_Run]:
    """The stretches of a run in which the heading changes quickly, and what leads in and out."""
    stamps_ns = np.array([run[0][0], *(second_ns for _, second_ns, _ in run)])
    times_s = (stamps_ns - stamps_ns[0]) * 1e-9
    heading = np.concatenate([[0.0], np.cumsum([motion.rotation_rad @ up for _, _, motion in run])])
    before, after = (np.interp(times_s + shift_s, times_s, heading) for shift_s in (-_TURN_S, _TURN_S))
    turning_s = times_s[np.abs(after - before) >= TURN_RAD]
    if len(turning_s) == 0:
        return []
    groups = np.split(turning_s, np.flatnonzero(np.diff(turning_s) > 2.0 * _LEAD_S) + 1)
    spans = [(group[0] - _LEAD_S, group[-1] + _LEAD_S) for group in groups]
    edges = [np.searchsorted(times_s[1:], span).tolist() for span in spans]
    return [run[start : stop + 1] for start, stop in edges]


def _parts(run: _Run, max_duration_s: float) -> list[_Run]:
    duration_s = (run[-1][1] - run[0][0]) * 1e-9
    count = int(np.ceil(duration_s / max_duration_s))
    edges = np.linspace(0, len(run), count + 1).round().astype(int)
    return [run[start:stop] for start, stop in pairwise(edges) if stop > start]


def _up_in_cam(runs: list[_Run]) -> Array:
    """The axis (3,) a vehicle turns about: the principal axis of its turns, minus the camera's y without any."""
    level = np.array([0.0, 1.0, 0.0])
    spread = np.zeros((3, 3))
    for run in runs:
        for part in _parts(run, _TURN_WINDOW_S):
            turn = np.sum([motion.rotation_rad for _, _, motion in part], axis=0)
            spread += np.outer(turn, turn) + _LEVEL_PRIOR_RAD**2 * np.outer(level, level)
    axis = np.linalg.eigh(spread)[1][:, -1]
    return np.asarray(axis if axis[1] < 0.0 else -axis)


def _forward_in_cam(runs: list[_Run], up: Array) -> Array:
    """The usual direction of travel (3,) across ``up``; what "straight ahead" means, its choice is arbitrary."""
    total = np.zeros(3)
    for run in runs:
        for _, _, motion in run:
            if motion.direction_sigma_rad < _SURE_DIRECTION_RAD:
                total += motion.direction
    flat = total - up * (up @ total)
    if np.linalg.norm(flat) < 1e-9:
        flat = np.cross([1.0, 0.0, 0.0], up)
    return np.asarray(flat / np.linalg.norm(flat))


def _course(run: _Run, up: Array, forward: Array) -> VisualCourse:
    stamps_ns = np.array([run[0][0], *(second_ns for _, second_ns, _ in run)])
    left = np.cross(up, forward)
    turns = np.array([motion.rotation_rad @ up for _, _, motion in run])
    heading = np.concatenate([[0.0], np.cumsum(turns)])
    directions = np.array([motion.direction for _, _, motion in run])
    drift = np.arctan2(directions @ left, directions @ forward)
    sure = np.array([motion.direction_sigma_rad < _SURE_DIRECTION_RAD for _, _, motion in run])
    rows = np.arange(len(run))
    drift = np.interp(rows, rows[sure], np.unwrap(drift[sure])) if sure.any() else np.zeros(len(run))
    return VisualCourse(
        start_ns=int(stamps_ns[0]),
        times_s=(stamps_ns - stamps_ns[0]) * 1e-9,
        heading_rad=heading,
        course_rad=heading[:-1] + drift,
        forward_left_from_cam=np.stack([forward, left]),
    )
