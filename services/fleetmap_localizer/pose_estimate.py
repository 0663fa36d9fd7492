"""What the localizer answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Pose


@dataclass(frozen=True)
class PoseEstimate:
    """Where a vehicle's camera was when it took an image."""

    stamp_ns: int
    epsg: int  # the UTM zone
    utm_from_cam: Pose  # easting, northing, ellipsoidal height
    # (6, 6) float64 of the tangent [rotation (rad), translation (m)] in the camera's frame: the true pose is
    # utm_from_cam @ exp(xi), xi ~ N(0, covariance); the map's own uncertainty included where the map tells it.
    covariance: NDArray[np.float64]
    map_id: str
    version: str  # of the map, SHA-256 of its manifest
    inlier_count: int  # landmarks that agree with the pose
    kind: Literal["measured", "predicted"] = "measured"  # predicted: carried on by other sensors than the camera


@dataclass(frozen=True)
class NoPose:
    """That, and why, the pose at an image cannot be told for sure."""

    stamp_ns: int
    reason: str  # for people
