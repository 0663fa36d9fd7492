"""The fixes of a drive as the mapper takes them: in the camera's clock, and without those that are far off."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.manifest import Quality
from fleetmap_mapper.drift_path import Timed
from fleetmap_mapper.georeferencing import GnssTrack
from fleetmap_mapper.gnss_consensus import Consensus, find_consensus
from fleetmap_mapper.settings import GnssGroup

_log = logging.getLogger(__name__)

Array = NDArray[np.float64]

_CLEAR_SIGMAS = 4.0  # an offset smaller than this is none
_FLOOR_S = 0.01  # exposure, lever arm and readout are not known better than this
_MIN_FIXES = 15  # fewer cannot tell an offset from scale that was lost in the corners
_DETERMINED_S = 0.05  # an offset less certain than this is none
_CONVERGED_S = 0.002
_ROUNDS = 4


@dataclass(frozen=True)
class ClockOffset:
    """The camera's stamp minus the receiver's stamp of the same instant."""

    offset_s: float
    sigma_s: float
    fixes: int  # that it comes from

    @property
    def is_clear(self) -> bool:
        """Whether the drive proves that there is one."""
        determined = self.sigma_s < _DETERMINED_S and self.fixes >= _MIN_FIXES
        return determined and abs(self.offset_s) > _CLEAR_SIGMAS * self.sigma_s


@dataclass(frozen=True)
class ScreenedFixes:
    """The fixes to believe."""

    track: GnssTrack  # stamps in the camera's clock
    rejected: int
    clock: ClockOffset | None  # None where it was not asked for or no stretch has fixes enough
    consensus: list[Consensus | None]  # of every path


def screen_fixes(paths: Sequence[Timed], track: GnssTrack, settings: GnssGroup, seed: int = 0) -> ScreenedFixes:
    """Hold the fixes against the camera paths of a drive's segments, each in a free-scale frame of its own.

    One clock offset is common to all segments. It is taken off where the drive proves it, see ClockOffset. A fix
    that no segment can judge is believed.
    """
    offset_s, clock = 0.0, None
    for _ in range(_ROUNDS):
        found = [find_consensus(p, track, offset_s, settings.estimate_clock_offset, seed) for p in paths]
        clock = (
            _combined([c for c in found if c is not None], offset_s) if settings.estimate_clock_offset else None
        )
        wanted_s = clock.offset_s if clock is not None and clock.is_clear else 0.0
        if abs(wanted_s - offset_s) < _CONVERGED_S:
            break
        offset_s = wanted_s
    rejected = np.zeros(len(track), dtype=bool)
    for consensus in found:
        if consensus is not None and settings.reject_outliers:
            rejected[consensus.chain.fixes[~consensus.believed]] = True
    late_ns = round(clock.offset_s * 1e9) if clock is not None and clock.is_clear else 0
    screened = ScreenedFixes(_chosen(track, ~rejected, late_ns), int(rejected.sum()), clock, found)
    _report(screened, len(track))
    return screened


def with_screening(quality: Quality, screened: ScreenedFixes) -> Quality:
    """The quality of a map with what became of its fixes."""
    clock = screened.clock
    return quality.model_copy(
        update={
            "gnss_fixes_rejected": screened.rejected,
            "clock_offset_s": None if clock is None else clock.offset_s,
            "clock_offset_sigma_s": None if clock is None else clock.sigma_s,
            "clock_offset_removed": clock is not None and clock.is_clear,
        }
    )


def _chosen(track: GnssTrack, rows: NDArray[np.bool_], later_ns: int) -> GnssTrack:
    return replace(
        track,
        stamps_ns=track.stamps_ns[rows] + later_ns,
        positions_m=track.positions_m[rows],
        covariances_m2=track.covariances_m2[rows],
    )


def _combined(found: Sequence[Consensus], offset_s: float) -> ClockOffset | None:
    """The mean over segments, weighted by information."""
    if not found:
        return None
    weights = np.array([1.0 / c.clock_sigma_s**2 for c in found])
    left_s = np.array([c.bend.clock_s for c in found])
    offset_s += float(weights @ left_s / weights.sum())
    believed = sum(int(c.believed.sum()) for c in found)
    return ClockOffset(offset_s, float(np.hypot(1.0 / np.sqrt(weights.sum()), _FLOOR_S)), believed)


def _report(screened: ScreenedFixes, fixes: int) -> None:
    if screened.rejected:
        _log.info("%d of %d GNSS fixes are far off and left out", screened.rejected, fixes)
    clock = screened.clock
    if clock is not None:
        done = "taken off" if clock.is_clear else "not clear, left alone"
        _log.info("clock offset %.3f +- %.3f s: %s", clock.offset_s, clock.sigma_s, done)
