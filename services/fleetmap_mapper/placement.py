"""Where the free-scale frame ``vis`` lies in UTM: S in Sim(3) from camera positions and GNSS fixes.

Umeyama's alignment starts, and a robust least-squares fit with the fixes' covariances and the antenna's lever arm
finishes. On a nearly straight road positions leave the roll about the track free; there, and only there, the
camera is taken to be level on average.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fleetmap.geometry import Sim3, so3_exp, umeyama_alignment
from fleetmap_mapper.georeferencing import HUBER_SIGMAS, GnssTrack, PathPoint, check_observable, levelled
from fleetmap_mapper.level_prior import missing_level

Array = NDArray[np.float64]

_CLEAR_EVIDENCE = 10.0, 4.0  # in half chi-squares (over four sigmas) and, as drift inflates these, as a ratio


def georeference(path: Sequence[PathPoint], track: GnssTrack, level_sigma_deg: float) -> Sim3:
    """``map_from_vis``: places the camera path, given in ``vis``, on the fixes.

    ``level_sigma_deg`` is how level the camera is taken to be, on average, where the fixes leave its roll free.

    Raises:
        DriveError: too few fixes between the images, or a drive too short for their accuracy.
    """
    fixes = np.array([p.fix for p in path], dtype=np.int64)
    check_observable(fixes, track)
    positions = np.array([p.pose.translation_m for p in path])
    rotations = np.array([p.pose.rotation for p in path])
    targets = track.positions_m[fixes]
    whiten = np.linalg.inv(np.linalg.cholesky(track.covariances_m2[fixes]))
    centre = positions.mean(axis=0)

    def at(start: Sim3, delta: Array) -> Sim3:
        rotation = so3_exp(delta[:3]) @ start.rotation
        scale = start.scale * float(np.exp(delta[6]))
        moved_centre = start.transform(centre) + delta[3:6]
        return Sim3(scale, rotation, moved_centre - scale * rotation @ centre)

    def residuals(start: Sim3, delta: Array) -> Array:
        S = at(start, delta)
        antenna = S.transform(positions) + (S.rotation @ rotations) @ track.antenna_in_cam_m
        errors = np.einsum("fij,fj->fi", whiten, antenna - targets)
        norms = np.linalg.norm(errors, axis=1)
        huber = np.where(
            norms > HUBER_SIGMAS, np.sqrt(HUBER_SIGMAS * np.maximum(2 * norms - HUBER_SIGMAS, 0.0)), norms
        )
        errors *= (huber / np.maximum(norms, 1e-12))[:, None]
        return np.append(errors.ravel(), (S.rotation @ rotations)[:, 2, 0].mean() / prior.sigma_rad)

    def fitted(start: Sim3) -> tuple[float, Sim3]:
        fit = least_squares(partial(residuals, start), np.zeros(7), x_scale="jac")
        return float(fit.cost), at(start, fit.x)

    first = _umeyama_with_lever_arm(positions, rotations, targets, track.antenna_in_cam_m)
    level = levelled(first, positions, rotations)
    placed = [level.transform_pose(p.pose) for p in path]
    prior = missing_level(placed, np.arange(len(path)), _rows(track, fixes), np.radians(level_sigma_deg))
    cost, S = fitted(first)
    upright_cost, upright = fitted(level)
    # On a straight road a world turned upside down fits as well: only clear evidence may speak for it.
    least, ratio = _CLEAR_EVIDENCE
    return S if least + ratio * cost < upright_cost else upright


def _umeyama_with_lever_arm(positions: Array, rotations: Array, targets: Array, antenna_in_cam_m: Array) -> Sim3:
    """Umeyama on camera centres; the arm's direction in the map needs the rotation, so it is iterated."""
    S = umeyama_alignment(positions, targets)
    for _ in range(3):
        S = umeyama_alignment(positions, targets - (S.rotation @ rotations) @ antenna_in_cam_m)
    return S


def _rows(track: GnssTrack, fixes: NDArray[np.int64]) -> GnssTrack:
    return replace(
        track,
        stamps_ns=track.stamps_ns[fixes],
        positions_m=track.positions_m[fixes],
        covariances_m2=track.covariances_m2[fixes],
    )
