"""Light GNSS alignment while mapping: keeps the drift of the growing map small.

    min over {T_i} of sum_i rho(|u_i - S o trans(T_i)|^2 in Sigma_i), poses only, S fixed

Every keyframe is also tied to the one before by the visual motion between them, so that keyframes without a
fix are carried along and the white noise of single fixes does not shake the map. Positions only are moved:
the system is tridiagonal. Landmarks follow their reference keyframe; a vision-only local adjustment follows.
"""

from __future__ import annotations

import itertools
from collections.abc import Reversible, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from fleetmap.errors import InputError
from fleetmap.geometry import Pose
from fleetmap_mapper.georeferencing import HUBER_SIGMAS, GnssTrack, georeference, path_at_fixes
from fleetmap_mapper.growing_map import GrowingMap, Keyframe
from fleetmap_mapper.local_mapping import adjust_locally
from fleetmap_mapper.settings import MapperSettings
from fleetmap_mapper.slam import PosedFrame

Array = NDArray[np.float64]
_VISUAL_DRIFT = 0.01  # of the distance driven: what monocular odometry loses over tens of metres
_REWEIGHTINGS = 5


class GnssAligner:
    """Called after every keyframe; acts after every fifth, once the fixes determine S."""

    def __init__(self, track: GnssTrack, settings: MapperSettings) -> None:
        self._track = track
        self._settings = settings

    def __call__(self, growing: GrowingMap, posed: Reversible[PosedFrame]) -> None:
        """Align the latest keyframes if it is time to; ``posed`` is in time order."""
        settings = self._settings
        if len(growing.keyframes) % settings.gnss.align_every:
            return
        latest = growing.keyframes[-settings.gnss.align_window :]
        stamps_ns = np.array([k.stamp_ns for k in latest], dtype=np.int64)
        track = _one_fix_per_keyframe(self._track, stamps_ns)
        frames = _frames_since(posed, int(stamps_ns[0]) if latest[0].index else None)
        frame_stamps_ns = np.array([p.stamp_ns for p in frames], dtype=np.int64)
        path = path_at_fixes(frame_stamps_ns, [p.vis_from_cam for p in frames], track)
        try:
            S = georeference(path, track, settings.gnss.level_sigma_deg)
        except InputError:
            return  # not yet determined; later keyframes will see more
        fixes = np.array([p.fix for p in path])
        antennas = np.array([S.transform_pose(p.pose).transform(track.antenna_in_cam_m) for p in path])
        corrections = smooth_corrections(
            np.array([S.transform(k.vis_from_cam.translation_m) for k in latest]),
            _nearest(stamps_ns, track.stamps_ns[fixes]),
            track.positions_m[fixes] - antennas,
            track.covariances_m2[fixes],
            is_start_free=latest[0].index == 0,
        )
        _move(growing, latest, corrections @ S.rotation / S.scale)
        adjust_locally(growing, latest[-1], settings.mapping.window)


def _frames_since(posed: Reversible[PosedFrame], stamp_ns: int | None) -> list[PosedFrame]:
    """The latest of some frames in time order; all of them without a stamp."""
    latest = list(itertools.takewhile(lambda p: stamp_ns is None or p.stamp_ns >= stamp_ns, reversed(posed)))
    return latest[::-1]


def smooth_corrections(
    positions_m: Array,
    at: NDArray[np.int64],
    residuals_m: Array,
    covariances_m2: Array,
    is_start_free: bool = True,
) -> Array:
    """Corrections (K, 3) of keyframe positions (K, 3) in map that meet the residuals (F, 3) of fixes.

    ``at`` (F,) names the keyframe of each fix. Where the start is not free, the first keyframe stays close to its
    place, as the one before it does not move.

    Axis by axis least squares, reweighted for Huber's rho, of fix terms and of differences between neighbours.
    """
    steps = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    stiffness = 1.0 / (_VISUAL_DRIFT * np.maximum(steps, 0.1)) ** 2
    information = 1.0 / np.diagonal(covariances_m2, axis1=1, axis2=2)
    corrections = np.zeros_like(positions_m)
    for _ in range(_REWEIGHTINGS):
        errors = np.sqrt(((residuals_m - corrections[at]) ** 2 * information).sum(axis=1))
        weights = information * np.minimum(1.0, HUBER_SIGMAS / np.maximum(errors, 1e-9))[:, None]
        for axis in range(3):
            banded = np.zeros((2, len(positions_m)))
            banded[1, :-1] += stiffness
            banded[1, 1:] += stiffness
            banded[0, 1:] = -stiffness
            banded[1, 0] += 0.0 if is_start_free else stiffness[0]
            np.add.at(banded[1], at, weights[:, axis])
            right = np.zeros(len(positions_m))
            np.add.at(right, at, weights[:, axis] * residuals_m[:, axis])
            corrections[:, axis] = solveh_banded(banded, right)
    return corrections


def _move(growing: GrowingMap, keyframes: Sequence[Keyframe], shifts_in_vis: Array) -> None:
    """Shift the latest keyframes (K, 3), and each landmark with the keyframe that carries it."""
    for keyframe, shift in zip(keyframes, shifts_in_vis, strict=True):
        pose = keyframe.vis_from_cam
        keyframe.vis_from_cam = Pose(pose.rotation, pose.translation_m + shift)
    landmarks = growing.landmarks_of(keyframes)
    rows = growing.reference[landmarks] - keyframes[0].index
    growing.points[landmarks[rows >= 0]] += shifts_in_vis[rows[rows >= 0]]


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
