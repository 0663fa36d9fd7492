"""What GNSS says in the graph of the UGBA: fixes carried to keyframes, and the level that they may lack."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from numpy.typing import NDArray

from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Pose
from fleetmap_mapper.georeferencing import HUBER_SIGMAS, GnssTrack
from fleetmap_mapper.level_prior import add_level_prior, missing_level

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FixTerm:
    """A fix carried to a keyframe by the visual motion between them: u = T_i * arm."""

    keyframe: int
    arm_in_cam_m: Array  # (3,) the antenna at the fix's time, seen from the keyframe's camera
    position_m: Array  # (3,) in map
    covariance_m2: Array  # (3, 3)


def add_gnss(
    graph: gtsam.NonlinearFactorGraph, poses: Sequence[Pose], fixes: Sequence[FixTerm], level_sigma_rad: float
) -> None:
    """All that GNSS knows of the poses (keys X), and the level prior with the weight that it lacks."""
    huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER_SIGMAS)
    for fix in fixes:
        noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(fix.covariance_m2))
        graph.push_back(gtsam.GPSFactorArm(X(fix.keyframe), fix.position_m, fix.arm_in_cam_m, noise))
    nodes = np.array([fix.keyframe for fix in fixes], dtype=np.intp)
    add_level_prior(
        graph, poses, missing_level(poses, nodes, _at_keyframes(poses, fixes), level_sigma_rad).sigma_rad
    )


def _at_keyframes(poses: Sequence[Pose], fixes: Sequence[FixTerm]) -> GnssTrack:
    """The fixes moved to where the antenna was at the keyframes' own time: at one arm for all."""
    arms = np.array([fix.arm_in_cam_m for fix in fixes]).reshape(-1, 3)
    arm = np.median(arms, axis=0) if len(arms) else np.zeros(3)
    positions = [fix.position_m - poses[fix.keyframe].rotation @ (fix.arm_in_cam_m - arm) for fix in fixes]
    covariances = np.array([fix.covariance_m2 for fix in fixes]).reshape(-1, 3, 3)
    anchor = UtmAnchor(32601, 0, 0, 0)  # of no account: nothing leaves the map frame
    return GnssTrack(
        anchor, np.arange(len(fixes), dtype=np.int64), np.array(positions).reshape(-1, 3), covariances, arm
    )
