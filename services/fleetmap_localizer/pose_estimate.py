"""What the localizer answers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Pose


@dataclass(frozen=True)
class PoseEstimate:
    """Where a vehicle's camera was when it took an image."""

    stamp_ns: int
    utm_from_cam: Pose  # easting, northing, ellipsoidal height in the map's UTM zone
    # (6, 6) float64 of the tangent [rotation (rad), translation (m)] in the camera's frame; relative to the map,
    # whose own error it does not hold.
    covariance: NDArray[np.float64]
    inlier_count: int  # landmarks that agree with the pose
