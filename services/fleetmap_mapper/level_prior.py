"""The direction that fixes leave free on a straight road is roll about the track. A level camera holds it.

Positions along a line say nothing about a turn about that line. So a camera is taken to be level on average, but
only with the weight that the fixes lack: how well they determine the roll is asked of the drifting path
(fleetmap_mapper.drift_path), which knows what vision loses on the way from a bend, where the roll is seen. And
where the fixes say that road or camera are banked, beyond what they and a level camera may differ, they are right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from numpy.typing import NDArray

from fleetmap.geometry import Pose, rotation_angle_rad, so3_log
from fleetmap_mapper.drift_path import Bend, Chain, DriftRates, gauss_newton_step, marginal_covariances
from fleetmap_mapper.georeferencing import GnssTrack

Array = NDArray[np.float64]

_UNKNOWN = np.array([1e3, 1e3, 1e3, 1.0, 1.0, 1.0, 1.0])  # sigmas of a path that lies anywhere: m, rad, log
_CONTRADICTION = 3.0  # sigmas


@dataclass(frozen=True)
class LevelPrior:
    """What a level camera adds to what the fixes know of the mean tilt of the camera's horizontal axis."""

    sigma_rad: float  # infinite where the fixes know enough, or know better
    tilt_by_fixes_rad: float
    tilt_by_fixes_sigma_rad: float


def missing_level(
    poses: Sequence[Pose], fix_nodes: NDArray[np.integer], antennas: GnssTrack, level_sigma_rad: float
) -> LevelPrior:
    """The level prior that a path and its fixes call for.

    Args:
        poses: map_from_cam along the path, in order, near where they belong.
        fix_nodes: (F,) which of them each fix belongs to.
        antennas: the fixes, as of their poses' own time.
        level_sigma_rad: how level the camera's horizontal axis is taken to be, on average over the drive.
    """
    rotations = np.array([p.rotation for p in poses])
    tilt = float(rotations[:, 2, 0].mean())
    if len(antennas) == 0 or len(poses) < 2:
        return LevelPrior(level_sigma_rad, tilt, np.inf)
    chain = _chain(poses, rotations, np.asarray(fix_nodes, dtype=np.intp))
    information: Array = np.asarray(np.linalg.inv(antennas.covariances_m2), dtype=np.float64)
    fit = gauss_newton_step(chain, Bend.none(chain), antennas, information, DriftRates(), False, _UNKNOWN)
    # d (exp(w) R)_31 = (w x r_1)_3 = w . (r_1 x e_3)
    axes = np.cross(rotations[:, :, 0], [0.0, 0.0, 1.0])
    turns = marginal_covariances(fit)[0][:, 3:6, 3:6]
    variance = float(np.einsum("ni,nij,nj->n", axes, turns, axes).mean())
    by_fixes = tilt + float((axes * so3_log(fit.bend.turns)).sum(axis=1).mean())
    missing = 1.0 / level_sigma_rad**2 - 1.0 / variance
    contradicted = abs(by_fixes) > _CONTRADICTION * np.hypot(np.sqrt(variance), level_sigma_rad)
    sigma_rad = np.inf if missing <= 0.0 or contradicted else float(1.0 / np.sqrt(missing))
    return LevelPrior(sigma_rad, by_fixes, float(np.sqrt(variance)))


def add_level_prior(graph: gtsam.NonlinearFactorGraph, poses: Sequence[Pose], sigma_rad: float) -> None:
    """Pull the mean tilt of the camera's horizontal axis towards zero, as one observation of it, and nothing else.

    Every pose (key X) is drawn to its own tilt less the mean, so the relief of the road costs nothing.
    """
    if not np.isfinite(sigma_rad):
        return
    noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma_rad * np.sqrt(len(poses)))
    tilts = np.array([p.rotation[2, 0] for p in poses])

    def excess(
        wanted: float, factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        R = values.atPose3(factor.keys()[0]).rotation().matrix()
        if jacobians is not None:  # d (R exp(w))_31 = R_3. [w]x e_1 = R_32 w_3 - R_33 w_2
            jacobians[0] = np.array([[0.0, -R[2, 2], R[2, 1], 0.0, 0.0, 0.0]])
        return np.array([R[2, 0] - wanted])

    for i, wanted in enumerate((tilts - tilts.mean()).tolist()):
        graph.push_back(gtsam.CustomFactor(noise, [X(i)], partial(excess, wanted)))


def _chain(poses: Sequence[Pose], rotations: Array, fix_nodes: NDArray[np.intp]) -> Chain:
    positions = np.array([p.translation_m for p in poses])
    return Chain(
        np.arange(len(poses), dtype=np.int64),
        positions,
        rotations,
        rotation_angle_rad(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:]),
        np.arange(len(fix_nodes)),
        fix_nodes,
        np.zeros((len(fix_nodes), 3)),
    )
