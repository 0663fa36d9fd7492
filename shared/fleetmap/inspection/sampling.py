"""Which images are looked at: enough to judge a drive, few enough to be quick."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fleetmap.inspection.gnss_quality import GnssTrack

Stamps = NDArray[np.int64]
Pair = tuple[int, int]

_RATE_HZ = 10.0  # motion is followed at about this rate
_MAX_MOTIONS = 800
_SPREAD_PAIRS = 150  # over a drive that is too long to be followed throughout
_WINDOW_S = 24.0  # about a turn
_HEADING_STEP_M = 3.0


def pairs_to_follow(stamps_ns: Stamps, track: GnssTrack | None) -> list[Pair]:
    """Indices of images between which the camera's motion is measured, in order of time, each once.

    All of a short drive. Of a long one some pairs everywhere, and without a break the images about its
    strongest turns, as the fixes show them.
    """
    if len(stamps_ns) < 2:
        return []
    duration_s = float(stamps_ns[-1] - stamps_ns[0]) * 1e-9
    rate_hz = (len(stamps_ns) - 1) / max(duration_s, 1e-9)
    stride = max(1, round(rate_hz / _RATE_HZ))
    grid = np.arange(0, len(stamps_ns), stride)
    chain = [(int(first), int(second)) for first, second in pairwise(grid)]
    if len(chain) <= _MAX_MOTIONS:
        return chain
    spread = np.linspace(0, len(chain) - 1, _SPREAD_PAIRS).round().astype(int)
    wanted = np.zeros(len(chain), dtype=bool)
    wanted[spread] = True
    if track is not None:
        middles_ns = stamps_ns[grid[:-1]]
        for turn_ns in _turns_ns(track):
            window = np.abs(middles_ns - turn_ns) <= _WINDOW_S / 2.0 * 1e9
            if np.count_nonzero(wanted | window) <= _MAX_MOTIONS:
                wanted |= window
    return [pair for pair, is_wanted in zip(chain, wanted, strict=True) if is_wanted]


def _turns_ns(track: GnssTrack) -> list[int]:
    """Where the fixes turn most within a few seconds, strongest first."""
    points = track.positions_m[:, :2]
    chosen = [0]
    for index in range(1, len(points)):
        if np.linalg.norm(points[index] - points[chosen[-1]]) >= _HEADING_STEP_M + 5.0 * track.sigmas_m[index]:
            chosen.append(index)
    if len(chosen) < 4:
        return []
    steps = np.diff(points[chosen], axis=0)
    heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    times_s = track.times_s[chosen]
    middles_s = 0.5 * (times_s[:-1] + times_s[1:])
    even_s = np.arange(middles_s[0], middles_s[-1], 1.0)
    change = np.abs(np.interp(even_s + 3.0, middles_s, heading) - np.interp(even_s - 3.0, middles_s, heading))
    strongest: list[int] = []
    while len(strongest) < 100 and change.size and change.max() > np.radians(15.0):
        best = int(np.argmax(change))
        strongest.append(int(track.stamps_ns[0] + even_s[best] * 1e9))
        change[np.abs(even_s - even_s[best]) < _WINDOW_S / 2.0] = 0.0
    return strongest
