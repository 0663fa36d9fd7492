"""What the finished map's own figures are, from place to place along the road."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fleetmap.road_quality import FixQuality, KeyframeQuality, RoadQuality, horizontal_sigmas_m
from fleetmap.trajectory import Trajectory
from fleetmap_mapper.georeferencing import GnssTrack, PathPoint
from fleetmap_mapper.placed_map import PlacedMap, reprojection_errors_px

Array = NDArray[np.float64]
_GAP_INTERVALS = 2.5  # of the usual time between posed images; one image missed is none yet
_STEP_M = 10.0  # over which landmarks are counted
_LEAST_WIDTH_M = 1e-3


def measure_road(
    placed: PlacedMap, trajectory: Trajectory, path: Sequence[PathPoint], track: GnssTrack, gap_s: float
) -> RoadQuality:
    """Figures along the road; ``path`` is the camera at each fix, in map. Gaps last longer than ``gap_s``."""
    keyframes = _keyframe_quality(placed, trajectory)
    along_m = way_driven_m(trajectory)
    edges_m = _edges_m(float(along_m[-1]))
    gaps = _gaps(trajectory.stamps_ns, gap_s)
    return RoadQuality(
        keyframes,
        _fix_quality(trajectory, path, track),
        edges_m,
        _landmarks_per_m(placed, keyframes.along_m, edges_m).astype(np.float32),
        trajectory.stamps_ns[gaps],
        along_m[gaps],
    )


def way_driven_m(trajectory: Trajectory) -> Array:
    """Metres driven (N,) from the first posed image to each."""
    steps_m = np.linalg.norm(np.diff(trajectory.positions_m, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps_m)])


def _along_m(trajectory: Trajectory, stamps_ns: NDArray[np.int64]) -> Array:
    start_ns = trajectory.stamps_ns[0]
    return np.asarray(np.interp(stamps_ns - start_ns, trajectory.stamps_ns - start_ns, way_driven_m(trajectory)))


def _keyframe_quality(placed: PlacedMap, trajectory: Trajectory) -> KeyframeQuality:
    count = len(placed.poses)
    squares = ((reprojection_errors_px(placed) / placed.corner_sigmas_px[:, None]) ** 2).sum(axis=1)
    counted = np.isfinite(squares)
    index = placed.keyframe_index[counted]
    seen = np.bincount(index, minlength=count)
    sums = np.bincount(index, weights=squares[counted], minlength=count)
    return KeyframeQuality(
        placed.keyframe_stamps_ns,
        _along_m(trajectory, placed.keyframe_stamps_ns),
        np.array([pose.translation_m for pose in placed.poses]),
        placed.position_covariances_m2.astype(np.float32),
        np.sqrt(sums / np.maximum(seen, 1)).astype(np.float32),
        np.bincount(placed.keyframe_index, minlength=count).astype(np.int32),
    )


def _fix_quality(trajectory: Trajectory, path: Sequence[PathPoint], track: GnssTrack) -> FixQuality:
    fixes = np.array([point.fix for point in path], dtype=np.int64)
    residuals_m = np.array(
        [point.pose.transform(track.antenna_in_cam_m) - track.positions_m[point.fix] for point in path]
    ).reshape(-1, 3)
    whitened = np.einsum("fi,fij,fj->f", residuals_m, np.linalg.inv(track.covariances_m2[fixes]), residuals_m)
    return FixQuality(
        track.stamps_ns[fixes],
        _along_m(trajectory, track.stamps_ns[fixes]),
        residuals_m.astype(np.float32),
        np.sqrt(whitened / 3.0).astype(np.float32),
        horizontal_sigmas_m(track.covariances_m2[fixes]).astype(np.float32),
    )


def _edges_m(length_m: float) -> Array:
    """Steps of about 10 m, all of one length."""
    length_m = max(length_m, _LEAST_WIDTH_M)
    return np.linspace(0.0, length_m, max(round(length_m / _STEP_M), 1) + 1)


def _landmarks_per_m(placed: PlacedMap, along_m: Array, edges_m: Array) -> Array:
    """Landmarks on each step (S,), over its length.

    A landmark counts in equal parts at the keyframes that see it, and a keyframe's part lies evenly between it and
    its neighbours, but not further away than half a step.
    """
    shares = 1.0 / np.bincount(placed.point_index)[placed.point_index]
    at_keyframe = np.bincount(placed.keyframe_index, weights=shares, minlength=len(along_m))
    middles_m = (along_m[1:] + along_m[:-1]) / 2.0
    half_m = (edges_m[1] - edges_m[0]) / 2.0
    from_m = np.maximum(np.concatenate([[0.0], middles_m]), along_m - half_m)
    to_m = np.minimum(np.concatenate([middles_m, edges_m[-1:]]), along_m + half_m)
    to_m = np.maximum(to_m, from_m + _LEAST_WIDTH_M)
    passed = ((edges_m[:, None] - from_m) / (to_m - from_m)).clip(0.0, 1.0) @ at_keyframe
    passed[-1] = at_keyframe.sum()
    return np.asarray(np.diff(passed) / np.diff(edges_m))


def _gaps(stamps_ns: NDArray[np.int64], gap_s: float) -> NDArray[np.int64]:
    """Pairs (G, 2) of neighbouring posed images with too long a time between them."""
    waits_s = np.diff(stamps_ns) * 1e-9
    usual_s = float(np.median(waits_s)) if len(waits_s) else 0.0
    before = np.flatnonzero(waits_s > max(gap_s, _GAP_INTERVALS * usual_s))
    return np.stack([before, before + 1], axis=1)
