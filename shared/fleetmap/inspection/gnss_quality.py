"""What the fixes of a drive are worth: kind of receiver, scatter, jumps, and how they cover the images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fleetmap.drive import GnssFix
from fleetmap.geodesy import UtmGrid

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
GnssKind = Literal["RTK", "float or differential", "single"]

_RTK_SIGMA_M, _FLOAT_SIGMA_M = 0.1, 0.7
_DENSE_STEP_S = 0.15  # neighbours closer than this differ by noise more than by the vehicle's acceleration
_ACCELERATION_MPS2 = 8.0  # what no car exceeds for long
_JUMP_SIGMAS = 5.0
_SPEED_STEP_S = 1.0
_STANDING_MPS, _FASTEST_MPS = 0.5, 100.0  # faster is a jump


@dataclass(frozen=True)
class GnssTrack:
    """Valid fixes in time order, in ground metres; M >= 1."""

    stamps_ns: Stamps  # (M,)
    positions_m: Array  # (M, 3) grid east, grid north, up, from the first fix
    sigmas_m: Array  # (M,) reported, per horizontal axis

    @staticmethod
    def of(fixes: Sequence[GnssFix]) -> GnssTrack:
        """The track of one fix or more."""
        lat, lon, height = np.array([(fix.lat_deg, fix.lon_deg, fix.height_m) for fix in fixes]).T
        somewhere = float(np.median(lat)), float(np.median(lon))  # the first fixes may be wild
        grid = UtmGrid.at(*somewhere)
        positions = grid.from_geodetic(lat, lon, height)
        positions = positions - positions[0]
        positions[:, :2] /= grid.point_scale_factor(*somewhere)
        variances = np.array([np.diag(fix.covariance_enu_m2)[:2].mean() for fix in fixes])
        stamps_ns = np.array([fix.stamp_ns for fix in fixes], dtype=np.int64)
        return GnssTrack(stamps_ns, positions, np.sqrt(variances))

    @property
    def times_s(self) -> Array:
        """Seconds (M,) since the first fix."""
        return np.asarray((self.stamps_ns - self.stamps_ns[0]) * 1e-9)

    def way_m(self, stamps_ns: Stamps) -> Array:
        """Metres driven (N,) from the first fix until each stamp, in steps of a second or more."""
        chosen = spaced(self.times_s, _SPEED_STEP_S)
        steps = np.linalg.norm(np.diff(self.positions_m[chosen, :2], axis=0), axis=1)
        way = np.concatenate([[0.0], np.cumsum(steps)])
        return np.asarray(np.interp((stamps_ns - self.stamps_ns[0]) * 1e-9, self.times_s[chosen], way))


@dataclass(frozen=True)
class GnssQuality:
    """Sigmas and scatter are per horizontal axis."""

    kind: GnssKind  # as the reported sigmas have it
    reported_sigma_m: float
    scatter_m: float | None  # white noise between neighbours; None where fixes are too sparse to tell
    jump_count: int  # fixes that no vehicle could have reached
    largest_jump_m: float
    covered_share: float  # of the images' time, between first and last fix
    uncovered_start_s: float
    uncovered_end_s: float
    is_same_time: bool  # whether images and fixes overlap at all
    speed_mps: float  # median while moving
    standing_share: float
    extent_m: float  # diagonal of the box around all fixes


def measure_gnss(track: GnssTrack, image_stamps_ns: Stamps) -> GnssQuality:
    """Judge a track against the images' stamps; without images it covers itself."""
    spans_ns = image_stamps_ns if len(image_stamps_ns) else track.stamps_ns
    start_ns, end_ns = int(spans_ns.min()), int(spans_ns.max())
    first_ns, last_ns = int(track.stamps_ns[0]), int(track.stamps_ns[-1])
    common_s = (min(end_ns, last_ns) - max(start_ns, first_ns)) * 1e-9
    sigma_m = float(np.median(track.sigmas_m))
    jumps_m = _jumps_m(track)
    speeds = _speeds_mps(track)
    moving = speeds[(speeds > _STANDING_MPS) & (speeds < _FASTEST_MPS)]
    return GnssQuality(
        kind=_kind(sigma_m),
        reported_sigma_m=sigma_m,
        scatter_m=_scatter_m(track),
        jump_count=len(jumps_m),
        largest_jump_m=float(jumps_m.max(initial=0.0)),
        covered_share=float(np.clip(common_s / max((end_ns - start_ns) * 1e-9, 1e-9), 0.0, 1.0)),
        uncovered_start_s=max(0.0, (first_ns - start_ns) * 1e-9),
        uncovered_end_s=max(0.0, (end_ns - last_ns) * 1e-9),
        is_same_time=common_s >= 0.0,
        speed_mps=float(np.median(moving)) if len(moving) else 0.0,
        standing_share=1.0 - len(moving) / len(speeds) if len(speeds) else 1.0,
        extent_m=float(np.linalg.norm(np.ptp(track.positions_m[:, :2], axis=0))),
    )


def _kind(sigma_m: float) -> GnssKind:
    if sigma_m <= _RTK_SIGMA_M:
        return "RTK"
    return "float or differential" if sigma_m <= _FLOAT_SIGMA_M else "single"


def spaced(times_s: Array, step_s: float) -> NDArray[np.intp]:
    """Indices of times at least ``step_s`` apart, the first and the last among them."""
    chosen = [0]
    for index in range(1, len(times_s)):
        if times_s[index] - times_s[chosen[-1]] >= step_s:
            chosen.append(index)
    if len(chosen) > 1:
        chosen.pop()  # the last step runs to the end
    return np.unique([*chosen, len(times_s) - 1])


def _bends(track: GnssTrack) -> tuple[Array, Array, Array, Array]:
    """Of every inner fix: its offset (M - 2, 2) from the line between its neighbours, the steps before and after
    in seconds, and by how much white noise is larger in such an offset."""
    before, after = np.diff(track.times_s)[:-1], np.diff(track.times_s)[1:]
    share = (before / np.maximum(before + after, 1e-9))[:, None]
    points = track.positions_m[:, :2]
    offsets = points[1:-1] - (1.0 - share) * points[:-2] - share * points[2:]
    return offsets, before, after, np.sqrt(1.0 + share**2 + (1.0 - share) ** 2).ravel()


def _scatter_m(track: GnssTrack) -> float | None:
    if len(track.stamps_ns) < 3:
        return None
    offsets, before, after, gain = _bends(track)
    dense = (before <= _DENSE_STEP_S) & (after <= _DENSE_STEP_S)
    if np.count_nonzero(dense) < 10:
        return None
    return float(1.4826 * np.median(np.abs(offsets[dense] / gain[dense, None])))


def _jumps_m(track: GnssTrack) -> Array:
    """How far (J,) fixes lie beside the line between their neighbours, where no acceleration explains it."""
    if len(track.stamps_ns) < 3:
        return np.zeros(0)
    offsets, before, after, gain = _bends(track)
    distances = np.linalg.norm(offsets, axis=1)
    possible = 0.5 * _ACCELERATION_MPS2 * before * after + _JUMP_SIGMAS * gain * track.sigmas_m[1:-1]
    return np.asarray(distances[distances > possible])


def _speeds_mps(track: GnssTrack) -> Array:
    chosen = spaced(track.times_s, _SPEED_STEP_S)
    steps_s = np.diff(track.times_s[chosen])
    metres = np.linalg.norm(np.diff(track.positions_m[chosen, :2], axis=0), axis=1)
    return np.asarray(metres[steps_s > 0.0] / steps_s[steps_s > 0.0])
