"""How good a map is, by its own lights, and whether it should be published."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fleetmap.drive import Drive
from fleetmap.manifest import Quality
from fleetmap.trajectory import Trajectory
from fleetmap_mapper.georeferenced_map import PlacedMap, reprojection_errors_px
from fleetmap_mapper.georeferencing import GnssTrack, PathPoint
from fleetmap_mapper.settings import MapperSettings

Array = NDArray[np.float64]


def assess(
    placed: PlacedMap,
    trajectory: Trajectory,
    path: Sequence[PathPoint],
    track: GnssTrack,
    drive: Drive,
    settings: MapperSettings,
) -> Quality:
    """Figures about a placed map; ``path`` is the camera at each fix, in map."""
    residuals = np.array(
        [p.pose.transform(track.antenna_in_cam_m) - track.positions_m[p.fix] for p in path]
    ).reshape(-1, 3)
    covariances = track.covariances_m2[[p.fix for p in path]]
    reprojection = reprojection_errors_px(placed) / placed.sigmas_px[:, None]
    rms_px = float(np.sqrt(np.nanmean((reprojection**2).sum(axis=1))))
    steps_m = np.linalg.norm(np.diff(trajectory.positions_m, axis=0), axis=1)
    warnings = _warnings(trajectory, drive.frame_count, rms_px, residuals, covariances, settings)
    return Quality(
        keyframes=len(placed.poses),
        landmarks=len(placed.points_m),
        observations=len(placed.pixels),
        length_m=float(steps_m.sum()),
        frames_total=drive.frame_count,
        frames_posed=len(trajectory),
        reprojection_rms_px=rms_px,
        gnss_fixes=len(path),
        gnss_residual_rms_m=float(np.sqrt((residuals**2).sum(axis=1).mean())) if len(path) else None,
        gnss_mode=settings.gnss.mode,
        publishable=not warnings,
        warnings=tuple(warnings),
    )


def _warnings(
    trajectory: Trajectory,
    frames_total: int,
    rms_px: float,
    residuals_m: Array,
    covariances_m2: Array,
    settings: MapperSettings,
) -> list[str]:
    limits, found = settings.quality, []
    if len(trajectory) < limits.min_posed_ratio * frames_total:
        found.append(f"only {len(trajectory)} of {frames_total} images could be posed")
    gap_s = float(np.diff(trajectory.stamps_ns).max(initial=0)) * 1e-9
    if gap_s > limits.max_unposed_gap_s:
        found.append(f"no image is posed for {gap_s:.1f} s in mid-drive")
    if rms_px > limits.max_reprojection_rms_px:
        found.append(f"reprojection errors of {rms_px:.2f} px (limit {limits.max_reprojection_rms_px:g})")
    normalised = np.einsum("fi,fij,fj->f", residuals_m, np.linalg.inv(covariances_m2), residuals_m) / 3.0
    sigmas = float(np.sqrt(np.median(normalised)))
    if settings.gnss.mode != "none" and sigmas > limits.max_gnss_residual_sigmas:
        found.append(
            f"the map misses its GNSS fixes by {sigmas:.1f} sigma (limit {limits.max_gnss_residual_sigmas:g})"
        )
    return found
