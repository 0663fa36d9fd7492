"""Light GNSS alignment while mapping: keeps the drift of the growing map small.

    min over {T_i} of sum_i rho(|u_i - S o trans(T_i)|^2 in Sigma_i), poses only, S fixed

Keyframes are tied to one another by the visual motion between them, which may drift as fleetmap_mapper.drift_path
has it: keyframes without a fix are carried along, the noise of single fixes does not shake the map, and fixes that
are far off are left out. The latest keyframes move, each with the landmarks it carries; the first of them holds
still, so nothing tears where they join the older ones, and S takes up the rest. A vision-only local adjustment
follows.
"""

from __future__ import annotations

import itertools
from collections.abc import Reversible

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import InputError
from fleetmap.geometry import Sim3, nearest_rotations
from fleetmap_mapper.drift_path import Timed
from fleetmap_mapper.georeferencing import GnssTrack, check_observable
from fleetmap_mapper.gnss_consensus import find_consensus
from fleetmap_mapper.growing_map import GrowingMap
from fleetmap_mapper.local_mapping import adjust_locally
from fleetmap_mapper.settings import MapperSettings
from fleetmap_mapper.slam import PosedFrame
from fleetmap_mapper.straightening import local_moves, move_keyframes


class GnssAligner:
    """Called after every keyframe; acts after every fifth, once the fixes determine S."""

    def __init__(self, track: GnssTrack, settings: MapperSettings) -> None:
        self._track = track
        self._settings = settings
        self._placed: tuple[GrowingMap, Sim3] | None = None  # the last map aligned, and where it lies
        self._latest_fix_ns = 0  # that an alignment has used

    def __call__(self, growing: GrowingMap, posed: Reversible[PosedFrame]) -> None:
        """Align the latest keyframes if it is time to; ``posed`` is in time order."""
        settings = self._settings.gnss
        if len(growing.keyframes) % settings.align_every:
            return
        latest = growing.keyframes[-settings.align_window :]
        stamps_ns = np.array([k.stamp_ns for k in latest], dtype=np.int64)
        track = _one_fix_per_keyframe(self._track, stamps_ns)
        frames = _frames_since(posed, int(stamps_ns[0]) if latest[0].index else None)
        frame_stamps_ns = np.array([p.stamp_ns for p in frames], dtype=np.int64)
        path = Timed.of(frame_stamps_ns, [p.vis_from_cam for p in frames])
        fixes = np.flatnonzero(path.covers(track.stamps_ns))
        try:
            check_observable(fixes, track)
        except InputError:
            return  # not yet determined; later keyframes will see more
        if track.stamps_ns[fixes[-1]] <= self._latest_fix_ns:
            return  # what the fixes say has been heard
        known = self._placed[1] if self._placed is not None and self._placed[0] is growing else None
        consensus = find_consensus(
            path, track, with_clock=settings.estimate_clock_offset, seed=self._settings.seed, start=known
        )
        if consensus is None:
            return
        moves = local_moves(latest, consensus)
        S = moves[0] @ consensus.map_from_vis  # what the first keyframe would have done, the map's place does
        S = Sim3(S.scale, nearest_rotations(S.rotation), S.translation_m)
        move_keyframes(growing, latest, [S.inverse() @ move @ consensus.map_from_vis for move in moves], posed)
        self._placed, self._latest_fix_ns = (growing, S), int(track.stamps_ns[fixes[-1]])
        adjust_locally(growing, latest[-1], self._settings.mapping.window)


def _frames_since(posed: Reversible[PosedFrame], stamp_ns: int | None) -> list[PosedFrame]:
    """The latest of some frames in time order; all of them without a stamp."""
    latest = list(itertools.takewhile(lambda p: stamp_ns is None or p.stamp_ns >= stamp_ns, reversed(posed)))
    return latest[::-1]


def _one_fix_per_keyframe(track: GnssTrack, keyframe_stamps_ns: NDArray[np.int64]) -> GnssTrack:
    """The fix nearest in time to every keyframe, each once."""
    chosen = np.unique(_nearest(track.stamps_ns, keyframe_stamps_ns))
    return GnssTrack(
        track.anchor,
        track.stamps_ns[chosen],
        track.positions_m[chosen],
        track.covariances_m2[chosen],
        track.antenna_in_cam_m,
    )


def _nearest(sorted_stamps_ns: NDArray[np.int64], stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of the nearest of some sorted stamps to each stamp."""
    after = np.clip(np.searchsorted(sorted_stamps_ns, stamps_ns), 1, max(len(sorted_stamps_ns) - 1, 1))
    after = np.minimum(after, len(sorted_stamps_ns) - 1)
    before = np.maximum(after - 1, 0)
    is_before = np.abs(stamps_ns - sorted_stamps_ns[before]) <= np.abs(sorted_stamps_ns[after] - stamps_ns)
    return np.where(is_before, before, after)
