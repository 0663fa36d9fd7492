"""How far the clocks of camera and GNSS receiver are apart, estimated from the vehicle's motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleetmap.drive import Antenna
from fleetmap.inspection.gnss_quality import GnssTrack
from fleetmap.inspection.path_fit import PathFit, fit_path
from fleetmap.inspection.path_model import Fixes, Lever
from fleetmap.inspection.visual_course import TURN_RAD, TimedMotion, VisualCourse, turning_courses

MAX_OFFSET_S = 1.0  # larger ones are not searched for
MAX_SIGMA_S = 0.05  # less certain than this is not an answer
_MIN_STRETCH_S = 4.0
_MIN_FIXES = 4
_STARTS_S = (-0.6, 0.0, 0.6)
_END_MARGIN_S = 0.2  # fixes closer to the ends of a stretch may belong outside it
_SIGMA_FLOOR_S = 0.003
_LEVER_SIGMA_M, _ASSUMED_LEVER_SIGMA_M = 0.05, 1.0
_SIGMA_RANGE_M = (0.02, 5.0)


@dataclass(frozen=True)
class ClockOffset:
    """Camera stamp minus GNSS stamp of the same instant, or why it cannot be told."""

    offset_s: float | None  # positive: the camera's stamps are later
    sigma_s: float | None
    reason: str | None  # why there is no offset
    scatter_m: float | None  # white noise of the fixes about the path, per horizontal axis; None where unknown


def estimate_clock_offset(motions: Sequence[TimedMotion], track: GnssTrack, antenna: Antenna) -> ClockOffset:
    """The clocks' offset from all stretches of images that turn.

    Args:
        motions: between successive images, in time order; gaps split the drive into stretches.
        track: the fixes of the same drive.
        antenna: where it sits in the camera's frame. One that is only assumed to be at the camera makes the
            answer uncertain: half a metre further ahead looks like a clock that is some hundredths late.
    """
    courses = turning_courses(motions)
    turning = [c for c in courses if c.turned_rad >= TURN_RAD and c.duration_s >= _MIN_STRETCH_S]
    if not turning:
        return _unobservable("the images show no turn of 15 degrees or more with the vehicle under way")
    fits = [fit for course in turning if (fit := _fit(course, track, antenna)) is not None]
    if not fits:
        return _unobservable(f"fewer than {_MIN_FIXES} fixes during the turns that the images show")
    return _combined(fits, antenna)


def _unobservable(reason: str, scatter_m: float | None = None) -> ClockOffset:
    return ClockOffset(None, None, reason, scatter_m)


def _fixes_during(course: VisualCourse, track: GnssTrack) -> Fixes:
    times_s = np.asarray((track.stamps_ns - course.start_ns) * 1e-9, dtype=np.float64)
    inside = (times_s > _END_MARGIN_S) & (times_s < course.duration_s - _END_MARGIN_S)
    points = track.positions_m[inside, :2]
    if len(points) == 0:
        return Fixes(times_s[inside], points, _SIGMA_RANGE_M[1])
    sigma_m = float(np.clip(np.median(track.sigmas_m[inside]), *_SIGMA_RANGE_M))
    return Fixes(times_s[inside], np.asarray(points - points.mean(axis=0), dtype=np.float64), sigma_m)


def _fit(course: VisualCourse, track: GnssTrack, antenna: Antenna) -> PathFit | None:
    """The best fit of one stretch over several starts; None where it has too few fixes or none converges."""
    fixes = _fixes_during(course, track)
    if len(fixes.times_s) < _MIN_FIXES:
        return None
    lever = Lever(course.forward_left_from_cam @ antenna.position_in_cam_m, _LEVER_SIGMA_M)
    found = [fit for start in _STARTS_S if (fit := fit_path(course, fixes, lever, start)) is not None]
    within = [fit for fit in found if abs(fit.offset_s) <= MAX_OFFSET_S]
    return min(within, key=lambda fit: fit.cost, default=None)


def _combined(fits: list[PathFit], antenna: Antenna) -> ClockOffset:
    """The mean weighted by information; stretches that disagree widen its sigma."""
    offsets = np.array([fit.offset_s for fit in fits])
    variances = np.array([fit.sigma_s for fit in fits]) ** 2 + _SIGMA_FLOOR_S**2
    weights = 1.0 / variances
    offset_s = float((weights * offsets).sum() / weights.sum())
    disagreement = float((weights * (offsets - offset_s) ** 2).sum()) / max(len(fits) - 1, 1)
    sigma_s = float(np.sqrt(max(disagreement, 1.0) / weights.sum()))
    scatter_m = float(np.median([fit.scatter_m for fit in fits]))
    found = f"{offset_s:.3f} +- {sigma_s:.3f} s"
    if antenna.source == "assumed at the camera":
        speed_mps = float(np.median([fit.speed_mps for fit in fits]))
        sigma_s = float(np.hypot(sigma_s, _ASSUMED_LEVER_SIGMA_M / max(speed_mps, 1e-3)))
        if sigma_s > MAX_SIGMA_S:
            return _unobservable(f"it is {found} if the antenna is at the camera, but nothing says so", scatter_m)
    if sigma_s > MAX_SIGMA_S:
        return _unobservable(f"the turns determine it to {sigma_s:.2f} s only", scatter_m)
    return ClockOffset(offset_s, sigma_s, None, scatter_m)
